"""Turntables, and HTML pages with viewers."""
