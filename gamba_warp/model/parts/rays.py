"""Gaussians on the rays of the input picture's pixels: the decoder ``rays``.

A patch of p x p pixels has k x k cells, and each cell has one Gaussian in each of several layers.
The first layer is what the picture shows: it starts opaque, in the plane through the object's
centre, with the colour of its cell, so that the input view is sharp before the first step. The
other layers are for what is hidden: they start almost transparent, behind one another. The network
predicts, for a Gaussian of layer i on a ray of direction d = (x, y, 1) in the camera's frame,

    point    = d · (distance + ray_depth · tanh(depth_i + ·)) + ray_offset · tanh(·)
    scales   = footprint · exp(size_i + ·), where footprint is the side of a cell at the distance
    opacity  = sigmoid(opacity_i + 10 · (alpha - 1) + ·)
    colour   = sigmoid(logit(colour of the cell) + 2 · (·))

where each · is a number of the head, near 0 at the start, and alpha is the cell's mean alpha. The
terms with the index i are learned for each layer.

With ``ray_back`` "opaque" the last layer is a surface, too: it starts opaque, and the · of its
opacity is 0. Else the squared error of a back whose place is not known yet is least for a fog of
faint Gaussians, and training ends in one.
"""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ...cameras import Cameras, exact_product
from ...gaussians import Gaussians
from ..config import RAY_CHANNELS, RAY_STEM, GambaConfig
from .patches import Patches

FRONT_OPACITY = 3.0  # logit; neighbours overlap, so together they are opaque
HIDDEN_OPACITY = -5.4  # logit; just over the 1/255 under which a Gaussian has no gradient
BACK_OPACITY = 2.0  # logit of an opaque back
FRONT_SIZE, HIDDEN_SIZE, BACK_SIZE = 0.25, 0.6, 0.4  # standard deviations, in sides of a cell
LAST_DEPTH = 0.7  # where the last hidden layer starts, in ``ray_depth`` behind the middle
COLOR_MARGIN = 0.01  # keeps the logit of a cell's colour finite
EMPTY = 10.0  # how much lower the opacity's logit is in an empty cell than in a full one
STEM_REACH = 3  # how many cells beside a cell the stem sees, one for each of its convolutions
SIZE_LIMITS = (-4.0, 3.0)  # of the logarithm of a size, in sides of a cell


