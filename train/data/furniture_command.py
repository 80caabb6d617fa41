"""``gamba data furniture``: 820 textured models that are free to use."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro


def data_furniture_command(
    out: Annotated[Path, tyro.conf.arg(aliases=["-o"])],
    deb: Path | None = None,
    tree: Path | None = None,
) -> int:
    """Get 820 free textured models with icons: Sweet Home 3D's libraries, from Debian's package.

    Without --deb or --tree: an installed package is used, else apt-get downloads it (125 MB).

    Args:
        out: folder for the models, their icons and catalogue.json; 400 MB.
        deb: the package file sweethome3d-furniture_*.deb, if you have it.
        tree: a folder that holds the .sh3f files, if you have them.
    """
    from .furniture import get_furniture

    count = get_furniture(out, deb, tree)
    print(f"{count} models in {out}; next: gamba data render {out} --out DATA")
    return 0
