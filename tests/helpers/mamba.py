"""Mamba's scan, block and layer, and Gamba's block, written out for a comparison in float64."""

import torch
import torch.nn.functional as F

BATCH, CHANNELS, STATES, LENGTH, RANK, WIDTH = 2, 10, 3, 21, 4, 7
# Shapes of B and C: the same for all tokens, varying with them, and in two groups.
CONSTANT, VARYING = (CHANNELS, STATES), (BATCH, STATES, LENGTH)
GROUPED = (BATCH, 2, STATES, LENGTH)


def scan_inputs(B, C, dtype=torch.float32, without=()):
    """Return the scan's tensors by name, B and C of these shapes; constant ones are float32."""
    shape = (BATCH, CHANNELS, LENGTH)
    made = {
        "u": torch.randn(shape).to(dtype),
        "delta": (0.5 * torch.rand(shape)).to(dtype),
        "A": -0.5 * torch.rand(CHANNELS, STATES),
        "B": torch.randn(B).to(torch.float32 if B == CONSTANT else dtype),
        "C": torch.randn(C).to(torch.float32 if C == CONSTANT else dtype),
        "D": torch.randn(CHANNELS),
        "z": torch.randn(shape).to(dtype),
        "delta_bias": 0.5 * torch.rand(CHANNELS),
    }
    return {name: x for name, x in made.items() if name not in without}


def block_inputs(constant_B=False, constant_C=False, taps=4):
    """Return mamba_inner_fn's arguments by mamba-ssm's names, in its order."""
    rows = RANK + STATES * ((not constant_B) + (not constant_C))
    return {
        "xz": torch.randn(BATCH, 2 * CHANNELS, LENGTH),
        "conv1d_weight": torch.randn(CHANNELS, 1, taps),
        "conv1d_bias": torch.randn(CHANNELS),
        "x_proj_weight": torch.randn(rows, CHANNELS) / CHANNELS**0.5,
        "delta_proj_weight": torch.randn(CHANNELS, RANK) / RANK**0.5,
        "out_proj_weight": torch.randn(WIDTH, CHANNELS),
        "out_proj_bias": torch.randn(WIDTH),
        "A": -torch.rand(CHANNELS, STATES),
        "B": torch.randn(CHANNELS, STATES) if constant_B else None,
        "C": torch.randn(CHANNELS, STATES) if constant_C else None,
        "D": torch.randn(CHANNELS),
        "delta_bias": torch.randn(CHANNELS),
        "B_proj_bias": None if constant_B else torch.randn(STATES),
        "C_proj_bias": None if constant_C else torch.randn(STATES),
    }


# Of x = delta A: the decay of the state, and the factor of delta B u.
TRANSITIONS = {
    "mamba": lambda x: (x.exp(), 1.0),
    "zoh": lambda x: (x.exp(), (x.exp() - 1) / x),
    "bilinear": lambda x: ((1 + x / 2) / (1 - x / 2), 1 / (1 - x / 2)),
}


