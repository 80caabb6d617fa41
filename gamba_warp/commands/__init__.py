"""The commands of ``gamba``, a file each; only ``cli.py`` imports them."""
