"""Benchmark cases of the training: a step by parts, its batch, and the dropped background."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor
from torch.nn.functional import interpolate
from torch.profiler import record_function

from gamba_warp.cameras import Cameras, intrinsics, orbit
from gamba_warp.data.dataset import ObjectViews, ViewDataset, open_dataset
from gamba_warp.gaussians import Gaussians
from gamba_warp.kernels.bench import Case, Error, Key, Settings, Target, Variant, compare
from gamba_warp.kernels.bench.core.measure import peak_bytes
from gamba_warp.kernels.bench.core.parts import measure_parts
from gamba_warp.model.checkpoint import DEFAULT_CHECKPOINT, load_model
from gamba_warp.model.config import PRESETS, GambaConfig
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.parts.patches import foreground_patches
from gamba_warp.render import render
from gamba_warp.vision.lpips import load_lpips
from gamba_warp.vision.weights import lpips_available

from ..batches import BatchSource
from ..config import DataConfig, OptimConfig
from ..data.samples import Batch
from ..optim import Ema, build_optimizer
from ..step import compute_gradients

OP, BOTH = "train-step", "forward+backward"
_BATCH, _NOVEL, _SIZE, _CROP = 4, 3, 128, 64
_SLIM = "rays, slim"  # as wide and deep as preset tiny
_LOWER = "rays, bfloat16"  # products of the network and of LPIPS in bfloat16, as it was trained
_COMPARED = ("tiny", "rays", _SLIM, _LOWER)
_BATCHES = {"quick": (1,), "normal": (1, 2, 4), "full": (1, 2, 4, 8)}
_WEIGHTS = {"rgb": 1.0, "mask": 1.0, "ssim": 0.2, "lpips": 0.0, "rdist": 0.0}
_WITH_LPIPS = "LPIPS of crops"
_COVERED = 0.22  # of a made-up view by its object, which then lies in 28 % of the patches of 8²
_SHARES = {"quick": (0.1,), "normal": (0.05, 0.1, 0.2, 0.4, 0.7, 1.0)}
_SPREAD = (0.6, 0.85, 1.1, 1.45)  # sizes of the objects of a batch, as they differ in real ones
_ALONE_LIMIT = 1e-4  # the same sums in products of other shapes
# What is a part of its own, by a region of the step: text in an operator's name -> part.
_PRODUCTS = dict.fromkeys(
    ("aten::mm", "aten::addmm", "aten::bmm", "aten::baddbmm"), "matrix products"
)
_KINDS = {
    "rest of the network": {
        "selective_scan": "scan",
        "causal_conv1d": "convolution of tokens",
        "onvolution": "convolutions of pictures",
        **_PRODUCTS,
    }
}
_REGIONS = (
    "data",
    "rest of the network",
    "rasterizer",
    "MSE and mask",
    "SSIM",
    "LPIPS",
    "optimizer",
)


def cases(settings: Settings) -> list[Case]:
    """Returns the cases of a training step."""
    parts = (
        f"One optimizer step on {_BATCH} objects in {_NOVEL + 1} views of {_SIZE}²: data, network, "
        f"rendering, MSE + mask + 0.2 (1 - SSIM), with and without LPIPS of crops of {_CROP}², "
        "gradients, clipping, AdamW and the running average; fresh weights. Views are those of "
        "--data, or made up: the objects lie in 28 % of the patches of 8² in the mean. Parts are "
        "self times of torch's profiler, whose own cost is the difference of the whole step with "
        "it and without. Rays, slim: as wide and deep as tiny; rays, bfloat16: products in "
        "bfloat16, as it was trained. The only check is that the gradient is finite."
    )
    batch = "Cost of that step without LPIPS against the number of objects."
    background = (
        "Preset rays computes the patches that see the object; here also all patches, against the "
        "share of the picture that the object covers in the mean of a batch of 4. Forward is the "
        "network alone without gradients, forward+backward a step without data and optimizer. "
        "Error: a batch padded to its largest object must give the Gaussians, and the gradient, "
        "that each object gives alone. All patches is another function, since the network then "
        "sees tokens of the background, which it was not trained with; how far its pictures are is "
        "a PSNR. Weights: the shipped model's, or fresh ones."
    )
    builders = {
        "parts": (parts, _parts, "parts"),
        "batch": (batch, _batches, "B"),
        "background": (background, _background, "share"),
    }
    return [
        Case(op=OP, name=name, text=text, build=partial(build, settings), axis=axis)
        for name, (text, build, axis) in builders.items()
    ]


def targets(settings: Settings) -> list[Target]:
    """Returns the targets; there are none at a quick run's sizes."""
    if settings.level == "quick":
        return []
    ends = ["", *([f", {_WITH_LPIPS}"] if lpips_available() else [])]
    return [
        Target(
            text=f"samples a second, {name} over tiny{end}",
            times=(Key(OP, "parts", f"tiny{end}", BOTH),),
            over=(Key(OP, "parts", f"{name}{end}", BOTH),),
            at_least=4.0,
        )
        for end in ends
        for name in _COMPARED[1:]
    ]


