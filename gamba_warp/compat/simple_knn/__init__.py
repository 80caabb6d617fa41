"""simple_knn: distances to neighbours, for the first scales of Gaussians."""
