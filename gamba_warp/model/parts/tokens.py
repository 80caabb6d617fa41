"""Input tokens of the blocks: the camera token and the 3DGS tokens (paper §3.2)."""

from __future__ import annotations

import torch
from torch import Tensor, nn
from torch.nn import functional as F

from ...cameras import Cameras, plucker_rays
from ...conventions import IMAGENET_MEAN, IMAGENET_STD, over_background
from ..config import GambaConfig
from .patches import Foreground, near_patches, patch_pixels, scan_orders
from .weights import init_normal


def normalize_imagenet(images: Tensor) -> Tensor:
    """Normalise ``[.., 3]`` colours in [0, 1] to zero mean and unit deviation over ImageNet."""
    # A tensor of the constants would be copied from the host, which a CUDA graph cannot capture.
    planes = zip(images.unbind(-1), IMAGENET_MEAN, IMAGENET_STD)
    return torch.stack([(plane - mean) / std for plane, mean, std in planes], -1)


class CameraToken(nn.Module):
    """Camera embedding T: an MLP of the camera's 16 numbers (paper §3.2, after LRM)."""

    def __init__(self, channels: int) -> None:
        super().__init__()
        self.mlp = nn.Sequential(nn.Linear(16, channels), nn.SiLU(), nn.Linear(channels, channels))

    def forward(self, cameras: Cameras) -> Tensor:
        """Map ``viewmats [B, 4, 4]`` and ``Ks [B, 3, 3]`` to ``[B, 1, channels]``."""
        return self.mlp(camera_numbers(cameras))[:, None]


def camera_numbers(cameras: Cameras) -> Tensor:
    """Return ``[B, 16]``: the world-to-camera matrix's 12 numbers row by row, then fx, fy, cx, cy.

    The intrinsics are divided by the image's width or height, so they do not depend on its size.
    """
    extrinsics = cameras.viewmats[:, :3, :].flatten(1)
    x, y = cameras.Ks[:, 0] / cameras.width, cameras.Ks[:, 1] / cameras.height
    intrinsics = torch.stack([x[:, 0], y[:, 1], x[:, 2], y[:, 2]], dim=1)
    return torch.cat([extrinsics, intrinsics], dim=1)


class SplatTokens(nn.Module):
    """3DGS tokens G = Scan(Conv(s)) + E (paper eq. 1), or G = E without image tokens.

    With ``mixed_tokens`` (paper, answer A4) Scan(Conv(s)) uses patches of twice the side. These
    tokens are the first quarter; the others are only E.

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
        # E is nearly as large as an image token. On plain background only E distinguishes the
        # tokens, and the positions start spread out only if the tokens differ.
        init_normal(self.embedding, std=config.embedding_init)
        vars(self.embedding)["_no_weight_decay"] = True
        orders = scan_orders(grid, grid, config.scan_orders, config.num_orders).flatten()
        self.register_buffer("orders", orders.to(self.embedding.device), persistent=False)

    def forward(self, images: Tensor, cameras: Cameras) -> Tensor:
        """Map ``images [B, H, W, 3]`` in [0, 1] and one camera each to ``[B, L, width]``."""
        if self.patchify is None:
            return self.embedding.expand(len(images), -1, -1)
        patches = self.patchify(self.pixels(images, cameras)).flatten(2).mT[:, self.orders]
        if self._num_plain:
            patches = F.pad(patches, (0, 0, 0, self._num_plain))
        return patches + self.embedding

    @property
    def _num_plain(self) -> int:
        """Number of tokens, the last ones, without a patch."""
        return len(self.embedding) - len(self.orders)

    def pixels(self, images: Tensor, cameras: Cameras) -> Tensor:
        """Compute the input channels: normalised colour, Plücker ray and, if given, 2 · alpha - 1.

        Args:
            images: ``[B, H, W, 3]`` RGB in [0, 1] on the model's background, or RGBA with straight
                alpha, composited on that background.
            cameras: ``[B]`` of the images.

        Returns:
            ``[B, 9 or 10, H, W]`` float32.
        """
        # Autocast would round matrix products to 8 bits, which is too coarse for rays.
        with torch.autocast(images.device.type, enabled=False):
            height, width = images.shape[1:3]
            rays = plucker_rays(cameras.viewmats.float(), cameras.Ks.float(), width, height)
            images, alpha = images.float(), images[..., 3:].float()  # of RGB, alpha is empty
            if alpha.shape[-1]:
                images = over_background(images, self.background)
            parts = [normalize_imagenet(images), rays, 2 * alpha - 1]
            return torch.cat(parts, dim=-1).permute(0, 3, 1, 2)

    def of_patches(self, pixels: Tensor, foreground: Foreground) -> Tensor:
        """Compute the tokens of some patches only, including the convolution.

        Args:
            pixels: result of ``pixels``.
            foreground: the patches.

        Returns:
            ``[P O, width]``, in the order of ``foreground.tokens``.
        """
        tokens = self.embedding.index_select(0, foreground.tokens)
        if self.patchify is None:
            return tokens
        cut = patch_pixels(pixels, foreground.patch, self.patch_size).flatten(1)
        weight = self.patchify.weight.permute(0, 2, 3, 1).flatten(1)
        features = F.linear(cut, weight, self.patchify.bias)  # [P, width]
        return tokens + features.index_select(0, foreground.patch_of)

    def foreground(self, images: Tensor, background: float, margin: int) -> Tensor:
        """Find the tokens whose patch is not plain background, or is near such a patch.

        Tokens without a patch (``mixed_tokens``) are included.

        Args:
            images: ``[B, H, W, 3]``; a patch is plain background if it is so in all images.
            background: grey value; a pixel that differs by more than half of 1/255 is not
                background.
            margin: number of further patches around the object, >= 0.

        Returns:
            Positions among the L tokens, int64, ascending.

        Raises:
            ValueError: a negative margin.
        """
        mask = ((images - background).abs() > 0.5 / 255).any(-1).any(0, keepdim=True)
        near = near_patches(mask, self.patch_size, margin)
        return F.pad(near[0, self.orders], (0, self._num_plain), value=True).nonzero()[:, 0]
