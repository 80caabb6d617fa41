"""Studies of the project itself, measured by the clock of ``gamba bench``: ``make study``."""
