"""Files of Gaussians and meshes, read and written."""
