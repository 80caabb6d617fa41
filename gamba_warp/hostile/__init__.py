"""Hostile files for every reader, run in child processes: ``gamba stress files``.

See docs/security.md.
"""
