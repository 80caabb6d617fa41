"""``python -m gamba_warp.train``, which is ``gamba train``; ``torchrun`` starts it by this name."""

import sys

from gamba_warp.cli import run

if __name__ == "__main__":
    sys.exit(run("train", sys.argv[1:]))
