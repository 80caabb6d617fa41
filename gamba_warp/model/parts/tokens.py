"""What enters the blocks: the camera token and the 3DGS tokens (paper §3.2)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ...cameras import Cameras, plucker_rays
from ...conventions import IMAGENET_MEAN, IMAGENET_STD, over_background
from ..config import GambaConfig, Orders
from .patches import Patches, near_patches


def normalize_imagenet(images: Tensor) -> Tensor:
    """Brings ``[.., 3]`` colours in [0, 1] to zero mean and unit deviation over ImageNet."""
    # A tensor made of the constants would be copied from the host, which a CUDA graph cannot hold.
    planes = zip(images.unbind(-1), IMAGENET_MEAN, IMAGENET_STD)
    return torch.stack([(plane - mean) / std for plane, mean, std in planes], -1)


def scan_orders(height: int, width: int, orders: Orders = "backward", count: int = 4) -> Tensor:
    """Returns the orders in which a map is read, the first ``count`` of four.

    These are: row by row from the top left, column by column from the top left, and each of the two
    backward (VMamba's cross-scan; paper §3.2), or "mirrored": row by row from the top right, column
    by column from the bottom left (the authors' public code).

    Returns:
        ``[count, height·width]`` int64 positions in the row-major map; each row is a permutation.
    """
    rows = torch.arange(height * width).reshape(height, width)
    flipped = (0, 1) if orders == "backward" else (1,)
    passes = [rows, rows.T, rows.flip(flipped), rows.T.flip(flipped)]
    return torch.stack([order.flatten() for order in passes[:count]])


class CameraToken(nn.Module):
    """The camera embedding T: an MLP of the camera's 16 numbers (paper §3.2, after LRM)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(nn.Linear(16, channels), nn.SiLU(), nn.Linear(channels, channels))

    def forward(self, cameras: Cameras) -> Tensor:
        """Maps ``viewmats [B, 4, 4]`` and ``Ks [B, 3, 3]`` to ``[B, 1, channels]``."""
        return self.mlp(camera_numbers(cameras))[:, None]


def camera_numbers(cameras: Cameras) -> Tensor:
    """Returns ``[B, 16]``: the world-to-camera matrix's 12 numbers row by row, then fx, fy, cx, cy.

    The intrinsics are divided by the picture's width or height, so they do not depend on its size.
    """
    extrinsics = cameras.viewmats[:, :3, :].flatten(1)
    x, y = cameras.Ks[:, 0] / cameras.width, cameras.Ks[:, 1] / cameras.height
    intrinsics = torch.stack([x[:, 0], y[:, 1], x[:, 2], y[:, 2]], dim=1)
    return torch.cat([extrinsics, intrinsics], dim=1)


class SplatTokens(nn.Module):
    """The 3DGS tokens G = Scan(Conv(s)) + E (paper eq. 1), or G = E without image tokens.

    With ``mixed_tokens`` (paper, answer A4) Scan(Conv(s)) is that of patches of twice the side.
    These tokens are a quarter as many and come first; those behind them are E alone.

    Attributes:
        orders: the patch of each token that has one, int64: ``[L]``, or ``[L / 4]`` if mixed.
    """

    orders: Tensor

    def __init__(self, config: GambaConfig) -> None:
        super().__init__()
        patch = self.patch_size = config.token_patch
        grid = config.image_size // patch
        self.background = config.background_color
        self.patchify = None
        if config.additive_image_tokens:
            channels = config.pixel_channels
            self.patchify = nn.Conv2d(channels, config.width, kernel_size=patch, stride=patch)
        self.embedding = nn.Parameter(torch.empty(config.num_tokens, config.width))
        # E is nearly as large as an image token. On plain background E alone tells the tokens
        # apart, and the positions start spread out only if the tokens differ.
        nn.init.normal_(self.embedding, std=config.embedding_init)
        vars(self.embedding)["_no_weight_decay"] = True
        self.register_buffer(
            "orders",
            scan_orders(grid, grid, config.scan_orders, config.num_orders).flatten(),
            persistent=False,
        )

    def forward(self, images: Tensor, cameras: Cameras) -> Tensor:
        """Maps ``images [B, H, W, 3]`` in [0, 1] and one camera each to ``[B, L, width]``."""
        if self.patchify is None:
            return self.embedding.expand(len(images), -1, -1)
        patches = self.patchify(self.pixels(images, cameras)).flatten(2).mT[:, self.orders]
        if self._bare:
            patches = F.pad(patches, (0, 0, 0, self._bare))
        return patches + self.embedding

    @property
    def _bare(self) -> int:
        """How many tokens, the last ones, have no patch."""
        return len(self.embedding) - len(self.orders)

    def pixels(self, images: Tensor, cameras: Cameras) -> Tensor:
        """What the tokens are made of: normalised colour, Plücker ray and, if given, 2 · alpha - 1.

        Args:
            images: ``[B, H, W, 3]`` RGB in [0, 1] on the model's background, or RGBA with straight
                alpha, which is put on that background.
            cameras: ``[B]`` of the pictures.

        Returns:
            ``[B, 9 or 10, H, W]`` float32.
        """
        # Autocast would round the matrix products inside to 8 bits, which is too coarse for rays.
        with torch.autocast(images.device.type, enabled=False):
            height, width = images.shape[1:3]
            rays = plucker_rays(cameras.viewmats.float(), cameras.Ks.float(), width, height)
            images, alpha = images.float(), images[..., 3:].float()  # of RGB, alpha is empty
            if alpha.shape[-1]:
                images = over_background(images, self.background)
            parts = [normalize_imagenet(images), rays, 2 * alpha - 1]
            return torch.cat(parts, dim=-1).permute(0, 3, 1, 2)

    def of_patches(self, pixels: Tensor, patches: Patches) -> tuple[Tensor, Tensor]:
        """The tokens of some patches alone; of the others not even the convolution is computed.

        Args:
            pixels: result of ``pixels``.
            patches: P patches of the pictures.

        Returns:
            Tokens ``[P O, width]`` in their order, picture by picture, and where among them each
            patch has those of its O orders: ``[P, O]`` int64; see ``Patches.orders``.
        """
        kept, places = patches.orders(self.orders)
        tokens = self.embedding[kept]
        if self.patchify is None:
            return tokens, places
        cut = patches.cells(pixels, self.patch_size).flatten(1)
        weight = self.patchify.weight.permute(0, 2, 3, 1).flatten(1)
        found = F.linear(cut, weight, self.patchify.bias)  # [P, width]
        of_token = torch.empty_like(kept)
        of_token[places] = torch.arange(len(places), device=kept.device)[:, None]
        return tokens + found.index_select(0, of_token), places

    def foreground(self, images: Tensor, background: float, margin: int) -> Tensor:
        """Finds the tokens whose patch is not plain background, or is near such a patch.

        Tokens without a patch (``mixed_tokens``) are found too.

        Args:
            images: ``[B, H, W, 3]``; a patch is plain background if it is so in all pictures.
            background: grey value; a pixel that differs by more than half of 1/255 is not
                background.
            margin: patches around the object that are kept too, >= 0.

        Returns:
            Positions among the L tokens, int64, ascending.

        Raises:
            ValueError: a negative margin.
        """
        seen = ((images - background).abs() > 0.5 / 255).any(-1).any(0, keepdim=True)
        near = near_patches(seen, self.patch_size, margin)
        return F.pad(near[0, self.orders], (0, self._bare), value=True).nonzero()[:, 0]
