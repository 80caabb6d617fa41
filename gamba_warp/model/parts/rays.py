"""Gaussians on the rays of the input image's pixels: the decoder ``rays``.

A patch of p x p pixels has k x k cells, and each cell has one Gaussian in each of several layers.
The first layer is the visible surface: it starts opaque, in the plane through the object's centre,
with the colour of its cell, so that the input view is sharp before the first step. The other layers
are for hidden parts: they start almost transparent, one behind the other. The network predicts, for
a Gaussian of layer i on a ray of direction d = (x, y, 1) in the camera's frame,

    point    = d · (distance + ray_depth · tanh(depth_i + ·)) + ray_offset · tanh(·)
    scales   = footprint · exp(size_i + ·), where footprint is the side of a cell at the distance
    opacity  = sigmoid(opacity_i + 10 · (alpha - 1) + ·)
    colour   = sigmoid(logit(colour of the cell) + 2 · (·))

where each · is an output of the head, near 0 at the start, and alpha is the cell's mean alpha. The
terms with the index i are learned for each layer.

With ``ray_back`` "opaque" the last layer is a surface, too: it starts opaque, and the · of its
opacity is 0. Otherwise a fog of faint Gaussians minimizes the squared error of a back of unknown
depth, and training ends in one.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ...cameras import Cameras, exact_product
from ...gaussians import Gaussians
from ..config import GambaConfig
from .patches import Foreground, cell_colors
from .weights import init_normal

FRONT_OPACITY = 3.0  # logit; overlapping neighbours are opaque together
HIDDEN_OPACITY = -5.4  # logit; just over 1/255, below which a Gaussian has no gradient
BACK_OPACITY = 2.0  # logit of an opaque back
FRONT_SIZE, HIDDEN_SIZE, BACK_SIZE = 0.25, 0.6, 0.4  # standard deviations, in sides of a cell
LAST_DEPTH = 0.7  # initial depth of the last hidden layer behind the middle, in ``ray_depth``
COLOR_MARGIN = 0.01  # keeps the logit of a cell's colour finite
EMPTY = 10.0  # difference of the opacity's logit between a full and an empty cell
STEM_WIDTH = 32  # channels after the first convolution of the stem
STEM_REACH = 3  # receptive field of the stem in neighbouring cells, one per convolution
SIZE_LIMITS = (-4.0, 3.0)  # of the logarithm of a size, in sides of a cell


class RayDecoder(nn.Module):
    """Decoder from the tokens and pixels of patches to the Gaussians of their cells."""

    upsampling: Tensor  # [cells², coarse²]

    def __init__(self, config: GambaConfig) -> None:
        super().__init__()
        self.config = config
        cells, layers, features = config.ray_cells, config.ray_layers, config.ray_features
        step = config.patch_size // cells  # pixels a side of a cell
        coarse = config.ray_coarse or cells
        self.up = nn.Linear(config.num_orders * config.width, coarse**2 * features)
        upsampling = _interpolation(coarse, cells).to(self.up.weight.device)
        self.register_buffer("upsampling", upsampling, persistent=False)
        self.stem = nn.Sequential(
            nn.Conv2d(config.pixel_channels, STEM_WIDTH, step + 2, step, padding=1),
            nn.SiLU(),
            nn.Conv2d(STEM_WIDTH, features, 3, padding=1),
            nn.SiLU(),
            nn.Conv2d(features, features, 3, padding=1),
        )
        self.rotates = config.predict_rotation
        last = config.ray_hidden or features
        self.mix = nn.Linear(features, last) if config.ray_hidden else None
        self.head = nn.Linear(last, layers * sum(self._parts()))
        # Almost 0, so that every · of the formulas starts near 0.
        init_normal(self.head.weight, std=0.002)
        nn.init.zeros_(self.head.bias)
        hidden = layers - 1
        depths = [0.0] + [LAST_DEPTH * (i + 1) / hidden for i in range(hidden)]
        sizes = [FRONT_SIZE] + [HIDDEN_SIZE] * hidden
        opacities = [FRONT_OPACITY] + [HIDDEN_OPACITY] * hidden
        if config.ray_back == "opaque":
            sizes[-1], opacities[-1] = BACK_SIZE, BACK_OPACITY
        with torch.device("cpu"):  # see ``_interpolation``
            biases = (
                torch.tensor(depths).atanh(),
                torch.tensor(sizes).log(),
                torch.tensor(opacities),
            )
        biases = (nn.Parameter(bias.to(self.head.weight.device)) for bias in biases)
        self.depth_bias, self.scale_bias, self.opacity_bias = biases

    def _parts(self) -> list[int]:
        """Channels of depth, offset, opacity, scales, colour and rotation."""
        return [1, 3, 1, 3, 3, *([4] if self.rotates else [])]

    def forward(
        self,
        tokens: Tensor,
        pixels: Tensor,
        foreground: Foreground,
        rgba: Tensor,
        cameras: Cameras,
    ) -> Gaussians:
        """Decode the foreground cells, ``ray_layers`` Gaussians each.

        Args:
            tokens: ``[P, O, width]``, the token of each patch in each of the O orders.
            pixels: ``[B, pixel_channels, H, W]``, the network's input channels of the images.
            foreground: the P patches and their cells.
            rgba: ``[B, H, W, 4]`` in [0, 1], straight alpha.
            cameras: ``[B]`` of the images.

        Returns:
            ``[B, N]``, float32, in the world of ``cameras``: the cells row by row, the layers of a
            cell adjacent. N belongs to the image with the most cells; the others are padded with
            Gaussians of opacity 0.
        """
        # bfloat16 would move a centre by up to 0.002, more than a pixel's width at 512².
        with torch.autocast(tokens.device.type, enabled=False):
            side = self.config.patch_size // self.config.ray_cells
            colors, alpha = cell_colors(rgba.float(), side, foreground.cell)
            if foreground.void is not None:
                alpha = alpha + foreground.void
        hidden = self.up(tokens.flatten(1)).unflatten(1, (self.upsampling.shape[1], -1))
        if self.config.ray_coarse:
            hidden = self.upsampling.to(hidden.dtype) @ hidden
        hidden = hidden.flatten(0, 1).index_select(0, foreground.number)
        hidden = hidden + self._stem(pixels, foreground)
        if self.mix is not None:
            hidden = self.mix(F.silu(hidden))
        with torch.autocast(tokens.device.type, enabled=False):
            out = self.head(F.silu(hidden.float())).unflatten(-1, (self.config.ray_layers, -1))
            gaussians = self._activated(out, colors, alpha, foreground.cell, cameras)
            return _padded(gaussians, foreground)

    def _stem(self, pixels: Tensor, foreground: Foreground) -> Tensor:
        """Apply ``stem`` to ``pixels``, at the cells: ``[T, C]``.

        A CPU only computes each image's box with cells; a GPU is faster with all images at
        once. The result of padding is arbitrary.
        """
        if pixels.device.type != "cpu" or not foreground.boxes:
            image, row, column = foreground.cell
            return self.stem(pixels).permute(0, 2, 3, 1)[image, row, column]
        count, values = self.config.ray_cells, []
        step, side = self.config.patch_size // count, self.config.grid_size * count
        cells = foreground.cell[1:, : sum(foreground.counts)]
        positions = (each.split(foreground.counts) for each in cells)
        for image, box, row, column in zip(pixels.split(1), foreground.boxes, *positions):
            (top, bottom), (left, right) = (
                _with_reach(count * box[axis], count * box[axis + 2], side) for axis in (0, 1)
            )
            cut = image[..., top * step : bottom * step, left * step : right * step]
            rows = self.stem(cut)[0].flatten(1).T
            values.append(rows.index_select(0, (row - top) * (right - left) + column - left))
        return F.pad(torch.cat(values), (0, 0, 0, len(foreground.number) - cells.shape[1]))

    def _activated(
        self, out: Tensor, colors: Tensor, alpha: Tensor, cell: Tensor, cameras: Cameras
    ) -> Gaussians:
        """Apply the formulas above to ``out [T, layers, ·]``; return Gaussians ``[T, layers]``."""
        image, row, column = cell
        depth, offset, opacity, scale, color, *rotation = out.split(self._parts(), -1)
        opacity = opacity[..., 0]
        if self.config.ray_back == "opaque":
            opacity = F.pad(opacity[..., :-1], (0, 1))
        base = torch.logit(colors.clamp(COLOR_MARGIN, 1 - COLOR_MARGIN))
        Ks, viewmats = cameras.Ks[image], cameras.viewmats[image]
        side = self.config.patch_size // self.config.ray_cells
        x = (side * (column.to(Ks) + 0.5) - Ks[:, 0, 2]) / Ks[:, 0, 0]
        y = (side * (row.to(Ks) + 0.5) - Ks[:, 1, 2]) / Ks[:, 1, 1]
        rotations, shift = viewmats[:, :3, :3], viewmats[:, None, :3, 3]
        distance = shift.norm(dim=-1, keepdim=True)
        footprint = side * distance / Ks[:, 1, 1, None, None]
        z = distance + self.config.ray_depth * torch.tanh(self.depth_bias[:, None] + depth)
        points = torch.stack([x, y, torch.ones_like(x)], -1)[:, None] * z
        points = points + self.config.ray_offset * torch.tanh(offset)
        quats = None
        if rotation:
            quats = rotation[0] + rotation[0].new_tensor([1.0, 0.0, 0.0, 0.0])
        return Gaussians(
            means=exact_product(points - shift, rotations),
            quats=quats,
            scales=footprint * torch.exp((self.scale_bias[:, None] + scale).clamp(*SIZE_LIMITS)),
            opacities=torch.sigmoid(self.opacity_bias + EMPTY * (alpha - 1) + opacity),
            colors=torch.sigmoid(base[:, None] + 2 * color),
        )


def _with_reach(first: int, end: int, side: int) -> tuple[int, int]:
    """Return the range of cells that the stem needs for those from ``first`` to ``end``.

    Its length depends on theirs alone, also at the image's edge.
    """
    length = min(side, end - first + 2 * STEM_REACH)
    begin = min(max(0, first - STEM_REACH), side - length)
    return begin, begin + length


def _padded(gaussians: Gaussians, foreground: Foreground) -> Gaussians:
    """Pad Gaussians ``[T, layers]`` of all cells to ``[B, N]``; the padding comes last."""
    shape = len(foreground.counts), foreground.most

    def padded(values: Tensor, value: float = 0.0) -> Tensor:
        out = values.new_full((shape[0] * shape[1], *values.shape[1:]), value)
        return out.index_copy_(0, foreground.slot, values).unflatten(0, shape).flatten(1, 2)

    return Gaussians(
        means=padded(gaussians.means),
        quats=None if gaussians.quats is None else padded(gaussians.quats, 1.0),
        scales=padded(gaussians.scales, 1.0),
        opacities=padded(gaussians.opacities),
        colors=padded(gaussians.colors),
    )


def _interpolation(coarse: int, fine: int) -> Tensor:
    """Weights ``[fine², coarse²]`` of bilinear interpolation from a coarse to a fine grid.

    On the CPU: for a model on the meta device torch would load its compiler, for seconds.
    """
    each = torch.eye(coarse**2, device="cpu").view(1, coarse**2, coarse, coarse)
    finer = F.interpolate(each, (fine, fine), mode="bilinear", align_corners=False)
    return finer.view(coarse**2, fine**2).T.contiguous()
