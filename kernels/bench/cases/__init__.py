"""Benchmark cases, one subject a file: problems and knobs of each operator."""
