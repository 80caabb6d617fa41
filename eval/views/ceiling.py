"""Upper bound of Gaussians: each object fitted to its own true views."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import torch

from gamba_warp.conventions import DEFAULT_DISTANCE
from gamba_warp.data.dataset import ViewDataset
from gamba_warp.errors import UserError
from gamba_warp.fitting.config import FitConfig
from gamba_warp.fitting.objects import FitJob, choose_objects, fit_object
from gamba_warp.formats.ply import load_ply

from .compare import Shown, Truth, ViewsProtocol, render_views


@dataclass
class Ceiling:
    """Gaussians of ``gamba fit`` on all views of an object, fitted now or read from a file.

    Attributes:
        dataset: whose objects are fitted.
        protocol: input view and distance.
        device: torch device.
        folder: of files ``<uid>.ply`` in the world of view 0, as ``gamba fit`` writes them.
        job: of the fits; None: only existing files are used.
        uids: the objects to fit.
    """

    dataset: ViewDataset
    protocol: ViewsProtocol
    device: str
    folder: Path
    job: FitJob | None = None
    uids: Sequence[str] = ()

    def __call__(self, truth: Truth) -> Shown | None:
        """Return the pictures; None for an object without a file that is not to be fitted.

        Raises:
            UserError: its views cannot be used, or a file is bad.
            ValueError: see ``fit``.
            FloatingPointError: see ``fit``.
        """
        path = self.folder / f"{truth.uid}.ply"
        if self.job is not None and truth.uid in self.uids:
            fit_object(self.job, truth.uid)
        elif self.job is not None or not path.exists():
            return None
        # From the world of view 0, its camera at DEFAULT_DISTANCE, to the input camera's.
        views = self.dataset.load(truth.uid, views=[0, self.protocol.reference])
        first, reference = views.cameras.viewmats
        scale = self.protocol.distance / reference[:3, 3].norm()
        scale = scale / (DEFAULT_DISTANCE / first[:3, 3].norm())
        rotation = (reference[:3, :3] @ first[:3, :3].T).to(self.device)
        fitted = load_ply(path).to(self.device)
        moved = fitted.transformed(rotation, rotation.new_zeros(3), scale.item())
        return render_views(moved, truth.cameras)


def open_ceiling(
    wanted: str,
    dataset: ViewDataset,
    uids: list[str],
    protocol: ViewsProtocol,
    *,
    device: str,
    out: Path | None,
    steps: int,
) -> Ceiling:
    """Open the ceiling of the option ``--ceiling``.

    Args:
        wanted: a number of objects, or a folder of fitted ``.ply`` files.
        dataset: of the views.
        uids: the objects under evaluation.
        protocol: as for ``Ceiling``.
        device: torch device.
        out: the report's folder, for the fitted objects.
        steps: of each fit.

    Raises:
        UserError: neither a number above 0 nor a folder with a file for any of ``uids``; or a
            number without ``out``.
    """
    if wanted.isdecimal() and int(wanted) > 0:
        if out is None:
            raise UserError(f"--ceiling {wanted}: needs --out")
        config, size = FitConfig(steps=steps), protocol.size
        job = FitJob(dataset, out / "ceiling", config, 0, size, torch.device(device))
        chosen = choose_objects(uids, (), int(wanted))
        return Ceiling(dataset, protocol, device, job.folder / "gaussians", job, chosen)
    folder = Path(wanted)
    if not folder.is_dir():
        raise UserError(f"--ceiling {wanted}: neither a number above 0 nor a folder")
    folder = folder / "gaussians" if (folder / "gaussians").is_dir() else folder
    if not any((folder / f"{uid}.ply").exists() for uid in uids):
        raise UserError(f"--ceiling {wanted}: has a .ply file of none of the {len(uids)} objects")
    return Ceiling(dataset, protocol, device, folder)
