"""Numbers of SSIM (Wang et al. 2004) that the kernels and their oracle share."""

WINDOW = 11  # pixels, side of the Gaussian window
SIGMA = 1.5  # pixels
C1, C2 = 0.01**2, 0.03**2  # for pictures in [0, 1]
EDGE = WINDOW - 1  # pixels by which a picture has fewer windows than pixels, in each direction
