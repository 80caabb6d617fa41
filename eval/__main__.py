"""``python -m gamba_warp.eval views|geometry …``: ``gamba eval-views`` or ``eval-geometry``."""

import sys

from gamba_warp.cli import main

KINDS = ("views", "geometry")

if __name__ == "__main__":
    if len(sys.argv) < 2 or sys.argv[1] not in KINDS:
        print(f"usage: python -m gamba_warp.eval {{{','.join(KINDS)}}} ...", file=sys.stderr)
        sys.exit(0 if sys.argv[1:2] in (["-h"], ["--help"]) else 2)
    main([f"eval-{sys.argv[1]}", *sys.argv[2:]])
