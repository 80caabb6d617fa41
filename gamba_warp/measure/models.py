"""Benchmark of whole models: an image to Gaussians, and the blocks against float64."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from functools import partial
from typing import TypeVar

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ..errors import UserError
from ..files import STARTER
from ..gaussians import Gaussians
from ..kernels.bench import raster
from ..kernels.bench.measure import (
    Settings,
    Table,
    Variant,
    difference,
    saved_bytes,
    synchronize,
    variant,
)
from ..kernels.cases.case import BOTH, DIRECTIONS, Case, Error, compare
from ..kernels.cases.raster import LEAVES, orbit_cameras, raster_case
from ..kernels.causal_conv1d.reference import causal_conv1d_reference
from ..kernels.selective_scan.reference import selective_scan_reference
from ..model.config import PRESETS, GambaConfig
from ..model.gamba import Gamba
from ..model.parts.attention import AttentionBlock
from ..model.parts.block import GambaBlock, run_blocks
from ..model.parts.prefix import prefix_states
from ..model.posing import reference_cameras

Result = TypeVar("Result")
# Allowed relative rms error of blocks to float64; what they add to tokens is a hundredth of these.
LIMITS = dict.fromkeys(DIRECTIONS, 1e-7)
# Under capture torch may choose other kernels for a matrix product, and then the results differ by
# the dtype's rounding.
GRAPH_LIMITS = {torch.float32: 1e-4, torch.bfloat16: 1e-2}
HALF_LIMIT = 0.03  # allowed error of bfloat16 to float32 in the worst attribute; a CPU has 0.007
_IMAGE_CHANNELS, _IMAGE_TOKENS = 768, 576  # as of DINOv2 ViT-B/14 at 336 pixels
TOKENS = 128  # number of first tokens compared with the oracle


def tables(settings: Settings) -> list[Table]:
    """Return the tables of models."""
    builders = {"backbone": backbone, "mixers": mixers}
    builders |= {"one image": images, "skipping": skipping}
    tables = [Table("model", name, build) for name, build in builders.items()]
    graphs = [Table("model", "CUDA graph", cuda_graphs)]
    return tables + graphs * (settings.device.type == "cuda")


def blocks_case(settings: Settings, depth: int) -> Case:
    """Return blocks of the paper's size with the condition of one image, run as ``Gamba`` does."""
    quick = settings.level == "quick"
    config = GambaConfig(dt_rank=8, width=128) if quick else PRESETS["paper"]
    torch.manual_seed(0)
    blocks = [
        GambaBlock(config, _IMAGE_CHANNELS, _IMAGE_CHANNELS).to(settings.device)
        for _ in range(depth)
    ]
    length = 1024 if quick else config.num_gaussians
    shapes = (length, config.width), (1, _IMAGE_CHANNELS), (_IMAGE_TOKENS, _IMAGE_CHANNELS)
    tokens, *condition = (torch.randn(1, *shape) for shape in shapes)
    camera, image = (x.to(settings.device) for x in condition)

    def function(tokens: Tensor, prepend: bool = False) -> Tensor:
        if not prepend:
            return run_blocks(blocks, tokens, prefix_states(blocks, camera, image))
        for block in blocks:  # the paper's eq. 2 literally, prepending and dropping
            assert block.project_camera is not None and block.project_image is not None
            prefix = [block.project_camera(camera), block.project_image(image)]
            hidden, _ = block.mamba(block.norm(torch.cat([*prefix, tokens], dim=1)))
            tokens = tokens + hidden[:, -length:]
        return tokens

    def reference(tokens: Tensor) -> Tensor:
        for block in blocks:
            tokens = _reference_block(block, tokens, camera, image)
        return tokens

    first = dict.fromkeys(("tokens", "out"), (slice(None), slice(TOKENS)))
    return Case(
        function,
        reference,
        {"tokens": tokens},
        tokens,
        settings.device,
        f"float64 with the condition prepended, first {TOKENS} of {length} tokens",
        {"L": length, "D": config.width, "depth": depth},
        LIMITS,
        part=dict.fromkeys(DIRECTIONS, first),
        parameters=[p for block in blocks for p in block.parameters()],
    )


