"""Datasets of posed views, and images prepared for a model."""
