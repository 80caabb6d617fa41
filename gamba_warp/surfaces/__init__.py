"""Surfaces of Gaussians."""
