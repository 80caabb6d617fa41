"""The operators' formulas in float64, rounded sample by sample."""
