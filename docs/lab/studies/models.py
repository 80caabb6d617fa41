"""Studies of blocks and models: compiled blocks, and tokens of the background that are dropped."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial

import torch
from torch import Tensor

from gamba_warp.cameras import Cameras, intrinsics, orbit, reference_viewmat
from gamba_warp.data.preprocess import composite
from gamba_warp.gaussians import Gaussians
from gamba_warp.kernels.bench.core.case import (
    Case,
    Error,
    NotInstalled,
    Settings,
    Variant,
    compare,
    make_cases,
)
from gamba_warp.measure.blocks import Backbone
from gamba_warp.measure.inference import captured
from gamba_warp.model.checkpoint import DEFAULT_CHECKPOINT, load_model
from gamba_warp.model.parts.block import prefix_states
from gamba_warp.model.posing import reference_cameras
from gamba_warp.photo.cutout import cut_out
from gamba_warp.render import render

from . import precision
from .products import Products
from .targets import Key, Target

ALONE = "matrix products alone"


def cases(settings: Settings) -> list[Case]:
    """Return the cases, in addition to those of ``gamba bench block model``."""
    models = [
        ("background tokens", background_tokens, "error,skipped"),
        ("precision", precision.precisions, "error"),
    ]
    return [
        *make_cases("block", settings, [("compiled", compiled, "error"), (ALONE, alone, None)]),
        *make_cases("model", settings, models),
    ]


def targets(settings: Settings) -> list[Target]:
    """Return the targets of both precisions, and of blocks beside their products."""
    made = precision.targets(settings)
    if settings.level != "quick":
        for name in _DEPTHS:
            ours, products = (Key("block", ALONE, n) for n in (name, f"{name}, products alone"))
            text = f"{name}, time over that of its matrix products alone"
            made.append(Target(text, (ours,), (products,), at_most=1.3))
    return made


_DEPTHS = {"one block": 1, "backbone": 14}


def alone(settings: Settings) -> list[Variant]:
    """Blocks of the paper's size beside their matrix products alone, repeated on operands of the
    same shapes into given outputs.
    """
    made = []
    for name, depth in _DEPTHS.items():
        backbone = Backbone(settings, min(depth, 2) if settings.level == "quick" else depth)
        made.append(backbone.variant(name, default=True))
        products = Products(backbone.forward, settings.device)
        rest = {"run": products.run, "check": None, "work": products.work, "oracle": ""}
        made.append(backbone.variant(f"{name}, products alone", **rest))
    return made


class _Lazy:
    """Function made at its first call, so that a failure does not affect other variants."""

    def __init__(self, make: Callable[[], Callable[[], Tensor]]) -> None:
        self._make = make
        self._function: Callable[[], Tensor] | None = None

    def __call__(self) -> Tensor:
        if self._function is None:
            self._function = self._make()
        return self._function()


def compiled(settings: Settings) -> list[Variant]:
    """A block of the paper's size as it is, through torch.compile, and on CUDA as a CUDA graph. The
    first call includes the compilation. All that it can fuse are a few elementwise operations
    between the products and our kernels, and no gain is seen, so blocks are not compiled by
    default.
    """
    backbone = Backbone(settings, 1)
    (block,) = backbone.blocks
    with torch.no_grad():
        (state,) = prefix_states(backbone.blocks, backbone.camera, backbone.image)

    @torch.no_grad()
    def plain() -> Tensor:
        return block(backbone.tokens, state)[0]

    def compiled_block() -> Callable[[], Tensor]:
        if settings.device.type == "cpu" and not any(map(shutil.which, ("g++", "clang++", "c++"))):
            raise NotInstalled("a C++ compiler")
        function = torch.compile(block)
        return torch.no_grad()(lambda: function(backbone.tokens, state)[0])

    def graph() -> Callable[[], Tensor]:
        whole, result, _ = captured(plain, settings.device)

        def replay() -> Tensor:
            whole.replay()
            return result

        return replay

    runs = {"as it is": plain}
    if settings.level != "quick":
        runs["torch.compile"] = _Lazy(compiled_block)
    if settings.device.type == "cuda":
        runs["CUDA graph"] = _Lazy(graph)
    return [backbone.forward_variant(name, run, default=run is plain) for name, run in runs.items()]


class _Pictures:
    """The starter set's model of the paper's decoder, on some of its icons.

    Errors are of pictures from three sides. (The decoder rays computes no background at all.)
    """

    def __init__(self, settings: Settings) -> None:
        starter = DEFAULT_CHECKPOINT.parent
        checkpoint = starter / "tiny.safetensors"
        icons = sorted((starter / "icons").glob("*.png"))
        count = 1 if settings.level == "quick" else 8
        if not checkpoint.exists() or not icons:
            raise NotInstalled(f"{checkpoint.name} (of the repository)")
        self.model = load_model(checkpoint, settings.device)
        config = self.model.config
        size, self.device = config.image_size, settings.device
        chosen = icons[:: max(1, len(icons) // count)][:count]
        images = [composite(cut_out(path).rgba, size, config.background_color) for path in chosen]
        self.images = [image[None].to(self.device) for image in images]
        self.camera = reference_cameras(config, 1).to(self.device)
        around = orbit(torch.tensor([90.0, 180.0]), distance=config.distance)
        viewmats = torch.cat([reference_viewmat(config.distance)[None], around])
        K = intrinsics(size, size, config.fov).repeat(3, 1, 1)
        self.views = Cameras(viewmats, K, size, size).to(self.device)
        self.background = torch.full((3,), config.background_color, device=self.device)
        self.full = self.pictures(None)

    @torch.no_grad()
    def run(self, margin: int | None) -> list[Gaussians]:
        """Run the model on one picture after the other; timed."""
        return [self.model(x, self.camera, background_margin=margin)[0] for x in self.images]

    @torch.no_grad()
    def pictures(self, margin: int | None) -> Tensor:
        """Render the results of ``run`` from three sides: ``[pictures, 3, H, W, 3]``."""
        made = self.run(margin)
        return torch.stack([render(g, self.views, self.background).rgb for g in made])

    def check(self, margin: int | None) -> Error:
        """Measure the error of the rendered pictures to those of the full model."""
        return compare({"pictures": self.pictures(margin)}, {"pictures": self.full})

    def work(self, margin: int | None) -> dict[str, float]:
        """Count kept tokens and their share, and the PSNR to the full model's pictures, dB."""
        kept = sum(g.means.shape[-2] for g in self.run(margin))
        total = len(self.images) * self.model.config.num_gaussians
        difference = (self.pictures(margin) - self.full).square().mean().clamp_min(1e-12)
        psnr = -10 * difference.log10().item()
        return {"tokens": kept, "skipped": 1 - kept / total, "psnr_to_full": round(psnr, 1)}


def background_tokens(settings: Settings) -> list[Variant]:
    """Tokens of plain background dropped (``Gamba.forward``'s ``background_margin``), of
    ``starter/tiny.safetensors`` on the icons, one after the other. The error is that of pictures
    from three sides to those of the full model. The margin counts the patches beside the object
    that are kept. The model was trained with all tokens, and those of the background draw parts of
    the object, so none is dropped by default.
    """
    pictures = _Pictures(settings)
    made = []
    for margin in (None, 0) if settings.level == "quick" else (None, 6, 4, 3, 2, 1, 0):
        made.append(
            Variant(
                name="all tokens" if margin is None else f"margin {margin}",
                run=partial(pictures.run, margin),
                check=partial(pictures.check, margin),
                limit=1.0,
                oracle="the full model's pictures (not float64)",
                default=margin is None,
                work=partial(pictures.work, margin),
                parameters={"N": pictures.model.config.num_gaussians, "views": 3},
            )
        )
    return made
