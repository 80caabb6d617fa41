"""Other packages' public names over our kernels: only the name of the package changes."""
