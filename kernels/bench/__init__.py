"""Benchmarks of run time against error: cases, and how they are measured, for ``gamba bench``."""
