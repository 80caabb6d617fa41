"""Endurance tests: every writing command killed at random moments, and on a full disk."""
