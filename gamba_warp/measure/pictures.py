"""Benchmark cases of whole models, from pictures to Gaussians."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial

import torch
from torch import Tensor

from ..cameras import Cameras, intrinsics, orbit, reference_viewmat
from ..gaussians import Gaussians
from ..kernels.bench import Error, NotInstalled, Settings, Variant, compare
from ..model.checkpoint import load_model
from ..model.config import PRESETS, GambaConfig, Preset
from ..model.gamba import Gamba
from ..model.posing import reference_cameras
from ..render import render

_REPEATS = "a first run (0: the same bits); the blocks have the float64 oracle"


def without_encoder(config: GambaConfig) -> GambaConfig:
    """The configuration without an image encoder; where only its tokens are prepended, none are."""
    return replace(config, encoder="none", prepend=config.prepend and config.camera_token)


def _model(preset: Preset, settings: Settings, count: int) -> tuple[Gamba, Callable[[], Gaussians]]:
    """Makes a model with fresh weights and no image encoder, and its run on ``count`` pictures."""
    torch.manual_seed(0)
    config = without_encoder(PRESETS[preset])
    model = Gamba(config).to(settings.device).eval()
    size = config.image_size
    # Random alpha leaves no background, so that with "rays" every token is computed.
    images = torch.rand(count, size, size, config.input_channels).to(settings.device)
    cameras = reference_cameras(config, count).to(settings.device)
    return model, torch.no_grad()(partial(model, images, cameras))


def _check_repeats(run: Callable[[], Gaussians]) -> Error:
    first, second = ({k: x for k, x in vars(run()).items() if x is not None} for _ in range(2))
    return compare(second, first)


def pictures(settings: Settings) -> list[Variant]:
    """A posed picture to Gaussians by preset, without the image encoder. The models are whole and
    have fresh weights; two runs must give the same bits.
    """
    made = []
    for name in ("tiny", "rays") if settings.level == "quick" else PRESETS:
        model, run = _model(name, settings, 1)
        made.append(
            Variant(
                name=name,
                run=run,
                check=partial(_check_repeats, run),
                limit=0.0,
                oracle=_REPEATS,
                default=True,
                rounds=10,
                parameters={"N": model.config.num_gaussians, "side": model.config.image_size},
            )
        )
    return made


def batches(settings: Settings) -> list[Variant]:
    """Cost against the number of pictures in one call, preset tiny."""
    made = []
    for count in (1, 2) if settings.level == "quick" else (1, 2, 4, 8):
        model, run = _model("tiny", settings, count)
        made.append(
            Variant(
                name=f"{count} picture{'s' * (count > 1)}",
                run=run,
                check=partial(_check_repeats, run),
                limit=0.0,
                oracle=_REPEATS,
                parameters={"B": count, "N": model.config.num_gaussians},
            )
        )
    return made


class _Pictures:
    """The starter set's model of the paper's decoder, on some of its icons; errors are of pictures
    from three sides. (The decoder rays computes no background at all.)
    """

    def __init__(self, settings: Settings) -> None:
        # These are imported here because they need more packages than torch and warp, which
        # suffice for all other cases.
        try:
            import safetensors  # noqa: F401

            from ..data.preprocess import composite, prepare
            from ..model.checkpoint import DEFAULT_CHECKPOINT
        except ModuleNotFoundError as error:
            raise NotInstalled(str(error.name)) from None
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
        images = [composite(prepare(path), size, config.background_color) for path in chosen]
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
        """Runs the model on one picture after the other; this is what is timed."""
        return [self.model(x, self.camera, background_margin=margin)[0] for x in self.images]

    @torch.no_grad()
    def pictures(self, margin: int | None) -> Tensor:
        """Renders the results of ``run`` from three sides: ``[pictures, 3, H, W, 3]``."""
        made = self.run(margin)
        return torch.stack([render(g, self.views, self.background).rgb for g in made])

    def check(self, margin: int | None) -> Error:
        """Measures the error of the rendered pictures to those of the full model."""
        return compare({"pictures": self.pictures(margin)}, {"pictures": self.full})

    def work(self, margin: int | None) -> dict[str, float]:
        """Counts kept tokens and their share, and the PSNR to the full model's pictures, dB."""
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
