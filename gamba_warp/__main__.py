"""``python -m gamba_warp``, which is the console script ``gamba``."""

from .cli import main

if __name__ == "__main__":
    main()
