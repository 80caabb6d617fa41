"""Other packages' interfaces over our kernels: change the import, or take their names."""

from .names import take_names

__all__ = ["take_names"]
