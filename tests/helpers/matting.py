"""Minimal matting network in ONNX, written without a package for ONNX."""

import numpy as np

_VARINT, _BYTES = 0, 2  # kinds of fields in a protobuf
_FLOAT = 1  # of ONNX's element types
_OPSET, _IR = 13, 8


def _number(value: int) -> bytes:
    out = bytearray()
    while value > 127:
        out.append(value & 127 | 128)
        value >>= 7
    return bytes([*out, value])


def _field(number: int, value: int | str | bytes) -> bytes:
    """A field of a protobuf: its number and kind, and the value."""
    if isinstance(value, int):
        return _number(number << 3 | _VARINT) + _number(value)
    data = value.encode() if isinstance(value, str) else value
    return _number(number << 3 | _BYTES) + _number(len(data)) + data


def _image(name: str, shape: tuple[int, ...]) -> bytes:
    """An input or an output: name, element type and shape."""
    sides = b"".join(_field(1, _field(1, side)) for side in shape)
    return _field(1, name) + _field(2, _field(1, _field(1, _FLOAT) + _field(2, sides)))


def _tensor(name: str, values: np.ndarray) -> bytes:
    sizes = b"".join(_field(1, size) for size in values.shape)
    data = np.ascontiguousarray(values, "<f4").tobytes()
    return sizes + _field(2, _FLOAT) + _field(8, name) + _field(9, data)


def _node(kind: str, inputs: tuple[str, ...], output: str) -> bytes:
    return b"".join(_field(1, name) for name in inputs) + _field(2, output) + _field(4, kind)


def matting_network(
    weights: tuple[float, float, float] = (30, -30, 0),
    bias: float = -14.0,
    size: int = 64,
    last: str = "Sigmoid",
) -> bytes:
    """A network that only uses the colour of a pixel: ``sigmoid(weights · c + bias)``.

    Args:
        weights: of red, green and blue, each 0.5 below its value in [0, 1].
        bias: added to their sum.
        size: side of its input, pixels; over 320, or the colours are ImageNet's.
        last: operator after the sum.

    Returns:
        The bytes of an ONNX file.
    """
    kernel = np.asarray(weights, np.float32).reshape(1, 3, 1, 1)
    graph = _field(1, _node("Conv", ("image", "kernel", "bias"), "sum"))
    graph += _field(1, _node(last, ("sum",), "alpha"))
    graph += _field(2, "matte")
    graph += _field(5, _tensor("kernel", kernel)) + _field(5, _tensor("bias", np.array([bias])))
    graph += _field(11, _image("image", (1, 3, size, size)))
    graph += _field(12, _image("alpha", (1, 1, size, size)))
    return _field(1, _IR) + _field(7, graph) + _field(8, _field(2, _OPSET))