def _reference_block(block: GambaBlock, tokens: Tensor, camera: Tensor, image: Tensor) -> Tensor:
    """Run one Gamba block in float64 torch on the CPU, prepending and dropping (paper eq. 2).

    Args:
        block: with the weights.
        tokens: ``[B, L, width]`` float64.
        camera: ``[B, 1, channels]``.
        image: ``[B, K, channels]``.

    Returns:
        ``[B, L, width]`` float64.
    """
    weights = {name: p.detach().double().cpu() for name, p in block.named_parameters()}

    def linear(x: Tensor, name: str) -> Tensor:
        return F.linear(x, weights[f"{name}.weight"], weights.get(f"{name}.bias"))

    mamba, width = block.mamba, tokens.shape[2]
    conditions = {"project_camera": camera, "project_image": image}
    prefix = [linear(x.double().cpu(), name) for name, x in conditions.items()]
    x = torch.cat([*prefix, tokens], dim=1)
    if isinstance(block.norm, nn.RMSNorm):
        x = F.rms_norm(x, (width,), weights["norm.weight"], block.norm.eps)
    else:
        x = F.layer_norm(x, (width,), weights["norm.weight"], weights["norm.bias"], block.norm.eps)
    x, z = linear(x, "mamba.in_proj").chunk(2, dim=-1)
    conv = weights["mamba.conv_weight"], weights["mamba.conv_bias"]
    x, _ = causal_conv1d_reference(x, *conv, activation="silu")
    low_rank, B, C = linear(x, "mamba.x_proj").split(mamba.split, dim=-1)
    y, _ = selective_scan_reference(
        x,
        linear(low_rank, "mamba.dt_proj"),
        -torch.exp(weights["mamba.A_log"]),
        B,
        C,
        D=weights["mamba.D"],
        z=z,
        delta_softplus=True,
        discretization=mamba.discretization,
    )
    return tokens + linear(y, "mamba.out_proj")[:, -tokens.shape[1] :]


def backbone(settings: Settings) -> list[Variant]:
    """One block and all blocks of the paper's size on one image's tokens. Prefix states off:
    condition prepended and dropped in each block, as the paper has it.
    """
    variants = []
    for depth in (1, 2 if settings.level == "quick" else 14):
        blocks, rounds = blocks_case(settings, depth), 3 if depth > 2 else None
        name = f"{depth} block{'s' * (depth > 1)}"
        variants.append(variant(blocks, name, default=True, rounds=rounds))
        prepended = replace(blocks, function=partial(blocks.function, prepend=True))
        variants.append(variant(prepended, f"{name}, prefix states off", rounds=rounds))
        if depth == 1:
            variants.append(variant(blocks, name, BOTH, default=True))
    return variants


def mixers(settings: Settings) -> list[Variant]:
    """The paper's question Q2: a Mamba block and a transformer block with torch's fused attention,
    of the same width, over the number of tokens. Saved: tensors that a forward pass keeps for its
    gradient. The check is a second run.
    """
    lengths = {"quick": (256, 512), "normal": (1024, 4096), "full": (4096, 16384, 65536)}
    config, variants = replace(PRESETS["tiny"], width=256), []
    for length in lengths[settings.level]:
        tokens = torch.randn(1, length, config.width)
        for name, kind in (("Mamba", GambaBlock), ("transformer", AttentionBlock)):
            torch.manual_seed(0)
            block = kind(config, 0, 0).to(settings.device)
            case = Case(
                partial(block, state=None),
                partial(block, state=None),
                {"tokens": tokens},
                tokens,
                settings.device,
                "a second run (0: the same bits)",
                {"L": length, "D": config.width},
                dict.fromkeys(DIRECTIONS, 1e-4),  # products may be added in another order
                parameters=[*block.parameters()],
            )
            for direction in DIRECTIONS:
                check = partial(difference, case, case, direction)
                title = f"{name}, {length} tokens"
                variants.append(variant(case, title, direction, rounds=3, check=check))
                variants[-1].peer = name == "transformer"
            variants[-1].work = partial(_saved, case)
    return variants


def _saved(case: Case) -> dict[str, int]:
    leaves = case.leaves()
    return {
        "saved_bytes": saved_bytes(lambda: case.call(leaves), [*leaves.values(), *case.parameters])
    }


def without_encoder(config: GambaConfig) -> GambaConfig:
    """Return the configuration without an image encoder and its prepended tokens."""
    return replace(config, encoder="none", prepend=config.prepend and config.camera_token)


def captured(
    run: Callable[[], Result], device: torch.device
) -> tuple[torch.cuda.CUDAGraph, Result]:
    """Capture a function as a CUDA graph.

    Returns:
        The graph, and the function's result, which each ``replay`` overwrites.
    """
    stream = torch.cuda.Stream(device)
    stream.wait_stream(torch.cuda.current_stream(device))
    with torch.cuda.stream(stream):  # warm-up before the capture
        for _ in range(3):
            run()
    torch.cuda.current_stream(device).wait_stream(stream)
    graph = torch.cuda.CUDAGraph()
    with torch.cuda.graph(graph):
        result = run()
    return graph, result


