"""Commands of ``gamba``, one file each; only ``cli.py`` imports them."""