class RayDecoder(nn.Module):
    """From the tokens of the patches and their pixels to the Gaussians of the cells."""

    between: Tensor  # [cells², coarse²]

    def __init__(self, config: GambaConfig) -> None:
        super().__init__()
        self.config = config
        cells, layers, features = config.ray_cells, config.ray_layers, config.ray_features
        step = config.patch_size // cells  # pixels a side of a cell
        coarse = config.ray_coarse or cells
        self.up = nn.Linear(config.num_orders * config.width, coarse**2 * features)
        self.register_buffer("between", _interpolation(coarse, cells), persistent=False)
        self.stem = nn.Sequential(
            nn.Conv2d(config.pixel_channels, RAY_STEM, step + 2, step, padding=1),
            nn.SiLU(),
            nn.Conv2d(RAY_STEM, features, 3, padding=1),
            nn.SiLU(),
            nn.Conv2d(features, features, 3, padding=1),
        )
        self.rotates = config.predict_rotation
        last = config.ray_hidden or features
        self.mix = nn.Linear(features, last) if config.ray_hidden else None
        self.head = nn.Linear(last, layers * sum(self._parts()))
        # Almost 0, so that the first picture is that of the formulas with 0 for every ·.
        nn.init.normal_(self.head.weight, std=0.002)
        nn.init.zeros_(self.head.bias)
        hidden = layers - 1
        depths = [0.0] + [LAST_DEPTH * (i + 1) / hidden for i in range(hidden)]
        sizes = [FRONT_SIZE] + [HIDDEN_SIZE] * hidden
        opacities = [FRONT_OPACITY] + [HIDDEN_OPACITY] * hidden
        if config.ray_back == "opaque":
            sizes[-1], opacities[-1] = BACK_SIZE, BACK_OPACITY
        self.depth_bias = nn.Parameter(torch.tensor(depths).atanh())
        self.scale_bias = nn.Parameter(torch.tensor(sizes).log())
        self.opacity_bias = nn.Parameter(torch.tensor(opacities))

    def _parts(self) -> list[int]:
        """How many numbers depth, offset, opacity, scales, colour and rotation take."""
        return [*RAY_CHANNELS, 4] if self.rotates else [*RAY_CHANNELS]

    def forward(
        self, tokens: Tensor, pixels: Tensor, patches: Patches, rgba: Tensor, cameras: Cameras
    ) -> Gaussians:
        """Decodes the patches of each picture to F · ray_cells² · ray_layers Gaussians.

        Args:
            tokens: ``[B, F, O, width]``, the token of each patch in each of the O orders.
            pixels: ``[B, pixel_channels, H, W]``, what the network sees of the pictures.
            patches: F patches of each picture; one that is only a filling gets opacity 0.
            rgba: ``[B, H, W, 4]`` in [0, 1], straight alpha.
            cameras: ``[B]`` of the pictures.

        Returns:
            ``[B, F · ray_cells² · ray_layers]``, float32, in the world of ``cameras``.
        """
        cells = self.config.ray_cells
        hidden = self.up(tokens.flatten(2)).unflatten(2, (self.between.shape[1], -1))
        if self.config.ray_coarse:
            hidden = self.between.to(hidden.dtype) @ hidden
        hidden = hidden + patches.cells(self._stem(pixels, patches), cells)
        if self.mix is not None:
            hidden = self.mix(F.silu(hidden))
        # bfloat16 would move a centre by up to 0.002, more than a pixel's width at 512².
        with torch.autocast(tokens.device.type, enabled=False):
            out = self.head(F.silu(hidden.float())).unflatten(-1, (self.config.ray_layers, -1))
            made = self._activated(out, patches, rgba.float(), cameras)
        return made.map(lambda value: value.flatten(1, 3))

    def _stem(self, pixels: Tensor, patches: Patches) -> Tensor:
        """What ``stem`` makes of ``pixels``, as far as the patches use it: ``[B, C, n, n]``.

        A CPU computes each picture's own rows and columns; a GPU would wait for their numbers.
        """
        if pixels.device.type != "cpu":
            return self.stem(pixels)
        cells, maps = self.config.ray_cells, []
        side, step = patches.grid * cells, self.config.patch_size // cells
        for picture, box in zip(pixels.split(1), patches.boxes()):
            (top, bottom), (left, right) = (
                (max(0, first * cells - STEM_REACH), min(side, last * cells + STEM_REACH))
                for first, last in box
            )
            cut = picture[..., top * step : bottom * step, left * step : right * step]
            maps.append(F.pad(self.stem(cut), (left, side - right, top, side - bottom)))
        return torch.cat(maps)

    def _activated(
        self, out: Tensor, patches: Patches, rgba: Tensor, cameras: Cameras
    ) -> Gaussians:
        """The formulas above: ``out [B, F, cells², layers, ·]`` to Gaussians of that shape."""
        depth, offset, opacity, scale, color, *rotation = out.split(self._parts(), -1)
        alpha, base = self._cells(patches, rgba)
        own = opacity[..., 0]
        if self.config.ray_back == "opaque":
            own = F.pad(own[..., :-1], (0, 1))
        logits = self.opacity_bias + EMPTY * (alpha[..., 0] - 1) + own
        opacities = torch.where(patches.valid[:, :, None, None], logits.sigmoid(), 0.0)
        rays, footprint = self._rays(patches, cameras)
        distance = _each(cameras.viewmats[:, :3, 3].norm(dim=-1))
        z = distance + self.config.ray_depth * torch.tanh(self.depth_bias[:, None] + depth)
        points = rays * z + self.config.ray_offset * torch.tanh(offset)
        turn, shift = cameras.viewmats[:, :3, :3], cameras.viewmats[:, :3, 3]
        quats = None
        if rotation:
            quats = rotation[0] + rotation[0].new_tensor([1.0, 0.0, 0.0, 0.0])
        return Gaussians(
            means=exact_product(points - shift[:, None, None, None], turn[:, None, None]),
            quats=quats,
            scales=footprint * torch.exp((self.scale_bias[:, None] + scale).clamp(*SIZE_LIMITS)),
            opacities=opacities,
            colors=torch.sigmoid(base + 2 * color),
        )

    def _cells(self, patches: Patches, rgba: Tensor) -> tuple[Tensor, Tensor]:
        """Mean alpha ``[B, F, cells², 1, 1]`` and the logit of the mean colour ``[.., 1, 3]``."""
        cells = self.config.ray_cells
        flat = torch.cat([rgba[..., :3] * rgba[..., 3:], rgba[..., 3:]], -1).permute(0, 3, 1, 2)
        means = patches.cells(F.avg_pool2d(flat, self.config.patch_size // cells), cells)
        alpha = means[..., None, 3:]
        color = means[..., None, :3] / alpha.clamp_min(1e-3)
        return alpha, torch.logit(color.clamp(COLOR_MARGIN, 1 - COLOR_MARGIN))

    def _rays(self, patches: Patches, cameras: Cameras) -> tuple[Tensor, Tensor]:
        """Rays ``[B, F, cells², 1, 3]`` of depth 1, camera frame; side of a cell at the centre."""
        x, y = patches.cell_centres(self.config.ray_cells)[..., None, :].split(1, -1)
        K = cameras.Ks
        x = (x - _each(K[:, 0, 2])) / _each(K[:, 0, 0])
        y = (y - _each(K[:, 1, 2])) / _each(K[:, 1, 1])
        side = self.config.patch_size // self.config.ray_cells
        distance = cameras.viewmats[:, :3, 3].norm(dim=-1)
        return torch.cat([x, y, torch.ones_like(x)], -1), _each(side * distance / K[:, 1, 1])


def joined(parts: list[Gaussians]) -> Gaussians:
    """Batches ``[B_i, N_i]`` as one, filled up with Gaussians of opacity 0 to the largest N."""
    most = max(part.num for part in parts)

    def filled(values: list[Tensor], filling: float) -> Tensor:
        sides = ((0, 0) * (v.ndim - 2) + (0, most - v.shape[1]) for v in values)
        return torch.cat([F.pad(v, side, value=filling) for v, side in zip(values, sides)])

    quats = [part.quats for part in parts if part.quats is not None]
    return Gaussians(
        means=filled([part.means for part in parts], 0.0),
        quats=filled(quats, 1.0) if quats else None,
        scales=filled([part.scales for part in parts], 1.0),
        opacities=filled([part.opacities for part in parts], 0.0),
        colors=filled([part.colors for part in parts], 0.0),
    )


def _interpolation(coarse: int, fine: int) -> Tensor:
    """Weights ``[fine², coarse²]`` that make a fine grid of a coarse one, bilinearly."""
    each = torch.eye(coarse**2).view(1, coarse**2, coarse, coarse)
    finer = F.interpolate(each, (fine, fine), mode="bilinear", align_corners=False)
    return finer.view(coarse**2, fine**2).T.contiguous()


def _each(values: Tensor) -> Tensor:
    """One number a picture, ``[B]``, beside ``[B, F, cells², layers, ·]``."""
    return values.view(-1, 1, 1, 1, 1)
