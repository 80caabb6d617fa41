"""Benchmark cases of the model: one block, the backbone, and a picture to Gaussians."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from ..kernels.bench import Case, Error, Key, NotInstalled, Settings, Target, Variant, compare
from ..kernels.causal_conv1d.reference import causal_conv1d_reference
from ..kernels.selective_scan.reference import selective_scan_reference
from ..model.block import GambaBlock, prefix_states
from ..model.config import PRESETS, GambaConfig
from ..model.gamba import SEGMENT
from .pictures import background_tokens, batches, pictures

BOTH = "forward+backward"
LIMIT, BACKWARD_LIMIT = 1e-5, 1e-4  # of the relative rms error to float64
_IMAGE_CHANNELS, _IMAGE_TOKENS = 768, 576  # of DINOv2 ViT-B/14 at 336 pixels
_TOKENS = 128  # that the oracle looks at
_PRODUCTS = {
    name: getattr(torch.ops.aten, name).default for name in ("mm", "addmm", "bmm", "baddbmm")
}


def cases(settings: Settings) -> list[Case]:
    """All cases of block and model at the level's sizes."""
    builders = [
        ("block", "one block", partial(_blocks, depth=1)),
        ("block", "backbone", partial(_blocks, depth=2 if settings.level == "quick" else 14)),
        ("block", "compiled", compiled),
        ("model", "one picture", pictures),
        ("model", "batch", batches),
        ("model", "background tokens", background_tokens),
    ]
    texts = {
        "one block": "A block of the paper's size on one picture's tokens, beside its matrix "
        "products alone, repeated on operands of the same shapes into given outputs. Prefix states "
        "off: condition prepended and dropped, as the paper has it. For one block alone that costs "
        "the same; the states of all blocks are computed at once, which pays over the depth "
        "(backbone).",
        "backbone": "All blocks of the paper's size, the condition's states included, beside "
        "their matrix products alone, and with the condition prepended and dropped in each block.",
    }
    axes = {"one block": "error", "backbone": "error", "compiled": "error", "batch": "B"}
    axes["background tokens"] = "error,skipped"
    return [
        Case(
            *(op, name, texts.get(name) or " ".join(build.__doc__.split())),
            *(partial(build, settings), axes.get(name)),
        )
        for op, name, build in builders
    ]


class _Recorder(TorchDispatchMode):
    """Notes the shapes of all matrix products."""

    def __init__(self) -> None:
        super().__init__()
        self.products: list[tuple[Callable, list[tuple]]] = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        if function in _PRODUCTS.values():
            operands = [x for x in args if isinstance(x, Tensor)]
            self.products.append((function, [(x.shape, x.stride(), x.dtype) for x in operands]))
        return function(*args, **(kwargs or {}))


class Products:
    """The matrix products of a run, to be repeated alone.

    Attributes:
        count: how many.
        flops: floating-point operations of all, a multiplication and an addition each.
    """

    def __init__(self, run: Callable[[], object], device: torch.device) -> None:
        with _Recorder() as recorder:
            run()
        self.count, self.flops = len(recorder.products), 0
        self._calls, self._device = [], device
        self._buffers: dict[tuple, Tensor] = {}
        for function, operands in recorder.products:
            tensors = [self._buffer(*operand, use=i) for i, operand in enumerate(operands)]
            a, b = tensors[-2:]
            shape = (*a.shape[:-1], b.shape[-1])
            self.flops += 2 * a.numel() * b.shape[-1]
            stride = torch.empty(shape, device="meta").stride()
            out = self._buffer(shape, stride, a.dtype, use=-1)
            name = function.overloadpacket.__name__
            self._calls.append(partial(getattr(torch, name), *tensors, out=out))

    def _buffer(self, shape, stride, dtype, use: int) -> Tensor:
        """Operands of one shape share their memory, as they come from the same allocator."""
        key = (tuple(shape), tuple(stride), dtype, use)
        if key not in self._buffers:
            x = torch.empty_strided(shape, stride, dtype=dtype, device=self._device)
            self._buffers[key] = x.normal_()
        return self._buffers[key]

    @torch.no_grad()
    def run(self) -> None:
        """Timed."""
        for call in self._calls:
            call()


