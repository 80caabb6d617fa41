"""Fuzzing of every reader: hypothesis mutates valid files and shrinks failing ones."""
