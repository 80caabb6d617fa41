"""Layers of mamba-ssm, in files of its names."""
