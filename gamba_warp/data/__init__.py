"""Datasets of posed views, pictures prepared for a model, and pretrained weights."""
