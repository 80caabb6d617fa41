"""Random and hostile cases of the model: an image to Gaussians against float64."""

from __future__ import annotations

from functools import partial

import torch
from torch import Tensor

from gamba_warp.cameras import Cameras, intrinsics, orbit, plucker_rays
from gamba_warp.kernels.cases.random_case import Op, Outcome, RandomCase, Runs, generator
from gamba_warp.kernels.cases.rounding import SAMPLES, Rounding, samples_of
from gamba_warp.kernels.cases.scan_oracle import EXP_ULPS, conv, scan
from gamba_warp.model.config import GambaConfig
from gamba_warp.model.gamba import Gamba
from gamba_warp.model.parts.block import GambaBlock
from gamba_warp.model.parts.decoder import MIN_SCALE
from gamba_warp.model.parts.prefix import prefix_states
from gamba_warp.model.parts.tokens import normalize_imagenet

KINDS = (
    "uniform", "white", "black", "checkerboard", "one pixel", "out of range", "tiny weights",
    "large weights", "long steps", "short steps", "slow decay", "fast decay", "saturated heads",
)  # fmt: skip
_BFLOAT16 = 2.0**16  # half the last bit of bfloat16, in last bits of float32
_IMAGE_CHANNELS = 6
OPTIONS = {
    "batch": (1, 2, 3),
    "patches": (1, 2, 3, 4),
    "patch_size": (1, 2, 4),
    "width": (1, 4, 8, 12, 16, 20, 24),
    "depth": (1, 1, 2, 3),
    "state_size": (1, 2, 4, 5, 16),
    "conv_size": (2, 3, 4, 4),
    "expand": (1, 2, 2),
    "dt_rank": (1, 2, 3),
    "norm": ("rms", "layer"),
    "discretization": ("mamba", "mamba", "bilinear", "zoh"),
    "additive_image_tokens": (False, *[True] * 4),
    "camera_token": (False, True, True),
    "image_tokens": (0, 1, 3, 9),
    "predict_rotation": (False, False, True),
    "position_bins": (2, 5, 21),
    "autocast": (False, False, True),
}


def build(case: RandomCase, device: torch.device) -> tuple[Gamba, dict[str, Tensor], Cameras]:
    """Build the model, its differentiable inputs by name, and the cameras."""
    o, kind = case.options, case.kind
    with torch.random.fork_rng(devices=[]):
        torch.manual_seed(case.seed)
        others = "batch", "patches", "image_tokens", "autocast"
        config = GambaConfig(
            **{k: v for k, v in o.items() if k not in others},
            image_size=o["patches"] * o["patch_size"],
            encoder="none",
            prepend=o["camera_token"],
        )
        model = Gamba(config)
        if o["image_tokens"]:  # blocks with image tokens but without an encoder
            camera = config.width if config.camera_token else 0
            blocks = (GambaBlock(config, camera, _IMAGE_CHANNELS) for _ in range(config.depth))
            model.blocks = torch.nn.ModuleList(blocks)
        _change(model, kind)
        size, batch = config.image_size, o["batch"]
        images = torch.rand(batch, size, size, 3)
        angles = 360 * torch.rand(batch)
    if kind in ("white", "black"):
        images = torch.full_like(images, float(kind == "white"))
    elif kind == "checkerboard":
        lines = torch.arange(size)
        images = images * 0 + ((lines[:, None] + lines) % 2)[:, :, None]
    elif kind == "one pixel":
        images = torch.zeros_like(images)
        images[:, 0, 0] = 1
    elif kind == "out of range":
        images = images * 1e3
    inputs = {"images": images}
    if o["image_tokens"]:
        shape = batch, o["image_tokens"], _IMAGE_CHANNELS
        inputs["image_tokens"] = 3 * torch.randn(shape, generator=generator(case, "tokens"))
    inputs = {k: x.to(device).requires_grad_() for k, x in inputs.items()}
    cameras = Cameras(orbit(angles, 20.0), intrinsics(size, size).repeat(batch, 1, 1), size, size)
    return model.to(device), inputs, cameras.to(device)


@torch.no_grad()
def _change(model: Gamba, kind: str) -> None:
    """Perturb every parameter, then apply the changes of the kind."""
    for parameter in model.parameters():
        parameter += 0.05 * torch.randn_like(parameter)
        if kind in ("tiny weights", "large weights"):
            parameter *= 1e-3 if kind == "tiny weights" else 4.0
    for block in model.blocks:
        assert isinstance(block, GambaBlock)
        mamba = block.mamba
        mamba.dt_proj.bias.add_({"long steps": 8.0, "short steps": -25.0}.get(kind, 0.0))
        mamba.A_log.add_({"slow decay": -14.0, "fast decay": 7.0}.get(kind, 0.0))
    if kind == "saturated heads":
        for head in (model.decoder.position, model.decoder.opacity, model.decoder.scale):
            head.weight *= 300