class _MadeUp(ViewDataset):
    """Objects of smooth noise whose silhouette is an ellipse, in views from all around."""

    def __init__(self, shares: Sequence[float], size: int) -> None:
        """``shares`` are those of a view that each object covers."""
        super().__init__({}, "made up", cache=False)
        self.uids = [f"object{number}" for number in range(len(shares))]
        self.views = _NOVEL + 3
        noise = torch.rand(len(shares) * self.views, 3, size // 8, size // 8)
        color = interpolate(noise, size=(size, size), mode="bilinear").permute(0, 2, 3, 1)
        drawn = [_ellipse(share, size, 0.7 + 0.2 * i) for i, share in enumerate(shares)]
        alphas = torch.stack(drawn)[:, None].expand(-1, self.views, -1, -1, -1)
        self.drawn = torch.cat([color.unflatten(0, alphas.shape[:2]), alphas], -1)

    def num_views(self, index: int | str) -> int:
        """The number of views of each object."""
        return self.views

    def load(
        self, index: int | str, views: Sequence[int] | None = None, size: int | None = None,
        depths: int | None = None,
    ) -> ObjectViews:  # fmt: skip
        """Views of one object, as ``ViewDataset.load`` gives them; ``size`` is that of all."""
        chosen = list(range(self.views) if views is None else views)
        images = self.drawn[int(index), chosen].clone()
        side = images.shape[1]
        viewmats = orbit(360 * torch.tensor(chosen) / self.views, distance=2.5)
        K = intrinsics(side, side, 40.0).expand(len(chosen), 3, 3)
        cameras = Cameras(viewmats, K, side, side)
        return ObjectViews(self.uids[int(index)], "made up", images, cameras, None, {})


def _ellipse(share: float, size: int, stretch: float) -> Tensor:
    """A silhouette in the middle that covers a share of the picture: ``[size, size, 1]``."""
    if share >= 1:
        return torch.ones(size, size, 1)
    x = torch.linspace(-1, 1, size)
    distance = (x[:, None] / stretch) ** 2 + (x * stretch) ** 2  # of all pixels, the nearest ones
    limit = distance.flatten().sort().values[max(0, round(share * size**2) - 1)]
    return (distance <= limit).float()[..., None]


def _config(name: str, settings: Settings) -> GambaConfig:
    tiny, config = PRESETS["tiny"], PRESETS["tiny" if name == "tiny" else "rays"]
    if name == _SLIM:
        config = replace(config, width=tiny.width, depth=tiny.depth)
    if settings.level == "quick":
        config = replace(config, image_size=32, width=16, depth=1)
    return config


def _source(
    config: GambaConfig, settings: Settings, batch: int, covered: float = _COVERED
) -> BatchSource:
    """Batches of the folder that was given, or of made-up views with the same silhouettes."""
    spread = (_SPREAD[i % len(_SPREAD)] if covered < 1 else 1.0 for i in range(batch))
    shares = [min(1.0, covered * factor) for factor in spread]
    size = min(_SIZE, config.image_size)
    data = _MadeUp(shares, size)
    if settings.data is not None:
        data = open_dataset(settings.data, cache=True)
    views = DataConfig(size=size, mirror=0.5, recolor=0.3)
    return BatchSource(
        data,
        config,
        objects=list(range(len(data.uids))),
        batch_size=batch,
        reference=None,
        views=views,
        seed=0,
    )


class _Step:
    """A model with its optimizer and its data, as a run of training has them."""

    def __init__(
        self, settings: Settings, name: str, batch: int = _BATCH, lpips: bool = False
    ) -> None:
        torch.manual_seed(0)
        config = _config(name, settings)
        self.device, self.number = settings.device, 0
        self.precision = torch.bfloat16 if name == _LOWER else torch.float32
        self.model = Gamba(config).to(settings.device)
        options = OptimConfig()
        self.clip = options.clip
        self.optimizer = build_optimizer(self.model, options.weight_decay, options.beta2)
        for group in self.optimizer.param_groups:
            group["lr"] = 1e-6  # the weights hardly move, so every round does the same work
        self.ema = Ema(self.model, options.ema)
        self.lpips = load_lpips().to(settings.device) if lpips else None
        self.weights = _WEIGHTS | {"lpips": 0.2 if lpips else 0.0}
        self.source = _source(config, settings, batch)

    def _network(self, images: Tensor, cameras: Cameras) -> Gaussians:
        with record_function("rest of the network"):
            return self.model(images, cameras)

    def step(self) -> Tensor:
        """Makes the whole step and returns the gradient's norm; this is what is timed."""
        with record_function("data"):
            batch = self.source.batch(self.number, _NOVEL).to(self.device)
        self.number += 1
        made = compute_gradients(
            self._network,
            self.optimizer,
            [batch],
            self.weights,
            clip=self.clip,
            lpips=self.lpips,
            lpips_crop=_CROP,
            precision=self.precision,
        )
        with record_function("optimizer"):
            self.optimizer.step()
            self.ema.update()
        return made.norm

    def check(self) -> None:
        """Checks that the gradient is finite and not 0; there is no oracle."""
        value = self.step().item()
        if not (math.isfinite(value) and value > 0):
            raise ValueError(f"gradient is {value}")

    def work(self, rounds: int) -> dict[str, float]:
        """Counts samples and Gaussians, and on a CPU the milliseconds of each part."""
        batch = self.source.batch(0, _NOVEL).to(self.device)
        with torch.no_grad():
            opacities = self.model(batch.inputs, batch.input_cameras).opacities
        drawn = int((opacities > 0).sum()) // len(batch.uids)
        counts: dict[str, float] = {"samples": len(batch.uids), "drawn": drawn}
        if self.device.type != "cpu":  # its calls return before the work is done
            return counts
        return counts | measure_parts(self.step, _REGIONS, _KINDS, rounds)


def _parts(settings: Settings) -> list[Variant]:
    with_lpips = (False,) if settings.level == "quick" or not lpips_available() else (False, True)
    made, rounds = [], 1 if settings.level == "quick" else 5
    for lpips in with_lpips:
        for name in _COMPARED:
            step = _Step(settings, name, lpips=lpips)
            made.append(
                Variant(
                    name=f"{name}, {_WITH_LPIPS}" if lpips else name,
                    run=step.step,
                    check=step.check,
                    direction=BOTH,
                    default=name == "rays" and not lpips,
                    rounds=7,
                    parameters={"B": _BATCH, "views": _NOVEL + 1, "side": _SIZE},
                    work=partial(step.work, rounds),
                )
            )
    return made


def _batches(settings: Settings) -> list[Variant]:
    made = []
    for name in ("tiny", "rays"):
        for batch in _BATCHES[settings.level]:
            step = _Step(settings, name, batch)
            made.append(
                Variant(
                    name=f"{name}, {batch} object{'s' * (batch > 1)}",
                    run=step.step,
                    check=step.check,
                    direction=BOTH,
                    rounds=5,
                    parameters={"B": batch, "views": _NOVEL + 1, "side": _SIZE, "series": name},
                )
            )
    return made


class _Covered:
    """The model of preset rays and a batch whose objects cover a share of the picture."""

    def __init__(self, settings: Settings, model: Gamba, share: float) -> None:
        torch.manual_seed(1)
        self.model, self.device = model, settings.device
        source = _source(model.config, replace(settings, data=None), len(_SPREAD), share)
        self.batch = source.batch(0, _NOVEL).to(settings.device)
        self.optimizer = torch.optim.SGD(model.parameters(), lr=0.0)

    def _run(self, margin: int, images: Tensor, cameras: Cameras) -> Gaussians:
        return self.model(images, cameras, background_margin=margin)

    @torch.no_grad()
    def forward(self, margin: int) -> Gaussians:
        """Runs the network; this is what is timed."""
        return self._run(margin, self.batch.inputs, self.batch.input_cameras)

    def gradients(self, margin: int, batch: Batch | None = None) -> dict[str, Tensor]:
        """Makes the gradients of the weights; this is timed too."""
        run = partial(self._run, margin)
        compute_gradients(run, self.optimizer, [batch or self.batch], _WEIGHTS, clip=math.inf)
        named = self.model.named_parameters()
        return {name: p.grad for name, p in named if p.grad is not None}

    def _alone(self) -> list[Batch]:
        """The objects of the batch, each as a batch."""
        one = (slice(i, i + 1) for i in range(len(self.batch.uids)))
        fields = {k: v for k, v in vars(self.batch).items() if v is not None}
        return [Batch(**{k: v[i] for k, v in fields.items()}) for i in one]

    def check(self, margin: int) -> Error:
        """Measures the error of the batch's Gaussians to those of each object alone."""
        together, got, want = self.forward(margin), {}, {}
        for i, one in enumerate(self._alone()):
            with torch.no_grad():
                alone = self._run(margin, one.inputs, one.input_cameras)
            for name, value in vars(alone).items():
                if value is not None:
                    want[f"{name} of object {i}"] = value[0]
                    got[f"{name} of object {i}"] = getattr(together, name)[i, : alone.num]
        return compare(got, want)

    def check_gradients(self, margin: int) -> Error:
        """Measures the error of all weights' gradient to the mean of those of each object alone."""
        got = {name: value.clone() for name, value in self.gradients(margin).items()}
        sums: dict[str, Tensor] = {}
        alone = self._alone()
        for one in alone:
            for name, value in self.gradients(margin, one).items():
                sums[name] = sums.get(name, 0.0) + value.double() / len(alone)
        flat = [torch.cat([v[name].double().flatten() for name in sums]) for v in (got, sums)]
        return compare({"gradient": flat[0]}, {"gradient": flat[1]})

    @torch.no_grad()
    def _pictures(self, margin: int) -> Tensor:
        return render(self.forward(margin), self.batch.cameras, self.batch.background).rgb

    def work(self, margin: int, whole: int, run: Callable[[], object]) -> dict[str, float]:
        """Counts tokens and memory, and the PSNR to the pictures of all patches, in dB."""
        alpha = self.batch.inputs[..., 3]
        patches = foreground_patches(alpha, self.model.config.patch_size, margin)
        groups = patches.groups() if self.device.type == "cpu" else [range(len(patches.index))]
        tokens = sum(4 * patches.of(list(group)).index.numel() for group in groups)
        counts: dict[str, float] = {"tokens": tokens}
        if margin != whole:
            error = (self._pictures(margin) - self._pictures(whole)).square().mean()
            counts["psnr_to_full"] = round(-10 * error.clamp_min(1e-12).log10().item(), 1)
        peak = peak_bytes(run, self.device)
        return counts | ({} if peak is None else {"peak_bytes": peak})


def _rays_model(settings: Settings) -> Gamba:
    torch.manual_seed(0)
    if settings.level == "quick" or not DEFAULT_CHECKPOINT.exists():
        return Gamba(_config("rays", settings)).to(settings.device)
    return load_model(DEFAULT_CHECKPOINT, settings.device).train().requires_grad_()


def _background(settings: Settings) -> list[Variant]:
    model = _rays_model(settings)
    whole = model.config.grid_size  # a margin that takes every patch
    made = []
    for share in _SHARES.get(settings.level, _SHARES["normal"]):
        covered = _Covered(settings, model, share)
        for margin, name in ((0, "object's patches"), (whole, "all patches")):
            percent = round(100 * covered.batch.inputs[..., 3].mean().item())
            runs = {
                "forward": (covered.forward, covered.check),
                BOTH: (covered.gradients, covered.check_gradients),
            }
            for direction, (run, check) in runs.items():
                made.append(
                    Variant(
                        name=f"{percent} %, {name}",
                        run=partial(run, margin),
                        check=partial(check, margin),
                        limit=_ALONE_LIMIT,
                        oracle="each object alone (not float64)",
                        direction=direction,
                        rounds=5,
                        default=margin == 0,
                        parameters={"B": len(_SPREAD), "share": percent, "series": name},
                        work=partial(covered.work, margin, whole, partial(run, margin)),
                    )
                )
    return made
