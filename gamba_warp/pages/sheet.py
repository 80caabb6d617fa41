"""Sheet of many inputs and their results in one image file."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from PIL import Image, ImageDraw, ImageFont

from ..conventions import GREY, over_background
from ..data.preprocess import resize_rgba
from ..errors import UserError
from ..files import atomic_path
from ..gaussians import Gaussians
from ..images import to_uint8
from ..trajectories.movies import turntable_frames
from ..trajectories.paths import Viewpoint

SUFFIXES = (".png", ".webp", ".jpg", ".jpeg")
VIEWS = 5
_TILE = 128  # pixels
_LABEL, _GAP = 18, 12  # height of a name; between two columns of rows
_TALL = 12  # most rows in one column; else there are two


class Sheet:
    """Collection of reconstructions, each with its name, input and views of a turntable."""

    def __init__(self, path: Path) -> None:
        """Begin a sheet.

        Args:
            path: the file that ``write`` creates.

        Raises:
            UserError: its suffix is not one of ``SUFFIXES``.
        """
        if path.suffix.lower() not in SUFFIXES:
            raise UserError(f"--sheet {path}: a sheet is one of {', '.join(SUFFIXES)}")
        self.path = path
        self._rows: list[tuple[str, np.ndarray]] = []

    def add(self, name: str, rgba: np.ndarray, gaussians: Gaussians, view: Viewpoint) -> None:
        """Add a row.

        Args:
            name: title of the row.
            rgba: ``[S, S, 4]`` in [0, 1], the model's input.
            gaussians: ``[N]``, on the device that renders.
            view: of the turntable.
        """
        flat = over_background(resize_rgba(rgba, _TILE, _TILE), GREY)
        turn = turntable_frames(gaussians, view, size=_TILE, frames=VIEWS)
        self._rows.append((name, np.concatenate([to_uint8(flat), *turn], axis=1)))

    def write(self) -> None:
        """Write the file atomically, unless there are no rows.

        Raises:
            UserError: it cannot be written.
        """
        if not self._rows:
            return
        columns = 1 if len(self._rows) <= _TALL else 2
        tall = -(-len(self._rows) // columns)
        wide, high = (1 + VIEWS) * _TILE, _LABEL + _TILE
        sheet = Image.new("RGB", (columns * (wide + _GAP) - _GAP, tall * high), "white")
        draw, font = ImageDraw.Draw(sheet), ImageFont.load_default(12)
        for number, (name, row) in enumerate(self._rows):
            column, line = divmod(number, tall)
            x, y = column * (wide + _GAP), line * high
            text = name.encode(errors="replace").decode()
            draw.text((x + 4, y + 3), text, "#444444", font)
            sheet.paste(Image.fromarray(row), (x, y + _LABEL))
            draw.line((x + _TILE, y + _LABEL, x + _TILE, y + high - 1), "#cccccc")
        with atomic_path(self.path) as temporary:
            sheet.save(temporary, quality=88)  # ignored for PNG
