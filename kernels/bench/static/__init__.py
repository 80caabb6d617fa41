"""Resources of the CUDA kernels, found without a GPU."""
