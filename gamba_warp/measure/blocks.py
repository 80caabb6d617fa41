"""Benchmark cases of the blocks, and the list of all cases of blocks and models."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn
from torch.utils._python_dispatch import TorchDispatchMode

from ..devices import network_products
from ..kernels.bench import Case, Error, Key, NotInstalled, Settings, Target, Variant, compare
from ..kernels.causal_conv1d.reference import causal_conv1d_reference
from ..kernels.selective_scan.reference import selective_scan_reference
from ..model.config import PRESETS, GambaConfig
from ..model.parts.block import GambaBlock, prefix_states, run_blocks
from .pictures import background_tokens, batches, pictures

BOTH = "forward+backward"
LIMIT, BACKWARD_LIMIT = 1e-5, 1e-4  # allowed relative rms error to float64
_IMAGE_CHANNELS, _IMAGE_TOKENS = 768, 576  # those of DINOv2 ViT-B/14 at 336 pixels
_TOKENS = 128  # number of first tokens that are compared with the oracle
_PRODUCTS = {
    name: getattr(torch.ops.aten, name).default for name in ("mm", "addmm", "bmm", "baddbmm")
}


def cases(settings: Settings) -> list[Case]:
    """Returns all cases of blocks and models at the level's sizes."""
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
    axes |= {"background tokens": "error,skipped"}
    return [
        Case(
            op=op,
            name=name,
            text=texts.get(name) or " ".join(build.__doc__.split()),
            build=partial(build, settings),
            axis=axes.get(name),
        )
        for op, name, build in builders
    ]


class _Recorder(TorchDispatchMode):
    """Records the shapes of all matrix products."""

    def __init__(self) -> None:
        super().__init__()
        self.products: list[tuple[Callable, list[tuple]]] = []

    def __torch_dispatch__(self, function, types, args=(), kwargs=None):
        if function in _PRODUCTS.values():
            operands = [x for x in args if isinstance(x, Tensor)]
            self.products.append((function, [(x.shape, x.stride(), x.dtype) for x in operands]))
        return function(*args, **(kwargs or {}))


class Products:
    """The matrix products of a run, recorded so that they can be repeated alone.

    Attributes:
        count: number of products.
        flops: floating-point operations of all; a multiplication and an addition count as two.
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
        """Returns a tensor of this shape; operands of the same shape and position share one."""
        key = (tuple(shape), tuple(stride), dtype, use)
        if key not in self._buffers:
            x = torch.empty_strided(shape, stride, dtype=dtype, device=self._device)
            self._buffers[key] = x.normal_()
        return self._buffers[key]

    @torch.no_grad()
    def run(self) -> None:
        """Repeats all products, by the library that the model takes; this is what is timed."""
        with network_products(self._device):
            for call in self._calls:
                call()


class _Backbone:
    """Blocks of the paper's size with the condition of one image."""

    def __init__(self, settings: Settings, depth: int) -> None:
        quick = settings.level == "quick"
        config = GambaConfig(dt_rank=8, width=128) if quick else PRESETS["paper"]
        torch.manual_seed(0)
        channels = _IMAGE_CHANNELS
        blocks = (GambaBlock(config, channels, channels) for _ in range(depth))
        self.blocks = [block.to(settings.device) for block in blocks]
        self.depth, self.device = depth, settings.device
        self.length = 1024 if quick else config.num_gaussians
        tokens = torch.randn(1, self.length, config.width)
        camera, image = torch.randn(1, 1, channels), torch.randn(1, _IMAGE_TOKENS, channels)
        self.tokens, self.camera, self.image = (x.to(self.device) for x in (tokens, camera, image))
        self.parameters = {"L": self.length, "D": config.width, "depth": depth}

    def run(self, tokens: Tensor) -> Tensor:
        """Runs the blocks as ``Gamba.forward`` does: first the prefix states, then the tokens."""
        with network_products(self.device):
            states = prefix_states(self.blocks, self.camera, self.image)
            return run_blocks(self.blocks, tokens, states)

    @torch.no_grad()
    def forward(self) -> Tensor:
        """Runs the blocks without gradients; this is what is timed."""
        return self.run(self.tokens)

    @torch.no_grad()
    def prepended(self) -> Tensor:
        """Runs the paper's eq. 2 as it reads, prepending and dropping; this is timed too."""
        tokens = self.tokens
        with network_products(self.device):
            for block in self.blocks:
                assert block.project_camera is not None and block.project_image is not None
                prefix = [block.project_camera(self.camera), block.project_image(self.image)]
                hidden, _ = block.mamba(block.norm(torch.cat([*prefix, tokens], dim=1)))
                tokens = tokens + hidden[:, -self.length :]
        return tokens

    def backward(self) -> tuple[Tensor, ...]:
        """Runs forward and backward, with the tokens as cotangent; this is timed too.

        The gradients are those of the tokens and of all weights.
        """
        tokens = self.tokens.detach().requires_grad_()
        leaves = [tokens, *(p for block in self.blocks for p in block.parameters())]
        with network_products(self.device):
            return torch.autograd.grad(self.run(tokens), leaves, self.tokens)

    def check(self, forward: Callable[[], Tensor]) -> Error:
        """Measures the error of what is added to the first tokens, which depend on no later one."""
        with torch.no_grad():
            got = forward()[:, :_TOKENS].double().cpu()
            first = tokens = self.tokens[:, :_TOKENS].double().cpu()
            for block in self.blocks:
                tokens = reference_block(block, tokens, self.camera, self.image)
        return compare({"update": got - first}, {"update": tokens - first})

    def check_backward(self) -> Error:
        """Measures the error of the first tokens' gradient, with a cotangent of 0 behind them."""
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


