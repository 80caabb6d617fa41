"""The scan's kernels for CUDA."""