class Inference:
    """A model with a posed image on its device, run eagerly or by a CUDA graph."""

    def __init__(self, model: Gamba, device: torch.device) -> None:
        self.model, self.device = model.to(device).eval(), device
        size, channels = model.config.image_size, model.config.input_channels
        # With random alpha there is no background, so the decoder "rays" computes every token.
        g = torch.Generator().manual_seed(1)
        self.image = torch.rand((1, size, size, channels), generator=g).to(device)
        self.cameras = reference_cameras(model.config, 1).to(device)
        self.sizes = {"N": model.config.num_gaussians, "side": size}
        self._graphs: dict[torch.dtype, tuple] = {}

    @torch.no_grad()
    def eager(self, dtype: torch.dtype = torch.float32) -> Gaussians:
        """Run the model's forward; bfloat16 means autocast."""
        mixed = dtype != torch.float32
        with torch.autocast(self.device.type, torch.bfloat16, enabled=mixed, cache_enabled=False):
            return self.model(self.image, self.cameras)

    def graph(self, dtype: torch.dtype) -> Gaussians:
        """Run the same by a CUDA graph, which the first call captures."""
        if dtype not in self._graphs:
            self._graphs[dtype] = captured(partial(self.eager, dtype), self.device)
        graph, result = self._graphs[dtype]
        graph.replay()
        return result

    def check(self, run: Callable[[], Gaussians], dtype: torch.dtype = torch.float32) -> Error:
        """Measure the error of the Gaussians of ``run`` against ``eager``'s in ``dtype``."""
        got = run()
        synchronize(self.device)
        return compare(got.tensors(), self.eager(dtype).tensors())


def images(settings: Settings) -> list[Variant]:
    """A posed image to Gaussians by preset, without the image encoder. The models are whole and
    have fresh weights; two runs must give the same bits.
    """
    variants = []
    for name in ("tiny", "rays") if settings.level == "quick" else PRESETS:
        torch.manual_seed(0)
        model = Inference(Gamba(without_encoder(PRESETS[name])), settings.device)
        check = partial(model.check, model.eager)
        oracle = "a second run (0: the same bits); the blocks have the float64 oracle"
        variants.append(Variant(name, model.eager, check, 0.0, oracle, default=True, rounds=10))
        variants[-1].parameters = model.sizes
    return variants


def skipping(settings: Settings) -> list[Variant]:
    """Work left out in one view of the Gaussians that the shipped model predicts from an image:
    each switch of ``Skip`` off alone, and all off.
    """
    from ..model.checkpoint import load_model  # which need more packages than the other tables
    from ..model.predict import reconstruct

    image = STARTER / "icons" / "blendswap-cc-0-teddybear.png"
    predicted = reconstruct(load_model(), image).map(torch.clone)  # no tensors of inference
    gaussians = {name: getattr(predicted, name) for name in LEAVES}
    size = 256 if settings.level == "quick" else 512
    scene = raster_case(gaussians, orbit_cameras(1, size), size, settings.device)
    return [v for x in DIRECTIONS for v in raster.switches(scene, "the model's output", x)]


def cuda_graphs(settings: Settings) -> list[Variant]:
    """The paper's model, with its untrained encoder if timm is installed: a posed image to
    Gaussians launch by launch, and by a CUDA graph.
    """
    torch.manual_seed(0)
    config = PRESETS["paper"]
    if settings.level == "quick":
        config = replace(config, image_size=32, patch_size=4, width=64, depth=2, dt_rank=4)
    try:
        model, encoder = Gamba(config, "random"), config.encoder
    except (ImportError, UserError):
        model, encoder = Gamba(without_encoder(config)), "none"
    inference, full, half = Inference(model, settings.device), torch.float32, torch.bfloat16
    eager, graph = inference.eager, inference.graph
    # Name: function and dtype; dtype, limit and name of the run that it is compared with.
    runs = {
        "eager, float32": (eager, full, full, 0.0, "a second run"),
        "eager, bfloat16": (eager, half, full, HALF_LIMIT, "float32"),
        "CUDA graph, float32": (graph, full, full, GRAPH_LIMITS[full], "eager"),
        "CUDA graph, bfloat16": (graph, half, half, GRAPH_LIMITS[half], "eager, bfloat16"),
    }
    variants = []
    for name, (function, dtype, expected, limit, oracle) in runs.items():
        run = partial(function, dtype)
        check = partial(inference.check, run, expected)
        variants.append(Variant(name, run, check, limit, f"{oracle} (0: the same bits)"))
        variants[-1].dtype = str(dtype).removeprefix("torch.")
        variants[-1].default = name == "CUDA graph, bfloat16"
        variants[-1].parameters = inference.sizes | {"encoder": encoder}
    return variants
