"""Shapes against true ones: ``gamba eval-geometry``."""