def reference_block(
    block: GambaBlock, tokens: Tensor, camera: Tensor | None, image: Tensor | None
) -> Tensor:
    """Runs one Gamba block in float64 torch on the CPU, prepending and dropping (paper eq. 2).

    Args:
        block: the block whose weights are used.
        tokens: ``[B, L, width]`` float64.
        camera: ``[B, 1, channels]``; None for a block without this condition.
        image: ``[B, K, channels]``, or None likewise.

    Returns:
        ``[B, L, width]`` float64.
    """
    weights = {name: p.detach().double().cpu() for name, p in block.named_parameters()}

    def linear(x: Tensor, name: str) -> Tensor:
        return F.linear(x, weights[f"{name}.weight"], weights.get(f"{name}.bias"))

    mamba, width = block.mamba, tokens.shape[2]
    conditions = {"project_camera": camera, "project_image": image}
    prefix = [linear(x.double().cpu(), name) for name, x in conditions.items() if x is not None]
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
    rounds = 3 if depth > 1 and settings.level == "normal" else None  # one takes seconds
    common: dict[str, Any] = dict(parameters=backbone.parameters, rounds=rounds)
    checked: dict[str, Any] = dict(oracle=oracle, limit=LIMIT)
    made = [
        Variant(
            name="default",
            run=backbone.forward,
            check=partial(backbone.check, backbone.forward),
            default=True,
            **checked,
            **common,
        ),
        Variant(
            name="prefix states off",
            run=backbone.prepended,
            check=partial(backbone.check, backbone.prepended),
            **checked,
            **common,
        ),
        Variant(
            name="matrix products alone",
            run=products.run,
            check=None,
            work=lambda: {"products": products.count, "flops": products.flops},
            **common,
        ),
    ]
    if depth == 1:
        made.append(
            Variant(
                name="default",
                run=backbone.backward,
                check=backbone.check_backward,
                limit=BACKWARD_LIMIT,
                oracle=f"{oracle}, gradient of these tokens",
                direction=BOTH,
                default=True,
                **common,
            )
        )
    return made


class _Graph:
    """A function's CUDA launches, captured once; a call replays them."""

    def __init__(self, function: Callable[[], Tensor]) -> None:
        stream = torch.cuda.Stream()
        stream.wait_stream(torch.cuda.current_stream())
        with torch.cuda.stream(stream):  # the capture must find kernels compiled and buffers made
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
    """Makes a function at its first call, so that a failure there spoils no other variant."""

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
            name=name,
            run=run,
            check=partial(backbone.check, run),
            limit=LIMIT,
            oracle=oracle,
            default=run is plain,
            parameters=backbone.parameters,
        )
        for name, run in runs.items()
    ]


def targets(settings: Settings) -> list[Target]:
    """Returns the targets; there are none at a quick run's sizes."""
    if settings.level == "quick":
        return []
    return [
        Target(
            text=f"{case}, time over that of its matrix products alone",
            times=(Key("block", case, "default"),),
            over=(Key("block", case, "matrix products alone"),),
            at_most=1.3,
        )
        for case in ("one block", "backbone")
    ]
