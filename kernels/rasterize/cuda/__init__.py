"""The rasterizer's kernels for CUDA."""
