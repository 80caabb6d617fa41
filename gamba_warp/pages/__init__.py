"""Turntables, and HTML pages with charts and viewers."""
