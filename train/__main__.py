"""``python -m gamba_warp.train``, which is ``gamba train``; ``torchrun`` starts it by this name."""

import sys

from gamba_warp.cli import main

if __name__ == "__main__":
    main(["train", *sys.argv[1:]])
