"""Hostile files for every reader: hypothesis breaks sound files and makes small what fails."""
