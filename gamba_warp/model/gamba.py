"""Gamba network: encoder, tokens, blocks and decoder (paper §3.2)."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

from torch import Tensor, nn

from ..cameras import Cameras
from ..conventions import over_background
from ..devices import float32_weights
from ..errors import UserError
from ..gaussians import Gaussians
from .config import GambaConfig
from .encoders import ImageEncoder, Weights, build_encoder
from .parts.attention import AttentionBlock
from .parts.block import GambaBlock, make_norm, run_blocks
from .parts.decoder import GaussianDecoder
from .parts.patches import Foreground, find_foreground
from .parts.prefix import prefix_states
from .parts.rays import RayDecoder
from .parts.tokens import CameraToken, SplatTokens
from .parts.triplane import PlaneBranch, TriplaneDecoder

# By name: a module made of a ``GambaConfig`` that maps tokens ``[B, L, width]`` to ``Gaussians``
# ``[B, N]``. A script may add to it (docs/train-your-own.md).
DECODERS: dict[str, Any] = {
    "bins": GaussianDecoder,
    "rays": RayDecoder,
    "triplane": TriplaneDecoder,
}


def make_blocks(config: GambaConfig, camera_channels: int, image_channels: int) -> nn.ModuleList:
    """Build the blocks of a branch; zero channels mean no such condition."""
    kind = {"mamba": GambaBlock, "attention": AttentionBlock}[config.mixer]
    return nn.ModuleList(kind(config, camera_channels, image_channels) for _ in range(config.depth))


class Gamba(nn.Module):
    """Network from one posed image to Gaussians (paper §3.2, GambaFormer and decoder).

    Attributes:
        checkpointing: keep only each block's input for the gradient, and recompute the block in the
            backward pass; takes less memory and a third more time.
    """

    @float32_weights()
    def __init__(
        self,
        config: GambaConfig,
        encoder_weights: Weights | None = None,
        encoder: ImageEncoder | None = None,
    ) -> None:
        """Build the network with fresh weights, except for the encoder's.

        Args:
            config: the architecture.
            encoder_weights: see ``build_encoder``; unused without ``config.prepend``.
            encoder: used instead of the one of ``config``.

        Raises:
            UserError: there is no such decoder, the encoder cannot be built, or its weights are
                missing.
        """
        super().__init__()
        if config.decoder not in DECODERS:
            names = ", ".join(DECODERS)
            raise UserError(f"config: decoder is {config.decoder[:100]!r}, expected one of {names}")
        self.config = config
        self.checkpointing = False
        self.encoder = None
        if config.prepend:
            self.encoder = encoder or build_encoder(config, encoder_weights)
        image_channels = self.encoder.channels if self.encoder else 0
        camera_channels = 0
        if config.prepend and config.camera_token:
            camera_channels = image_channels or config.width
        self.camera_token = CameraToken(camera_channels) if camera_channels else None
        self.tokens = SplatTokens(config)
        self.blocks = make_blocks(config, camera_channels, image_channels)
        self.norm = make_norm(config, final=True)
        self.decoder = DECODERS[config.decoder](config)
        self.planes = None
        if config.decoder == "triplane":
            blocks = make_blocks(config, camera_channels, image_channels)
            self.planes = PlaneBranch(config, blocks)
        for parameter in self.parameters():
            if parameter.ndim == 1:
                vars(parameter)["_no_weight_decay"] = True

    def condition(self, images: Tensor, cameras: Cameras) -> list[Any]:
        """Compute the state of each block after image and camera (``prefix_states``).

        It is the whole contribution of the prefix; with the decoder ``triplane`` the states of the
        planes' blocks follow. Arguments and errors as in ``forward``.
        """
        self._check(images, cameras)
        camera = self.camera_token(cameras) if self.camera_token else None
        image = None
        if self.encoder:
            if self.config.input_channels == 4:
                images = over_background(images, self.config.background_color)
            image = self.encoder(images)
        branches = [self.blocks, *([self.planes.blocks] if self.planes else [])]
        return [s for blocks in branches for s in prefix_states(blocks, camera, image)]

    def forward(
        self,
        images: Tensor,
        cameras: Cameras,
        condition: list[Any] | None = None,
        background_margin: int | None = None,
        foreground: Foreground | None = None,
    ) -> Gaussians:
        """Predict the Gaussians of each image's object.

        Args:
            images: ``[B, H, W, 3]`` RGB in [0, 1] on ``config.background``, H = W =
                ``config.image_size``; for the decoder ``rays`` ``[B, H, W, 4]`` RGBA with straight
                alpha.
            cameras: ``viewmats [B, 4, 4]`` and ``Ks [B, 3, 3]`` of the same image size.
            condition: the result of ``condition`` for the same images and cameras, if already
                computed.
            background_margin: drop the 3DGS tokens of patches that are plain background in every
                image, except within this many patches of another one; 0 keeps only the object's
                own patches. This is faster, but the model was not trained for it
                (docs/lab/benchmarks.md, "Blocks and models", has the error). None drops nothing.
                On CUDA it reads one number back. The decoder ``rays`` is trained on, and always
                uses, only the object's own patches, per image; None is 0 there. A margin adds
                patches to its network, but no Gaussians.
            foreground: with ``rays``, ``find_foreground`` of the images, on their device, if made
                before; else alpha is read back from a GPU.

        Returns:
            ``[B, N]`` Gaussians, float32, in the world of ``cameras``; N is ``num_gaussians``, or
            the number of kept tokens, in their order. With ``rays`` N belongs to the image with
            the most foreground cells; the others are padded with Gaussians of opacity 0.

        Raises:
            ValueError: a shape does not match, or the margin is negative.
        """
        self._check(images, cameras)
        if condition is None:
            condition = self.condition(images, cameras)
        if isinstance(self.decoder, RayDecoder):
            if foreground is None:
                alpha = images[..., 3].cpu()
                foreground = find_foreground(alpha, self.config, background_margin or 0)
                foreground = foreground.to(images.device)
            return self._forward_rays(images, cameras, condition, foreground)
        tokens = self.tokens(images, cameras)
        if background_margin is not None:
            background = self.config.background_color
            tokens = tokens[:, self.tokens.foreground(images, background, background_margin)]
        count = len(self.blocks)
        states, plane_states = condition[:count], condition[count:]
        tokens = self.norm(run_blocks(self.blocks, tokens, states, self.checkpointing))
        if self.planes is None:
            return self.decoder(tokens)
        return self.decoder(tokens, self.planes(len(images), plane_states, self.checkpointing))

    def _forward_rays(
        self, rgba: Tensor, cameras: Cameras, condition: list[Any], foreground: Foreground
    ) -> Gaussians:
        """Run ``forward`` for the decoder ``rays``."""
        pixels = self.tokens.pixels(rgba, cameras)
        tokens = self.tokens.of_patches(pixels, foreground)[None]
        tokens = run_blocks(self.blocks, tokens, condition, self.checkpointing, foreground.packed)
        tokens = self.norm(tokens)[0, foreground.positions]
        return self.decoder(tokens, pixels, foreground, rgba, cameras)

    def _check(self, images: Tensor, cameras: Cameras) -> None:
        size = self.config.image_size
        batch = len(images) if images.ndim else 0
        wanted = {
            "images": (images.shape, (batch, size, size, self.config.input_channels)),
            "cameras.viewmats": (cameras.viewmats.shape, (batch, 4, 4)),
            "cameras.Ks": (cameras.Ks.shape, (batch, 3, 3)),
            "cameras (height, width)": ((cameras.height, cameras.width), (size, size)),
        }
        for name, (got, want) in wanted.items():
            if tuple(got) != want:
                raise ValueError(f"{name} is {tuple(got)}, expected {want}")

    def stored_state(self) -> dict[str, Tensor]:
        """Return the content of a checkpoint: the state dict without a frozen encoder."""
        state = self.state_dict()
        if self.encoder and self.encoder.frozen:
            return {name: v for name, v in state.items() if not name.startswith("encoder.")}
        return state

    def load_stored_state(self, state: dict[str, Tensor]) -> None:
        """Load a result of ``stored_state``.

        Raises:
            ValueError: a tensor is missing, unknown or of another shape.
        """
        self.check_stored_state({name: list(value.shape) for name, value in state.items()})
        self.load_state_dict(state, strict=False)

    def check_stored_state(self, shapes: Mapping[str, Sequence[int]]) -> None:
        """Check the names and shapes of tensors against ``stored_state``.

        Raises:
            ValueError: a tensor is missing, unknown or of another shape; the message names the
                first.
        """
        state = self.stored_state()
        missing = sorted(state.keys() - shapes.keys())
        unknown = sorted(shapes.keys() - state.keys())
        if missing or unknown:
            kind, names = ("no", missing) if missing else ("an unknown", unknown)
            raise ValueError(f"{kind} tensor {names[0][:200]!r} ({len(names)} in total)")
        for name, value in state.items():
            if tuple(shapes[name]) != value.shape:
                got, want = tuple(shapes[name]), tuple(value.shape)
                raise ValueError(f"tensor '{name}' is {got}, expected {want}")