class _Backbone:
    """Blocks of the paper's size with an image's condition."""

    def __init__(self, settings: Settings, depth: int) -> None:
        quick = settings.level == "quick"
        config = GambaConfig(dt_rank=8, width=128) if quick else PRESETS["paper"]
        torch.manual_seed(0)
        channels = _IMAGE_CHANNELS
        blocks = [GambaBlock(config, channels, channels) for _ in range(depth)]
        self.blocks = nn.ModuleList(blocks).to(settings.device)
        self.depth, self.device = depth, settings.device
        self.length = 1024 if quick else config.num_gaussians
        tokens = torch.randn(1, self.length, config.width)
        camera, image = torch.randn(1, 1, channels), torch.randn(1, _IMAGE_TOKENS, channels)
        self.tokens, self.camera, self.image = (x.to(self.device) for x in (tokens, camera, image))
        self.parameters = {"L": self.length, "D": config.width, "depth": depth}

    def run(self, tokens: Tensor) -> Tensor:
        """As the model does it: states of the prefix, then segments of tokens on a CPU."""
        states = prefix_states(self.blocks, self.camera, self.image)
        segments = [tokens]
        if self.device.type == "cpu" and not torch.is_grad_enabled():
            segments = list(tokens.split(SEGMENT, dim=1))
        for s, segment in enumerate(segments):
            for i, block in enumerate(self.blocks):
                segment, states[i] = block(segment, states[i])
            segments[s] = segment
        return torch.cat(segments, dim=1) if len(segments) > 1 else segments[0]

    @torch.no_grad()
    def forward(self) -> Tensor:
        """Timed."""
        return self.run(self.tokens)

    @torch.no_grad()
    def prepended(self) -> Tensor:
        """Timed: the paper's eq. 2 as it reads."""
        tokens = self.tokens
        for block in self.blocks:
            prefix = [block.project_camera(self.camera), block.project_image(self.image)]
            hidden, _ = block.mamba(block.norm(torch.cat([*prefix, tokens], dim=1)))
            tokens = tokens + hidden[:, -self.length :]
        return tokens

    def backward(self) -> tuple[Tensor, ...]:
        """Timed: forward and the gradients of tokens and weights; the tokens are the cotangent."""
        tokens = self.tokens.detach().requires_grad_()
        leaves = [tokens, *self.blocks.parameters()]
        return torch.autograd.grad(self.run(tokens), leaves, self.tokens)

    def check(self, forward: Callable[[], Tensor]) -> Error:
        """Error of what is added to the first tokens, which depend on no later one."""
        with torch.no_grad():
            got = forward()[:, :_TOKENS].double().cpu()
            first = tokens = self.tokens[:, :_TOKENS].double().cpu()
            for block in self.blocks:
                tokens = reference_block(block, tokens, self.camera, self.image)
        return compare({"update": got - first}, {"update": tokens - first})

    def check_backward(self) -> Error:
        """Error of the gradient of the first tokens, where the cotangent is 0 behind them."""
        tokens = self.tokens.detach().requires_grad_()
        cotangent = self.tokens.clone()
        cotangent[:, _TOKENS:] = 0
        (got,) = torch.autograd.grad(self.run(tokens), [tokens], cotangent)
        first = self.tokens[:, :_TOKENS].double().cpu().requires_grad_()
        out = first
        for block in self.blocks:
            out = reference_block(block, out, self.camera, self.image)
        (want,) = torch.autograd.grad(out, [first], first.detach())
        return compare(
            {"gradient of the tokens": got[:, :_TOKENS]}, {"gradient of the tokens": want}
        )


