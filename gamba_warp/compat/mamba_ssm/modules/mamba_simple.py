"""Mamba-1 layer with mamba-ssm's arguments, attributes and names of weights."""

from __future__ import annotations

import math

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ....kernels.causal_conv1d import causal_conv1d
from ....kernels.selective_scan import selective_scan
from ...causal_conv1d import causal_conv1d_update
from ...shared import DTYPES, check_tensor, one_of
from ..ops.triton.selective_state_update import selective_state_update
from ..utils.generation import InferenceParams
from . import block

_OF_FORK = (
    "which is not supported: a fork's own layer file runs over the functions here "
    "(docs/drop-ins.md, 'Without any change')"
)


class Mamba(nn.Module):
    """Mamba layer; each output token depends on the input tokens up to it.

    The state dict has mamba-ssm's names and shapes, so weights are interchangeable, and the same
    seed gives the same initial weights. The projections are called as modules, so hooks and
    adapters on ``in_proj``, ``x_proj`` and ``out_proj`` work.
    """

    def __init__(
        self, d_model: int, d_state: int = 16, d_conv: int = 4, expand: int = 2,
        dt_rank: int | str = "auto", dt_min: float = 0.001, dt_max: float = 0.1,
        dt_init: str = "random", dt_scale: float = 1.0, dt_init_floor: float = 1e-4,
        conv_bias: bool = True, bias: bool = False, use_fast_path: bool = True,
        layer_idx: int | None = None, device=None, dtype: torch.dtype | None = None,
        bimamba_type: str = "none", **of_fork,
    ) -> None:  # fmt: skip
        """Build the layer.

        Args:
            d_model: channels of a token.
            d_state: states of a channel, N, from 1 to 256.
            d_conv: taps of the convolution, from 2 to 4.
            expand: inner channels over d_model.
            dt_rank: rank of the step's projection; "auto" is d_model / 16, rounded up.
            dt_min: smallest initial step; steps are drawn log-uniformly.
            dt_max: largest initial step.
            dt_init: "random" or "constant" weights of the step's projection.
            dt_scale: their scale.
            dt_init_floor: lower bound of initial steps.
            conv_bias: the convolution has a bias.
            bias: the first and the last projection have one.
            use_fast_path: stored as an attribute, without effect.
            layer_idx: the layer's key in ``InferenceParams``; needed only with these.
            device: of the weights.
            dtype: of the weights, except A_log and D, which are float32.
            bimamba_type: "none"; the forks' other layers run from their own files.
            of_fork: none; the arguments of forks are refused.

        Raises:
            TypeError: an argument is one of a fork's layer, as ``bimamba`` and ``nslices`` are.
            ValueError: ``d_state``, ``d_conv``, ``dt_rank``, ``dt_init`` or ``bimamba_type`` is not
                one of the above.
        """
        super().__init__()
        if bimamba_type != "none":
            raise ValueError(f"bimamba_type is {bimamba_type!r}, {_OF_FORK}")
        for name, value in of_fork.items():
            raise TypeError(f"{name} is {value!r}, {_OF_FORK}")
        if not 1 <= d_state <= 256:
            raise ValueError(f"d_state must be 1 to 256, got {d_state}")
        one_of("d_conv", d_conv, 2, 3, 4)  # supported by the convolution's kernel
        one_of("dt_init", dt_init, "random", "constant")
        if isinstance(dt_rank, str):
            one_of("dt_rank", dt_rank, "auto")
        self.d_model, self.d_state, self.d_conv, self.expand = d_model, d_state, d_conv, expand
        self.d_inner = inner = int(expand * d_model)
        self.dt_rank = math.ceil(d_model / 16) if isinstance(dt_rank, str) else dt_rank
        self.use_fast_path, self.layer_idx = use_fast_path, layer_idx
        self.activation, self.act = "silu", nn.SiLU()
        at = {"device": device, "dtype": dtype}
        # In mamba-ssm's order of random draws: the same seed gives the same weights.
        self.in_proj = nn.Linear(d_model, 2 * inner, bias=bias, **at)
        self.conv1d = nn.Conv1d(
            inner, inner, d_conv, padding=d_conv - 1, groups=inner, bias=conv_bias, **at
        )
        self.x_proj = nn.Linear(inner, self.dt_rank + 2 * d_state, bias=False, **at)
        self.dt_proj = nn.Linear(self.dt_rank, inner, **at)
        bound = self.dt_rank**-0.5 * dt_scale
        if dt_init == "constant":
            nn.init.constant_(self.dt_proj.weight, bound)
        else:
            nn.init.uniform_(self.dt_proj.weight, -bound, bound)
        low, high = math.log(dt_min), math.log(dt_max)
        step = torch.exp(torch.rand(inner, **at) * (high - low) + low).clamp(min=dt_init_floor)
        with torch.no_grad():
            self.dt_proj.bias.copy_(step + torch.log(-torch.expm1(-step)))  # softplus's inverse
        vars(self.dt_proj.bias)["_no_reinit"] = True
        states = torch.arange(1, d_state + 1, dtype=torch.float32, device=device)
        self.A_log = nn.Parameter(states.log().repeat(inner, 1))
        self.D = nn.Parameter(torch.ones(inner, dtype=torch.float32, device=device))
        for parameter in (self.A_log, self.D):
            vars(parameter)["_no_weight_decay"] = True
        self.out_proj = nn.Linear(inner, d_model, bias=bias, **at)

    def forward(
        self, hidden_states: Tensor, inference_params: InferenceParams | None = None
    ) -> Tensor:
        """Run over all tokens at once.

        Args:
            hidden_states: ``[B, L, d_model]`` float32, bfloat16 or float16.
            inference_params: if given, this layer's states in it are set to those after the last
                token (without gradients). If its ``seqlen_offset`` is over 0, the tokens continue
                from these states, a single token by ``step`` (without a gradient).

        Returns:
            ``[B, L, d_model]``.

        Raises:
            TypeError: the dtype is not one of the above.
            ValueError: the shape is another; ``layer_idx`` is None, or the states in
                ``inference_params`` are of another batch.
        """
        check_tensor("hidden_states", hidden_states, ("B", "L", self.d_model), dtypes=DTYPES)
        if inference_params is None:
            return self._run(hidden_states)[0]
        states = self._get_states_from_cache(inference_params, hidden_states.shape[0])
        begun = inference_params.seqlen_offset > 0
        if begun and hidden_states.shape[1] == 1:
            return self.step(hidden_states, *states)[0]
        out, *after = self._run(hidden_states, states if begun else None)
        with torch.no_grad():
            for state, value in zip(states, after):
                state.copy_(value)
        return out

    def _run(self, tokens: Tensor, states: tuple[Tensor, Tensor] | None = None):
        """Return the output, and both states after the last token, in the layout of the cache."""
        x, z = self.in_proj(tokens).chunk(2, dim=-1)
        conv_state = scan_state = None
        seen = x.new_zeros(x.shape[0], self.d_conv, self.d_inner)
        if states is not None:  # copies, because the cache is overwritten before backward
            seen, scan_state = states[0].transpose(1, 2).to(x.dtype), states[1].float().clone()
            conv_state = seen[:, 1:].clone()
        recent = torch.cat([seen, x[:, -self.d_conv :]], 1)[:, -self.d_conv :]
        taps, bias = self.conv1d.weight[:, 0], self.conv1d.bias
        x = causal_conv1d(x, taps, bias, activation=self.activation, initial_state=conv_state)
        low_rank, B, C = self.x_proj(x).split([self.dt_rank, self.d_state, self.d_state], dim=-1)
        y, scan_state = selective_scan(
            x,
            # The bias is added inside the scan, in float32, for steps of 1e-3.
            F.linear(low_rank, self.dt_proj.weight),
            -torch.exp(self.A_log.float()),
            B,
            C,
            D=self.D.float(),
            z=z,
            delta_bias=self.dt_proj.bias.float(),
            delta_softplus=True,
            initial_state=scan_state,
            return_last_state=True,
        )
        return self.out_proj(y), recent.transpose(1, 2), scan_state

    @torch.no_grad()
    def step(
        self, hidden_states: Tensor, conv_state: Tensor, ssm_state: Tensor
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Run over one more token, without gradients.

        Args:
            hidden_states: ``[B, 1, d_model]``.
            conv_state: ``[B, d_inner, d_conv]``, updated in place.
            ssm_state: ``[B, d_inner, d_state]``, updated in place.

        Returns:
            ``[B, 1, d_model]``, and both states.

        Raises:
            TypeError: as ``forward``.
            ValueError: a shape is not one of the above.
        """
        check_tensor("hidden_states", hidden_states, ("B", 1, self.d_model), dtypes=DTYPES)
        x, z = self.in_proj(hidden_states[:, 0]).chunk(2, dim=-1)
        x = causal_conv1d_update(
            x, conv_state, self.conv1d.weight[:, 0], self.conv1d.bias, self.activation
        )
        low_rank, B, C = self.x_proj(x).split([self.dt_rank, self.d_state, self.d_state], dim=-1)
        dt, bias = F.linear(low_rank, self.dt_proj.weight), self.dt_proj.bias
        A = -torch.exp(self.A_log.float())
        y = selective_state_update(
            ssm_state, x, dt, A, B, C, self.D, z=z, dt_bias=bias, dt_softplus=True
        )
        return self.out_proj(y)[:, None], conv_state, ssm_state

    def allocate_inference_cache(
        self, batch_size: int, max_seqlen: int, dtype: torch.dtype | None = None, **kwargs
    ) -> tuple[Tensor, Tensor]:
        """Make the states before the first token.

        Args:
            batch_size: B.
            max_seqlen: unused, because the states do not grow.
            dtype: of both states; None means the convolution's for the first and float32 for the
                second, because rounding a state to 8 bits at every token loses slow decays.
            **kwargs: unused.

        Returns:
            ``[B, d_inner, d_conv]`` and ``[B, d_inner, d_state]``, zeros.
        """
        zeros = self.conv1d.weight.new_zeros
        conv = zeros(batch_size, self.d_inner, self.d_conv, dtype=dtype)
        scan = zeros(batch_size, self.d_inner, self.d_state, dtype=dtype or torch.float32)
        return conv, scan

    def _get_states_from_cache(
        self, inference_params: InferenceParams, batch_size: int
    ) -> tuple[Tensor, Tensor]:
        """Return this layer's states in ``inference_params``; make them if missing."""
        if self.layer_idx is None:
            raise ValueError("layer_idx is None, must be this layer's number to use a cache")
        cache = inference_params.key_value_memory_dict
        if self.layer_idx not in cache:
            cache[self.layer_idx] = self.allocate_inference_cache(batch_size, 0)
        states = cache[self.layer_idx]
        if len(states[0]) != batch_size:
            raise ValueError(
                f"hidden_states has batch size {batch_size}, "
                f"the cache of layer {self.layer_idx} has {len(states[0])}"
            )
        return states


class Block(block.Block):
    """Block of mamba-ssm 1, without an MLP."""

    def __init__(
        self, dim: int, mixer_cls, norm_cls=nn.LayerNorm, fused_add_norm=False,
        residual_in_fp32=False,
    ) -> None:  # fmt: skip
        super().__init__(dim, mixer_cls, nn.Identity, norm_cls, fused_add_norm, residual_in_fp32)
