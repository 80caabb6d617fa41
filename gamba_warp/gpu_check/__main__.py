"""``python -m gamba_warp.gpu_check``: the command without tyro, for a bare CUDA machine."""

import sys

from .check import main

if __name__ == "__main__":
    sys.exit(main())