def reference_block(block: GambaBlock, tokens: Tensor, camera: Tensor, image: Tensor) -> Tensor:
    """One Gamba block in float64 torch on the CPU, prepending and dropping (paper eq. 2).

    Args:
        block: its weights are used.
        tokens: ``[B, L, width]`` float64.
        camera: ``[B, 1, channels]``.
        image: ``[B, K, channels]``.
    """
    weights = {name: p.detach().double().cpu() for name, p in block.named_parameters()}

    def linear(x: Tensor, name: str) -> Tensor:
        return F.linear(x, weights[f"{name}.weight"], weights.get(f"{name}.bias"))

    mamba, width = block.mamba, tokens.shape[2]
    prefix = [
        linear(camera.double().cpu(), "project_camera"),
        linear(image.double().cpu(), "project_image"),
    ]
    x = torch.cat([*prefix, tokens], dim=1)
    if isinstance(block.norm, nn.RMSNorm):
        x = F.rms_norm(x, (width,), weights["norm.weight"], block.norm.eps)
    else:
        x = F.layer_norm(x, (width,), weights["norm.weight"], weights["norm.bias"], block.norm.eps)
    x, z = linear(x, "mamba.in_proj").chunk(2, dim=-1)
    x, _ = causal_conv1d_reference(
        x, weights["mamba.conv_weight"], weights["mamba.conv_bias"], activation="silu"
    )
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


def _blocks(settings: Settings, depth: int) -> list[Variant]:
    backbone = _Backbone(settings, depth)
    products = Products(backbone.forward, settings.device)
    oracle = f"float64 with the condition prepended, first {_TOKENS} of {backbone.length} tokens"
    rounds = 3 if depth > 1 and settings.level == "normal" else None  # seconds each
    common = dict(oracle=oracle, parameters=backbone.parameters, rounds=rounds)
    made = [
        Variant(
            "default",
            backbone.forward,
            partial(backbone.check, backbone.forward),
            LIMIT,
            default=True,
            **common,
        ),
        Variant(
            "prefix states off",
            backbone.prepended,
            partial(backbone.check, backbone.prepended),
            LIMIT,
            **common,
        ),
        Variant(
            "matrix products alone",
            products.run,
            None,
            work=lambda: {"products": products.count, "flops": products.flops},
            parameters=backbone.parameters,
            rounds=rounds,
        ),
    ]
    if depth == 1:
        made.append(
            Variant(
                "default",
                backbone.backward,
                backbone.check_backward,
                BACKWARD_LIMIT,
                direction=BOTH,
                default=True,
                **common | {"oracle": oracle + ", gradient of these tokens"},
            )
        )
    return made


class _Graph:
    """A function's launches, recorded once and played again."""

    def __init__(self, function: Callable[[], Tensor]) -> None:
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):  # kernels are compiled and buffers made before
            for _ in range(3):
                function()
        torch.cuda.current_stream().wait_stream(stream)
        self._graph = torch.cuda.CUDAGraph()
        with torch.cuda.graph(self._graph):
            self._result = function()

    def __call__(self) -> Tensor:
        self._graph.replay()
        return self._result


class _Lazy:
    """Makes a function at its first call, so that what fails there fails alone."""

    def __init__(self, make: Callable[[], Callable[[], Tensor]]) -> None:
        self._make, self._function = make, None

    def __call__(self) -> Tensor:
        if self._function is None:
            self._function = self._make()
        return self._function()


def compiled(settings: Settings) -> list[Variant]:
    """A block of the paper's size as it is, through torch.compile, and on CUDA as a CUDA graph. The
    first call has the compilation; what it can join are a few elementwise operations between the
    products and our kernels, and no gain is to be seen: blocks are not compiled by default.
    """
    backbone = _Backbone(settings, 1)
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

    runs = {"as it is": plain}
    if settings.level != "quick":
        runs["torch.compile"] = _Lazy(compiled_block)
    if settings.device.type == "cuda":
        runs["CUDA graph"] = _Lazy(lambda: _Graph(plain))
    oracle = f"float64 with the condition prepended, first {_TOKENS} of {backbone.length} tokens"
    return [
        Variant(
            *(name, run, partial(backbone.check, run), LIMIT, oracle),
            default=run is plain,
            parameters=backbone.parameters,
        )
        for name, run in runs.items()
    ]


def targets(settings: Settings) -> list[Target]:
    """What should be reached; nothing at a quick run's sizes."""
    if settings.level == "quick":
        return []
    return [
        Target(
            f"{case}, time over that of its matrix products alone",
            (Key("block", case, "default"),),
            (Key("block", case, "matrix products alone"),),
            at_most=1.3,
        )
        for case in ("one block", "backbone")
    ]
