"""Paths of cameras: turntables, spirals, files of other programs; and the movies along them."""
