"""Paths of cameras: turntables, spirals, files of other programs."""
