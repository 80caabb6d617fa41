"""Benchmark cases that need the model, and the state of a machine."""
