"""Numbers and names that every room agrees on; no imports of ours, and none that are slow."""

from typing import Literal

DEFAULT_FOV = 49.1  # degrees, vertical; the released data's camera
DEFAULT_DISTANCE = 1.5  # of the reference camera from the object's centre, object units

# Axes of a file: x right, y down, z forward; or x right, y up, z backward.
Axes = Literal["opencv", "opengl"]

# Of the option --device: "auto" is the GPU if there is one, else the CPU.
DeviceChoice = Literal["auto", "cpu", "cuda"]