def scan_in_float64(
    u, delta, A, B, C, D=None, z=None, delta_bias=None, softplus=False, discretization="mamba"
):
    """The scan written out, channel by channel, for any shapes of B and C."""

    def at(matrix, t):  # [B or 1, D, N]
        if matrix.dim() == 2:
            return matrix[None]
        if matrix.dim() == 3:
            return matrix[:, None, :, t]
        return matrix[..., t].repeat_interleave(u.shape[1] // matrix.shape[1], dim=1)

    if delta_bias is not None:
        delta = delta + delta_bias[:, None]
    if softplus:
        delta = torch.log1p(delta.exp())
    h, rows = u.new_zeros(*u.shape[:2], A.shape[1]), []
    for t in range(u.shape[2]):
        step = delta[:, :, t, None]
        decay, gain = TRANSITIONS[discretization](step * A)
        h = decay * h + gain * step * at(B, t) * u[:, :, t, None]
        rows.append((h * at(C, t)).sum(-1))
    y = torch.stack(rows, -1)
    if D is not None:
        y = y + D[:, None] * u
    return (y if z is None else y * z * torch.sigmoid(z)), h


def run(function, tensors, dtype=None, **options):
    """Outputs, and gradients by name for one cotangent of the output."""
    leaves = {k: x.detach().to(dtype or x.dtype).requires_grad_() for k, x in tensors.items()}
    out = function(**leaves, **options)
    out, last = out if isinstance(out, tuple) else (out, torch.zeros(()))
    generator = torch.Generator().manual_seed(1)
    out.backward(torch.randn(out.shape, generator=generator).to(out.dtype))
    return {"out": out, "last": last} | {name: x.grad for name, x in leaves.items()}


def norm(x, weight, eps=1e-6):
    """RMS norm, or x itself without a weight."""
    return x if weight is None else x * weight / (x.square().mean(-1, keepdim=True) + eps).sqrt()


def block_in_float64(**g):
    """Compute mamba_inner_fn from its arguments by name; bimamba_inner_fn with an ``A_b``.

    Without an ``out_proj_weight`` the output is that before the last projection.
    """
    x, z = g["xz"].chunk(2, 1)
    padded = F.pad(x, (g["conv1d_weight"].shape[2] - 1, 0))
    x = F.silu(F.conv1d(padded, g["conv1d_weight"], g["conv1d_bias"], groups=x.shape[1]))
    low, rank = x.mT @ g["x_proj_weight"].T, g["delta_proj_weight"].shape[1]
    delta = norm(low[..., :rank] @ g["delta_proj_weight"].T, g.get("dt_rms_weight")).mT
    states, matrices = g["A"].shape[1], []
    for name, part in (("B", low[..., rank : rank + states]), ("C", low[..., -states:])):
        part = norm(part + g.get(f"{name}_proj_bias", 0), g.get(f"{name.lower()}_rms_weight")).mT
        matrices.append(g.get(name, part))
    skip, shift, kind = g["D"], g["delta_bias"], g.get("discretization", "mamba")
    y, _ = scan_in_float64(x, delta, g["A"], *matrices, skip, z, shift, True, kind)
    if "A_b" in g:  # the same from the end on; constant matrices have no tokens
        x, delta, z = (part.flip(-1) for part in (x, delta, z))
        matrices = [m.flip(-1) if m.dim() == 3 else m for m in matrices]
        y = y + scan_in_float64(x, delta, g["A_b"], *matrices, skip, z, shift, True)[0].flip(-1)
    if "out_proj_weight" not in g:
        return y
    return y.mT @ g["out_proj_weight"].T + g["out_proj_bias"]


def layer_in_float64(weights, tokens, discretization="mamba"):
    """Compute a Mamba layer from its weights by their names."""
    w = {name.replace(".", "_"): value for name, value in weights.items()}
    given = {k: w.get(k) for k in ("conv1d_weight", "conv1d_bias", "x_proj_weight", "D")}
    given |= {"xz": (tokens @ w["in_proj_weight"].T).mT, "A": -w["A_log"].exp()}
    given |= {"delta_proj_weight": w["dt_proj_weight"], "delta_bias": w["dt_proj_bias"]}
    given |= {"discretization": discretization}
    return block_in_float64(**given, out_proj_weight=w["out_proj_weight"], out_proj_bias=0)


def normalized(w, name, x):
    """LayerNorm by its weights' names, or RMSNorm if it has no bias."""
    x = x - x.mean(-1, keepdim=True) if f"{name}.bias" in w else x
    x = x / (x.square().mean(-1, keepdim=True) + 1e-5).sqrt()
    return x * w[f"{name}.weight"] + w.get(f"{name}.bias", 0)


def part(w, name):
    """Weights whose names begin so, under the rest of their names."""
    return {k.removeprefix(name): x for k, x in w.items() if k.startswith(name)}


def gamba_block_in_float64(w, discretization):
    """Prepend the projected condition, compute the layer, drop the prefix again.

    ``w`` has ``tokens``, those of ``camera`` and ``image`` that there are, and the block's weights.
    """
    layer, whole = part(w, "mamba."), [w["tokens"]]
    layer |= {"conv1d.weight": layer["conv_weight"][:, None], "conv1d.bias": layer["conv_bias"]}
    for name in ("image", "camera"):
        if name in w:
            project = part(w, f"project_{name}.")
            whole.insert(0, w[name] @ project["weight"].T + project["bias"])
    x = layer_in_float64(layer, normalized(w, "norm", torch.cat(whole, 1)), discretization)
    return w["tokens"] + x[:, -w["tokens"].shape[1] :]
