"""The rasterizer's kernels for CPUs."""
