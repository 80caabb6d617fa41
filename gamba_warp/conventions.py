"""What every room agrees on: numbers, names, alpha; no imports of ours, and none that are slow."""

from typing import Literal, get_args

DEFAULT_FOV = 49.1  # degrees, vertical; the released data's camera
DEFAULT_DISTANCE = 1.5  # of the reference camera from the object's centre, object units

# Mean and deviation of ImageNet's pictures; every pretrained encoder here was trained with them.
IMAGENET_MEAN = (0.485, 0.456, 0.406)
IMAGENET_STD = (0.229, 0.224, 0.225)

# Grey values of the backgrounds that pictures are compared on: white, and beside it black and grey,
# because what is right on white may be a white haze on another. Figures on white have a metric's
# plain name, those on the others end in its name.
# Turntables and sheets are drawn on grey, which shows haze whether it is dark or bright.
WHITE, GREY = 1.0, 0.5
GROUNDS = {"black": 0.0, "grey": GREY}

# Axes of a file: x right, y down, z forward; or x right, y up, z backward.
Axes = Literal["opencv", "opengl"]

# Of the option --device: "auto" is the GPU if there is one, else the CPU.
DeviceChoice = Literal["auto", "cpu", "cuda"]

# Of the option --precision: that of the network's products; "auto" is bfloat16 where a trial finds
# it faster, else float32.
Precision = Literal["float32", "bfloat16", "auto"]

# Of the option --detail: into how many Gaussians a side each of the front may split.
Detail = Literal[1, 2, 4]
DETAILS: tuple[Detail, ...] = get_args(Detail)


def over_background(rgba, background):
    """Composites straight-alpha RGBA, an array or a tensor, over a colour.

    Args:
        rgba: ``[.., H, W, 4]`` in [0, 1], colour not premultiplied.
        background: a grey value, or RGB that broadcasts with ``[.., H, W, 3]``, in [0, 1].

    Returns:
        ``[.., H, W, 3]``.
    """
    alpha = rgba[..., 3:]
    return rgba[..., :3] * alpha + background * (1 - alpha)


def over_another(rgb, alpha, old, new):
    """Composites anew what is on a background, by its alpha; nothing is clipped.

    Args:
        rgb: ``[.., H, W, 3]`` on the background ``old``, an array or a tensor.
        alpha: ``[.., H, W, 1]`` in [0, 1].
        old: a grey value, or RGB that broadcasts with ``rgb``.
        new: likewise.

    Returns:
        ``[.., H, W, 3]`` on the background ``new``.
    """
    return rgb + (new - old) * (1 - alpha)
