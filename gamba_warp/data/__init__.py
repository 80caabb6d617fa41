"""Datasets of posed views, and pictures prepared for a model."""
