"""Metrics of predicted shapes: ``gamba eval-geometry``."""
