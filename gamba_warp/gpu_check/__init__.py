"""All that only a CUDA machine can tell, in one run of a few minutes."""
