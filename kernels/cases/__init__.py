"""Cases of the operators: inputs by name and seed, formulas in float64, limits and work."""
