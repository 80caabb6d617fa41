"""Random and hostile cases of the operators, compared with float64, for ``gamba stress``."""
