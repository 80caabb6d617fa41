"""A matting network in ONNX, run by onnxruntime; ``matte.py`` calls this in a child process.

The file is a stranger's graph, and onnxruntime reads and runs it in native code. It may crash, hang
or take all memory: there it costs a child.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Any

import numpy as np
from PIL import Image

from ..errors import UserError, first_line

_OPEN = 1024  # side of the input where the file leaves it open, pixels
_SIDES = (32, 2048)  # smallest and largest side of an input, pixels
_U2NET = 320  # up to this side: U2-Net and its like, which are trained on ImageNet's colours
_MEAN, _SPREAD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)


def alpha_of(task: tuple[str, tuple[int, int], np.ndarray | None, int]) -> np.ndarray | None:
    """Runs a network on one picture.

    Args:
        task: the model's file; its size and its time of change, which tell a file from the one that
            has replaced it; RGB ``[H, W, 3]`` uint8, or None if the file is only to be looked at;
            and the number of threads.

    Returns:
        Alpha ``[h, w]`` float32 in [0, 1] as the network gives it, h and w of its input; None where
        there is no picture.

    Raises:
        UserError: the file is no network of this kind, or gives no numbers.
    """
    path, version, rgb, threads = task
    session, size, names = _opened(path, version, threads)
    if rgb is None:
        return None
    batch = _input(rgb, size)
    try:
        out = np.asarray(session.run([names[1]], {names[0]: batch})[0], np.float32)
    except Exception as error:  # onnxruntime has errors of its own for every kind of trouble
        raise UserError(f"{path}: cannot be run ({first_line(error)})") from error
    alpha = out.reshape(-1)[: size[0] * size[1]]
    if out.shape[-2:] != size or not np.isfinite(alpha).all():
        raise UserError(f"{path}: not a matting model (it gives {list(out.shape)}, or no numbers)")
    alpha = alpha.reshape(size)
    if alpha.min() < -0.01 or alpha.max() > 1.01:  # its last layer is not a sigmoid
        alpha = 1 / (1 + np.exp(-np.clip(alpha, -30, 30)))
    return np.clip(alpha, 0, 1)


@lru_cache(1)
def _opened(
    path: str, version: tuple[int, int], threads: int
) -> tuple[Any, tuple[int, int], tuple[str, str]]:
    """The session, the size (height, width) of its input, and the names of input and output."""
    import onnxruntime

    options = onnxruntime.SessionOptions()
    options.intra_op_num_threads = threads
    options.log_severity_level = 4  # what goes wrong comes as an error
    try:
        session = onnxruntime.InferenceSession(path, options, providers=["CPUExecutionProvider"])
        inputs, outputs = session.get_inputs(), session.get_outputs()
    except Exception as error:
        raise UserError(f"{path}: not a model in ONNX ({first_line(error)})") from error
    shape = list(inputs[0].shape) if len(inputs) == 1 and outputs else []
    if len(shape) != 4 or shape[1] != 3 or inputs[0].type != "tensor(float)":
        raise UserError(f"{path}: not a matting model (it takes no picture of three colours)")
    height, width = (side if isinstance(side, int) else _OPEN for side in shape[2:])
    if not all(_SIDES[0] <= side <= _SIDES[1] for side in (height, width)):
        raise UserError(f"{path}: takes pictures of {width}x{height}; sides may be {_SIDES}")
    return session, (height, width), (inputs[0].name, outputs[0].name)


def _input(rgb: np.ndarray, size: tuple[int, int]) -> np.ndarray:
    """``[1, 3, h, w]`` float32 as the networks were trained: U2-Net by ImageNet's colours."""
    small = Image.fromarray(rgb).resize((size[1], size[0]), Image.Resampling.LANCZOS)
    values = np.asarray(small, np.float32) / max(1, int(np.asarray(small).max()))
    if max(size) <= _U2NET:
        values = (values - np.array(_MEAN, np.float32)) / np.array(_SPREAD, np.float32)
    else:
        values = values - np.float32(0.5)
    return np.ascontiguousarray(values.transpose(2, 0, 1)[None])
