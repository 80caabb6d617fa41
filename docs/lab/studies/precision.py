"""Benchmark case of inference in both precisions of the products, beside the products alone."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.devices import float32_products, network_precision
from gamba_warp.gaussians import Gaussians
from gamba_warp.kernels.bench.core.case import Error, Settings, Variant, compare
from gamba_warp.measure.inference import without_encoder
from gamba_warp.model.checkpoint import shipped_model
from gamba_warp.model.config import PRESETS, Preset
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.posing import reference_cameras
from gamba_warp.render import render

from .products import Products
from .targets import Key, Target

PAPER, ALONE, PLAIN = "paper, float32", "products alone", "MKL's products alone"
# Allowed relative rms errors of the Gaussians: roundings that 14 blocks carry on.
_LIMITS = {torch.float32: 1e-3, torch.bfloat16: 0.1}


def targets(settings: Settings) -> list[Target]:
    """Return the targets; none at a quick run's sizes or on a GPU."""
    if settings.level == "quick" or settings.device.type != "cpu":
        return []
    wanted = ((f"paper, {PLAIN}", 1.08), (f"paper, float32, {ALONE}", 1.3))
    return [
        Target(
            text=f"a picture to Gaussians, paper, float32, over {name.removeprefix('paper, ')}",
            times=(Key("model", "precision", PAPER),),
            over=(Key("model", "precision", name),),
            at_most=most,
        )
        for name, most in wanted
    ]


class _Precise:
    """Model with one picture, and its result in float32 by torch's default library."""

    def __init__(self, settings: Settings, preset: Preset) -> None:
        torch.manual_seed(0)
        quick = settings.level == "quick"
        shipped = None if quick else shipped_model(preset, settings.device)
        self.trained = shipped is not None
        if shipped is None:
            config = without_encoder(PRESETS[preset])
            if quick:
                config = replace(config, image_size=32, width=16, depth=1)
            shipped = Gamba(config).to(settings.device).eval()
        self.model = shipped
        config = self.model.config
        size = config.image_size
        picture = torch.rand(1, size, size, config.input_channels)
        if config.input_channels == 4:  # an object in the middle, as the cut-out puts it
            x = torch.linspace(-1, 1, size)
            picture[..., 3] = ((x[:, None] ** 2 + x**2) < 0.5).float()
        self.picture = picture.to(settings.device)
        self.camera = reference_cameras(config, 1).to(settings.device)
        viewmats = orbit(torch.tensor([0.0, 90.0, 180.0]), distance=config.distance)
        K = intrinsics(size, size, config.fov).repeat(3, 1, 1)
        self.views = Cameras(viewmats, K, size, size).to(settings.device)
        with float32_products():
            self.truth = self.run(torch.float32)
        self.seen = self._render(self.truth)

    @torch.no_grad()
    def run(self, precision: torch.dtype) -> Gaussians:
        """Run the model; timed."""
        with network_precision(self.picture.device, precision):
            return self.model(self.picture, self.camera)

    @torch.no_grad()
    def _render(self, gaussians: Gaussians) -> Tensor:
        return render(gaussians[0], self.views).rgb

    def check(self, precision: torch.dtype) -> Error:
        """Measure the error of the Gaussians."""
        made, truth = ({k: x for k, x in vars(g).items() if x is not None} for g in
                       (self.run(precision), self.truth))  # fmt: skip
        return compare(made, truth)

    def work(self, precision: torch.dtype) -> dict[str, float]:
        """Measure the PSNR of pictures from three sides."""
        error = (self._render(self.run(precision)) - self.seen).square().mean().clamp_min(1e-12)
        return {"psnr_to_float32": round(-10 * error.log10().item(), 1)}


def precisions(settings: Settings) -> list[Variant]:
    """A posed picture to Gaussians in both precisions of the network's products, without the image
    encoder; the shipped models' weights where a preset has them. Beside them, of preset paper, its
    matrix products alone, repeated on operands of the same shapes into given outputs. The error is
    that of the Gaussians to float32's with MKL's products; beside it stands the PSNR of pictures
    from three sides.
    """
    made: list[Variant] = []
    for preset in ("tiny", "rays") if settings.level == "quick" else ("tiny", "rays", "paper"):
        precise = _Precise(settings, preset)
        for precision in (torch.float32, torch.bfloat16):
            kind = str(precision).removeprefix("torch.")
            run = partial(precise.run, precision)
            made.append(
                Variant(
                    name=f"{preset}, {kind}",
                    run=run,
                    check=partial(precise.check, precision),
                    limit=_LIMITS[precision],
                    oracle="float32",
                    dtype=kind,
                    default=precision == torch.float32,
                    rounds=5,
                    parameters={"weights": "shipped" if precise.trained else "fresh"},
                    work=partial(precise.work, precision),
                )
            )
            if preset == "paper":
                made += _alone(run, kind, settings)
    return made


def _alone(run: Callable[[], object], kind: str, settings: Settings) -> list[Variant]:
    """The products of a run alone, by the library that the model takes, and of float32 by MKL."""
    products = Products(run, settings.device)

    def plain() -> None:
        with float32_products():
            products.run()

    runs = {f"paper, {kind}, {ALONE}": products.run}
    if kind == "float32":
        runs[f"paper, {PLAIN}"] = plain
    return [
        Variant(
            name=name,
            run=ran,
            check=None,
            dtype=kind,
            rounds=5,
            work=products.work,
        )
        for name, ran in runs.items()
    ]
