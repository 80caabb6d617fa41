"""Benchmark and stress cases that need the model."""
