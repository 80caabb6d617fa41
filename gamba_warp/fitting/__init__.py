"""Gaussians of one object by optimisation, without a model."""
