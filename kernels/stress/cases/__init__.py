"""Random and hostile cases, one file an operator."""
