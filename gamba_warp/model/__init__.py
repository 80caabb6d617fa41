"""Gamba network: tokens, blocks, decoder, checkpoints, and its posed input."""
