"""Benchmark of the operators: run time against error, for ``gamba bench``."""
