"""Files of Gaussians in all formats: one reader, one writer."""
