"""Other packages' interfaces over our kernels: change the import, keep the code."""