class _Oracle:
    """The network in float64 from its parameters, per sample, with the condition prepended."""

    def __init__(self, case: RandomCase, model: Gamba, trial: int) -> None:
        self.config, self.r = model.config, Rounding(case.seed, trial)
        self.ulps = _BFLOAT16 if case.options["autocast"] else 1.0
        self.weights = {k: samples_of(p) for k, p in model.named_parameters()}
        self.orders = model.tokens.orders.cpu()

    def linear(self, x: Tensor, name: str, ulps: float | None = None) -> Tensor:
        """Apply a linear layer to ``x [S, B, .., in]``, and round operands and result."""
        ulps = self.ulps if ulps is None else ulps
        W, bias = self.weights[f"{name}.weight"], self.weights.get(f"{name}.bias")
        axes = (1,) * (x.dim() - 3)
        W = self.r(W, ulps, ulps).reshape(len(W), *axes, *W.shape[1:])
        y = self.r(self.r(x, ulps, ulps) @ W.mT, ulps, ulps)
        if bias is None:
            return y
        bias = self.r(bias, ulps, ulps).reshape(len(bias), *axes, 1, -1)  # rounded like W
        return self.r(y + bias, ulps, ulps)

    def norm(self, x: Tensor, name: str) -> Tensor:
        """Apply the configuration's norm.

        The gradient is the sum of a direct term and one through the mean, each rounded.
        """
        r, x = self.r, self.r(x)
        own = lambda x: r.stored(x, torch.float32)  # noqa: E731
        if self.config.norm == "layer":
            x = r(own(x) - r(own(x).mean(-1, keepdim=True)))
        square = r(own(x).square().mean(-1, keepdim=True) + 1e-5)
        x = r(own(x) * r(square.rsqrt()), 4.0)
        x = x * self.weights[f"{name}.weight"][:, None, None]
        bias = self.weights.get(f"{name}.bias")
        return self.r(x if bias is None else x + bias[:, None, None])

    def silu(self, x: Tensor) -> Tensor:
        """Apply the activation."""
        return self.r(x * self.r.sigmoid(x, EXP_ULPS), self.ulps)

    def tokens(self, images: Tensor, cameras: Cameras) -> Tensor:
        """Compute the 3DGS tokens."""
        r, embedding = self.r, self.r(self.weights["tokens.embedding"])[:, None]
        if not self.config.additive_image_tokens:
            return embedding.expand(-1, images.shape[1], -1, -1)
        viewmats, Ks = cameras.viewmats.cpu().double(), cameras.Ks.cpu().double()
        rays = plucker_rays(viewmats, Ks, cameras.width, cameras.height)
        rays = rays.expand(SAMPLES, *rays.shape)
        rays = r.rounded(rays + 2, 4.0) - 2  # differences of products of size 2
        pixels = torch.cat([r(normalize_imagenet(images)), rays], -1)
        size, grid = self.config.patch_size, self.config.grid_size
        patches = pixels.unflatten(2, (grid, size)).unflatten(4, (grid, size))
        patches = patches.permute(0, 1, 2, 4, 6, 3, 5).flatten(4).flatten(2, 3)
        weight = self.weights["tokens.patchify.weight"].flatten(2)
        x = r(patches, self.ulps) @ r(weight, self.ulps, self.ulps)[:, None].mT
        bias = r(self.weights["tokens.patchify.bias"], self.ulps, self.ulps)
        x = r(x + bias[:, None, None], self.ulps, self.ulps)
        return r(x[:, :, self.orders] + embedding)

    def mamba(self, x: Tensor, name: str) -> Tensor:
        """Run one Mamba block over ``[S, B, L, width]``."""
        r, w = self.r, {k: self.weights[f"{name}.{k}"] for k in (
            "conv_weight", "conv_bias", "A_log", "D", "dt_proj.bias"
        )}  # fmt: skip
        x, z = self.linear(x, f"{name}.in_proj").chunk(2, dim=-1)
        parts = {"x": x, "weight": w["conv_weight"], "bias": w["conv_bias"], "initial_state": None}
        x = r(conv(parts, True, torch.float32, r)[0], self.ulps, self.ulps)
        rank, n = self.config.step_rank, self.config.state_size
        low, B, C = self.linear(x, f"{name}.x_proj").split([rank, n, n], dim=-1)
        dt = self.r(self.weights[f"{name}.dt_proj.weight"], self.ulps, self.ulps)[:, None]
        delta = r(r(low, self.ulps) @ dt.mT, self.ulps, self.ulps)
        parts = {
            "u": x, "delta": delta, "A": r(-torch.exp(r(w["A_log"]))), "B": B[:, :, :, None],
            "C": C[:, :, :, None], "D": w["D"], "z": z, "delta_bias": w["dt_proj.bias"],
            "initial_state": None,
        }  # fmt: skip
        y, _ = scan(parts, True, self.config.discretization, r)
        return self.linear(r(y, self.ulps, self.ulps), f"{name}.out_proj")

    def run(self, inputs: dict[str, Tensor], cameras: Cameras) -> dict[str, Tensor]:
        """Compute the Gaussians' attributes, by name."""
        tokens, prefix = self.tokens(inputs["images"], cameras), []
        if self.config.prepend:
            numbers = torch.cat([
                cameras.viewmats[:, :3].flatten(1), cameras.Ks.diagonal(dim1=1, dim2=2)[:, :2] /
                cameras.width, cameras.Ks[:, :2, 2] / cameras.width,
            ], 1).cpu().double()  # fmt: skip
            x = numbers[:, None].expand(SAMPLES, -1, -1, -1)
            x = self.silu(self.linear(x, "camera_token.mlp.0"))
            prefix.append((self.linear(x, "camera_token.mlp.2"), "project_camera"))
        if "image_tokens" in inputs:
            prefix.append((inputs["image_tokens"], "project_image"))
        for i in range(self.config.depth):
            front = [self.linear(x, f"blocks.{i}.{name}") for x, name in prefix]
            whole = self.norm(torch.cat([*front, tokens], 2), f"blocks.{i}.norm")
            hidden = self.mamba(whole, f"blocks.{i}.mamba")
            tokens = self.r(tokens + hidden[:, :, -tokens.shape[2] :])
        return self.decode(self.norm(tokens, "norm"))

    def decode(self, x: Tensor) -> dict[str, Tensor]:
        """Apply the decoder to the normalised tokens."""
        r, config = self.r, self.config
        x = self.silu(self.linear(x, "decoder.mlp.0"))
        x = self.silu(self.linear(x, "decoder.mlp.2"))
        heads = {k: self.linear(x, f"decoder.{k}", 1.0) for k in (
            "position", "opacity", "scale", "color"
        )}  # fmt: skip
        points = torch.linspace(-config.position_range, config.position_range, config.position_bins)
        # The softmax is split into steps, because its gradient cancels where it saturates.
        logits = heads["position"].unflatten(-1, (3, -1))
        powers = r.exp(r(logits - logits.detach().amax(-1, keepdim=True)), EXP_ULPS)
        fraction = r(powers / r(powers.sum(-1, keepdim=True)))
        made = {
            "means": r(r(fraction * points.double()).sum(-1)),
            "scales": r(r.softplus(heads["scale"], EXP_ULPS) + MIN_SCALE),
            "opacities": r.sigmoid(heads["opacity"], EXP_ULPS)[..., 0],
            "colors": r.sigmoid(heads["color"], EXP_ULPS),
        }
        if config.predict_rotation:
            made["quats"] = self.linear(x, "decoder.rotation", 1.0)
        return made


