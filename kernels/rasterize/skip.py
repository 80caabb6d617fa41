"""Work that the rasterizer skips without changing image or gradients, each with its switch."""

from __future__ import annotations

from dataclasses import dataclass, fields


@dataclass(frozen=True)
class Skip:
    """Work to be left out. Every choice gives the same image and gradients; all are on.

    README.md, "Skipped work", has the proofs; the counts are keys of ``meta``.

    Attributes:
        tile_test: tiles that the box of a Gaussian meets and its ellipse does not (``pairs_box``
            without, ``pairs`` with the test).
        block_test: of a tile, the parts that the ellipse misses: 4 x 4 pixels on the CPU, 8 x 4 on
            CUDA (``blocks_traversed``; without the test, all of ``pairs_traversed``).
        stopped: Gaussians behind a tile or part whose pixels have all stopped (``pairs`` without,
            ``pairs_traversed`` with it).
        empty_tiles: setting up tiles that no Gaussian touches (``tiles_empty``).
        zero_upstream: in backward, tiles whose upstream gradient is all zero (``tiles_skipped``).
        unused: in backward, pairs and parts that forward found without effect (``pairs_used``,
            ``blocks_used``), and Gaussians none of whose pairs had any (``gaussians_used``).
        unasked: gradients of inputs that do not require one.
    """

    tile_test: bool = True
    block_test: bool = True
    stopped: bool = True
    empty_tiles: bool = True
    zero_upstream: bool = True
    unused: bool = True
    unasked: bool = True

    def bits(self) -> int:
        """One bit each, in order: ``TILE_TEST`` and so on below."""
        return sum(bool(getattr(self, field.name)) << i for i, field in enumerate(fields(self)))

    @classmethod
    def from_bits(cls, bits: int) -> Skip:
        """The inverse of ``bits``."""
        return cls(**{field.name: bool(bits >> i & 1) for i, field in enumerate(fields(cls))})


TILE_TEST, BLOCK_TEST, STOPPED, EMPTY_TILES, ZERO_UPSTREAM, UNUSED, UNASKED = (
    1 << i for i in range(len(fields(Skip)))
)
SQUARES = UNASKED << 1  # not of ``Skip``: lists end at the original's squares (README.md §7)
