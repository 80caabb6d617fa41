"""Layer norm and RMS norm after a residual sum: mamba-ssm's names, in plain torch."""

from __future__ import annotations

from typing import Any

import torch
import torch.nn.functional as F
from torch import Tensor, nn

from ....shared import check_tensor, with_order

__all__ = ["RMSNorm", "layer_norm_fn", "layer_norm_ref", "rms_norm_fn", "rms_norm_ref"]


def layer_norm_fn(
    x: Tensor, weight: Tensor, bias: Tensor | None, residual: Tensor | None = None,
    x1: Tensor | None = None, weight1: Tensor | None = None, bias1: Tensor | None = None,
    eps: float = 1e-6, dropout_p: float = 0.0, rowscale: Tensor | None = None, prenorm=False,
    residual_in_fp32=False, is_rms_norm=False, return_dropout_mask=False, *, upcast=False,
    dropout_mask: Tensor | None = None, dropout_mask1: Tensor | None = None,
) -> Any:  # fmt: skip
    """Add up dropout(x · rowscale), dropout(x1) and the residual, and normalize the sum.

    Computed in float32 for smaller dtypes. ``x``, ``x1``, ``residual`` and the masks (True for
    kept; drawn where None) are ``[.., D]``, ``rowscale`` is ``[..]``, weights and biases ``[D]``.

    Returns:
        The norm in x's dtype; with ``weight1`` a second one of the same sum; with ``prenorm`` the
        sum, in the residual's dtype or, without one, float32 (``residual_in_fp32``, ``upcast``) or
        x's; with ``return_dropout_mask`` both masks, or None. Several as a tuple.

    Raises:
        TypeError: an argument is not a tensor.
        ValueError: a shape is wrong, or ``rowscale`` and ``x1`` are both given.
    """
    check_tensor("x", x, ("..", "D"))
    for name, value in {"residual": residual, "x1": x1}.items():
        check_tensor(name, value, tuple(x.shape), optional=True)
    for name, value in {"weight": weight, "bias": bias, "weight1": weight1, "bias1": bias1}.items():
        check_tensor(name, value, (x.shape[-1],), optional=name != "weight")
    check_tensor("rowscale", rowscale, tuple(x.shape[:-1]), optional=True)
    if rowscale is not None and x1 is not None:
        raise ValueError("pass either rowscale or x1, got both")
    wide = torch.promote_types(x.dtype, torch.float32)
    total: Any = x.to(wide) if rowscale is None else x.to(wide) * rowscale[..., None]
    masks = []
    for part, mask in ((total, dropout_mask), (x1, dropout_mask1)):
        if part is not None and dropout_p > 0:
            mask = torch.rand(x.shape, device=x.device) >= dropout_p if mask is None else mask
            part = part * mask / (1 - dropout_p)
        total = part if not masks else total if part is None else total + part
        masks.append(mask)
    total = total if residual is None else total + residual
    outs, shape = [], x.shape[-1:]
    for scale, shift in ((weight, bias), (weight1, bias1)):
        if scale is not None:
            scale, shift = scale.to(wide), None if shift is None else shift.to(wide)
            if is_rms_norm:
                out = F.rms_norm(total, shape, scale, eps)
                out = out if shift is None else out + shift
            else:
                out = F.layer_norm(total, shape, scale, shift, eps)
            outs.append(out.to(x.dtype))
    if prenorm:
        small = torch.float32 if residual_in_fp32 or upcast else x.dtype
        outs.append(total.to(small if residual is None else residual.dtype))
    outs += masks if return_dropout_mask else []
    return outs[0] if len(outs) == 1 else tuple(outs)


_COMMON = "x weight bias residual x1 weight1 bias1 eps dropout_p rowscale prenorm "
_REFERENCE = _COMMON + "dropout_mask dropout_mask1 upcast"
rms_norm_fn = with_order(
    layer_norm_fn, _COMMON + "residual_in_fp32 return_dropout_mask", is_rms_norm=True
)
# References in plain torch, as these are.
layer_norm_ref = with_order(layer_norm_fn, _REFERENCE)
rms_norm_ref = with_order(layer_norm_fn, _REFERENCE, is_rms_norm=True)


class RMSNorm(nn.Module):
    """RMS norm with a weight ``[D]``, and with dropout of its input while training."""

    def __init__(
        self, hidden_size: int, eps: float = 1e-5, dropout_p: float = 0.0, device=None, dtype=None
    ) -> None:
        super().__init__()
        self.eps, self.drop = eps, nn.Dropout(dropout_p) if dropout_p > 0 else None
        self.weight = nn.Parameter(torch.empty(hidden_size, device=device, dtype=dtype))
        self.register_parameter("bias", None)
        self.reset_parameters()

    def reset_parameters(self) -> None:
        """Set the weight to 1."""
        nn.init.ones_(self.weight)

    def forward(
        self, x: Tensor, residual: Tensor | None = None, prenorm=False, residual_in_fp32=False
    ) -> Any:
        """Normalize ``x [.., D]`` plus a residual, as ``layer_norm_fn``."""
        dropout_p = self.drop.p if self.drop is not None and self.training else 0.0
        options = {"eps": self.eps, "dropout_p": dropout_p, "prenorm": prenorm}
        options["residual_in_fp32"] = residual_in_fp32
        return rms_norm_fn(x, self.weight, None, residual, **options)