def _run(model: Gamba, o: dict, inputs: dict, cameras: Cameras) -> dict[str, Tensor]:
    with torch.autocast(inputs["images"].device.type, torch.bfloat16, enabled=o["autocast"]):
        condition = None
        if o["image_tokens"]:
            camera = model.camera_token(cameras) if model.camera_token else None
            condition = prefix_states(model.blocks, camera, inputs["image_tokens"])
        gaussians = model(inputs["images"], cameras, condition)
    return gaussians.tensors()


def evaluate(case: RandomCase, device: torch.device, trial: int = 0) -> Outcome:
    """Run the model, and check all attributes and the gradients of all parameters and inputs."""
    model, inputs, cameras = build(case, device)
    leaves = inputs | dict(model.named_parameters())
    oracle = _Oracle(case, model, trial)
    samples = {k: samples_of(x) for k, x in inputs.items()}
    expected = oracle.run(samples, cameras)
    run = partial(_run, model, case.options, inputs, cameras)
    runs = Runs(case, run, leaves, expected, samples | oracle.weights)
    sizes = {k: x.dim() for k, x in (*leaves.items(), *runs.results.items())}
    return runs.outcome({k: tuple(range(n)) for k, n in sizes.items()})


OP = Op("model", dict.fromkeys(KINDS, {}), OPTIONS, dict, evaluate)
