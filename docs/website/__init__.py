"""Conversion of the pages of this folder to the site (mkdocs.yml)."""
