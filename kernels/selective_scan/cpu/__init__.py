"""The scan's kernels for CPUs."""
