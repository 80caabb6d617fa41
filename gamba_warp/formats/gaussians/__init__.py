"""Files of Gaussians: one module a format, and ``files`` over them all."""
