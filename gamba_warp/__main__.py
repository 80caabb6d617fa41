"""``python -m gamba_warp``: the same as the console script ``gamba``."""

from .cli import main

if __name__ == "__main__":
    main()
