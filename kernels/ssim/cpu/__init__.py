"""The kernels of 1 - SSIM for CPUs."""
