"""Numbers and names that every room agrees on; no imports of ours, and none that are slow."""

DEFAULT_FOV = 49.1  # degrees, vertical; the released data's camera
DEFAULT_DISTANCE = 1.5  # of the reference camera from the object's centre, object units
