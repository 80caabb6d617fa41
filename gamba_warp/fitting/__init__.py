"""Fitting of Gaussians to one object by optimisation, without a model."""
