"""The suites of ``gamba bench``, and the files of their results."""

from __future__ import annotations

import importlib
from pathlib import Path
from types import ModuleType

from ..errors import UserError
from ..kernels.bench.core.document import parse_document

# what is measured -> the module with ``cases(settings)`` and ``targets(settings)``, loaded if asked
SUITES = {
    "scan": "gamba_warp.kernels.bench.cases.scan",
    "conv": "gamba_warp.kernels.bench.cases.conv",
    "raster": "gamba_warp.kernels.bench.cases.raster",
    "block": "gamba_warp.measure.blocks",
    "model": "gamba_warp.measure.blocks",
    "train-step": "gamba_warp.train.bench",
}


def load_suite(op: str) -> ModuleType:
    """The module with the cases and targets of one of ``SUITES``."""
    return importlib.import_module(SUITES[op])


def read_document(path: Path) -> dict:
    """Reads a bench.json.

    Raises:
        UserError: no such file, not JSON, or not of this format.
    """
    try:
        return parse_document(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(f"{path}: {error.strerror or 'cannot be read'}") from error
    except UnicodeDecodeError as error:
        raise UserError(f"{path}: not JSON (not even text)") from error
    except ValueError as error:
        raise UserError(f"{path}: {error}") from error
