"""Benchmark cases of the training: a step by parts, and the loader."""
