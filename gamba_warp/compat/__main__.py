"""``python -m gamba_warp.compat SCRIPT …`` or ``-m MODULE …``: run a program on our kernels.

``--take NAME,NAME`` before these takes only some of the names, ``--fork NAME`` chooses one of
``diff_gaussian_rasterization.FORKS``.
"""

import runpy
import sys
from pathlib import Path

from . import take_names


def main(arguments: list[str]) -> None:
    """Call ``take_names``, then run a program like ``python``."""
    names = []
    while arguments[:1] in (["--take"], ["--fork"]) and len(arguments) > 1:
        if arguments[0] == "--take":
            names = arguments[1].split(",")
        else:
            from .diff_gaussian_rasterization import use_fork

            use_fork(arguments[1])
        arguments = arguments[2:]
    if arguments[:1] == ["-m"] and len(arguments) > 1:
        sys.argv = arguments[1:]
        take_names(*names)
        sys.path[0] = ""
        runpy.run_module(arguments[1], run_name="__main__", alter_sys=True)
    elif arguments and Path(arguments[0]).is_file():
        sys.argv = arguments
        take_names(*names)
        sys.path[0] = str(Path(arguments[0]).resolve().parent)
        runpy.run_path(arguments[0], run_name="__main__")
    else:
        named = f": there is no file {arguments[0]!r}" if arguments else ""
        options = "[--take NAMES] [--fork NAME]"
        sys.exit(f"python -m gamba_warp.compat {options} SCRIPT … or -m MODULE …{named}")


if __name__ == "__main__":
    main(sys.argv[1:])
