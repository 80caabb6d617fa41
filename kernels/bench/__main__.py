"""``python -m gamba_warp.kernels.bench``, which is ``gamba bench``."""

import sys

from gamba_warp.cli import main

if __name__ == "__main__":
    main(["bench", *sys.argv[1:]])
