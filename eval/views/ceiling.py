"""What Gaussians could show at best: every object fitted to its own true views."""

from __future__ import annotations

import hashlib
import json
from dataclasses import asdict, dataclass
from pathlib import Path

import torch

from gamba_warp.batch import progress_bar
from gamba_warp.cameras import relative_to_reference
from gamba_warp.conventions import DEFAULT_DISTANCE
from gamba_warp.data.dataset import ViewDataset
from gamba_warp.errors import UserError
from gamba_warp.files import output_folder, write_json
from gamba_warp.fitting.config import FitConfig
from gamba_warp.fitting.objects import FitJob, choose_objects, load_views
from gamba_warp.fitting.optimize import fit
from gamba_warp.formats.ply import load_ply, save_ply
from gamba_warp.gaussians import Gaussians

from .compare import Shown, Truth, ViewsProtocol, render_views


@dataclass
class Ceiling:
    """The result of ``gamba fit`` on all views of an object, made now or read from its file.

    Files are ``<uid>.ply`` in the world of view 0, as ``gamba fit`` writes them.

    Attributes:
        dataset: whose objects are fitted.
        protocol: size of the pictures, input view and distance.
        device: torch device.
        folder: folder of the files; None: nothing is kept.
        uids: objects to fit where the folder does not have them with these settings; None: nothing
            is fitted, and only the files that are there count.
        config: of the fit.
    """

    dataset: ViewDataset
    protocol: ViewsProtocol
    device: str
    folder: Path | None
    uids: list[str] | None = None
    config: FitConfig = FitConfig()  # noqa: RUF009 (frozen)

    def __call__(self, truth: Truth) -> Shown | None:
        """Returns the pictures, or None for an object that is not to be fitted.

        Raises:
            UserError: its views cannot be used, or a file is bad.
            ValueError: see ``fit``.
            FloatingPointError: see ``fit``.
        """
        uid = truth.uid
        path = self.folder / f"{uid}.ply" if self.folder else None
        if self.uids is not None:
            fitted = self._fitted(uid, path) if uid in self.uids else None
        else:
            fitted = load_ply(path).to(self.device) if path and path.exists() else None
        if fitted is None:
            return None
        # from the world of view 0, its camera at DEFAULT_DISTANCE, to that of the truth
        views = self.dataset.load(uid, views=[0, self.protocol.reference])
        first, reference = views.cameras.viewmats
        scale = self.protocol.distance / reference[:3, 3].norm()
        scale = scale / (DEFAULT_DISTANCE / first[:3, 3].norm())
        turn = (reference[:3, :3] @ first[:3, :3].T).to(self.device)
        moved = fitted.transformed(turn, turn.new_zeros(3), scale.item())
        return render_views(moved, truth.cameras)

    def _fitted(self, uid: str, path: Path | None) -> Gaussians:
        """Fits, or reads what the same settings gave for the same views before."""
        job = FitJob(
            dataset=self.dataset,
            folder=self.folder or Path(),
            config=self.config,
            held_out=0,
            size=self.protocol.size,
            device=torch.device(self.device),
        )
        views = load_views(job, uid, list(range(self.dataset.num_views(uid))))
        digest = hashlib.sha256(json.dumps(asdict(self.config)).encode())
        for tensor in (views.images, views.cameras.viewmats, views.cameras.Ks):
            digest.update(tensor.numpy().tobytes())
        key, told = digest.hexdigest(), path.with_suffix(".json") if path else None
        if path and told and path.exists() and _key_in(told) == key:
            return load_ply(path).to(self.device)
        images, cameras = views.images.to(self.device), views.cameras.to(self.device)
        with progress_bar(total=100, desc=f"ceiling {uid}", unit="%", leave=False) as bar:

            def show(done: float, _: float) -> None:
                bar.update(int(100 * done) - bar.n)

            result = fit(images, cameras, self.config, show)
        first = cameras.viewmats[0]
        _, scale = relative_to_reference(first[None], first)
        moved = result.gaussians.transformed(first[:3, :3], first.new_zeros(3), scale.item())
        if path and told:
            output_folder(path.parent)
            told.unlink(missing_ok=True)  # it vouches for the .ply
            save_ply(path, moved, comments=[f"fitted to all views of {uid}"])
            write_json(told, {"key": key, "fit": asdict(self.config)})
        return moved


def _key_in(path: Path) -> str | None:
    try:
        return json.loads(path.read_bytes())["key"]
    except (OSError, ValueError, KeyError, TypeError):
        return None


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
    """Opens the ceiling that ``--ceiling`` asks for.

    Args:
        wanted: a number of objects, or a folder of fitted ``.ply`` files.
        dataset: where the views come from.
        uids: the objects under evaluation.
        protocol: as for ``Ceiling``.
        device: torch device.
        out: the report's folder, where fitted objects are kept; or None.
        steps: number of steps of a fit.

    Raises:
        UserError: neither a number above 0 nor a folder with a file for any of ``uids``.
    """
    if wanted.isdecimal() and int(wanted) > 0:
        folder, chosen = out / "ceiling" if out else None, choose_objects(uids, (), int(wanted))
        return Ceiling(dataset, protocol, device, folder, chosen, FitConfig(steps=steps))
    folder = Path(wanted)
    if not folder.is_dir():
        raise UserError(f"--ceiling {wanted}: neither a number above 0 nor a folder")
    folder = folder / "gaussians" if (folder / "gaussians").is_dir() else folder
    if not any((folder / f"{uid}.ply").exists() for uid in uids):
        raise UserError(f"--ceiling {wanted}: has a .ply file of none of the {len(uids)} objects")
    return Ceiling(dataset, protocol, device, folder)
