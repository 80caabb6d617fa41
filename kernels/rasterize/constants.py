"""Numbers that a kernel and its oracle share."""

ALPHA_MIN = 1.0 / 255.0  # a fainter contribution is skipped
ALPHA_MAX = 0.99  # alpha is clamped here, so 1 / (1 - alpha) <= 100
T_MIN = 1e-4  # a pixel stops before its transmittance would fall to this: (1 - ALPHA_MAX)^2
EPS2D = 0.3  # added to the diagonal of the projected covariance, square pixels
TILE = 16  # pixels, side of a square tile, a power of two
BLOCKS = (TILE // 4) ** 2  # of 4 x 4 pixels in a tile
FRUSTUM_MARGIN = (
    0.3  # fraction of tan(fov / 2): how far outside the image the Jacobian still follows
)
RADIUS_MAX = 2.0**24  # pixels; the original's radius is kept below, so that an int32 holds it
CONIC_MAX = 1e19  # conics of larger entries, whose square leaves float32's range, are culled
COMPENSATION_MIN = 0.005  # floor of the antialiasing factor, which keeps its gradient finite
