"""Shared constants, names of options and alpha compositing; imports only the standard library."""

from typing import Literal, get_args

DEFAULT_FOV = 49.1  # degrees, vertical; the released data's camera
DEFAULT_DISTANCE = 1.5  # of the reference camera from the object's centre, object units

# Mean and standard deviation of ImageNet, with which every pretrained encoder here was trained.
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)

# Grey values of the backgrounds that images are compared on. Black and grey are used besides
# white because white floaters are invisible on white. Keys of metrics on white are plain; the
# others end in the background's name. Turntables and sheets are on grey, which shows dark and
# bright floaters.
WHITE, GREY = 1.0, 0.5
GROUNDS = {"black": 0.0, "grey": GREY}

# Axes of a file: x right, y down, z forward; or x right, y up, z backward.
Axes = Literal["opencv", "opengl"]

# Values of --device: "auto" is the GPU if there is one, else the CPU.
DeviceChoice = Literal["auto", "cpu", "cuda"]

# Values of --precision, the dtype of the network's matrix products; "auto" is bfloat16 if a trial
# finds it faster, else float32.
Precision = Literal["float32", "bfloat16", "auto"]

# Values of --detail: each Gaussian of the front may split into this many per side.
Detail = Literal[1, 2, 4]
DETAILS: tuple[Detail, ...] = get_args(Detail)

# Values of --cutout: the method that cuts the object out; "auto" is the first that finds one.
Cutout = Literal["auto", "alpha", "plain", "matte", "grabcut", "none"]


def over_background(rgba, background):
    """Composite straight-alpha RGBA, an array or a tensor, over a colour.

    Args:
        rgba: ``[.., H, W, 4]`` in [0, 1], colour not premultiplied.
        background: a grey value, or RGB that broadcasts with ``[.., H, W, 3]``, in [0, 1].

    Returns:
        ``[.., H, W, 3]``.
    """
    alpha = rgba[..., 3:]
    return rgba[..., :3] * alpha + background * (1 - alpha)


def over_another(rgb, alpha, old, new):
    """Move a composited image to another background, by its alpha; nothing is clipped.

    Args:
        rgb: ``[.., H, W, 3]`` on the background ``old``, an array or a tensor.
        alpha: ``[.., H, W, 1]`` in [0, 1].
        old: a grey value, or RGB that broadcasts with ``rgb``.
        new: likewise.

    Returns:
        ``[.., H, W, 3]`` on the background ``new``.
    """
    return rgb + (new - old) * (1 - alpha)
