"""Validation of untrusted files; see docs/security.md."""
