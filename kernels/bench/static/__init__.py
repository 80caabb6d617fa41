"""What the CUDA kernels take of a GPU, told without one."""
