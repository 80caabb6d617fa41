"""What turns the pages of this folder into the site (mkdocs.yml)."""
