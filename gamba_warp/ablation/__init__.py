"""``gamba ablate``: plans of rows, each trained and evaluated alike, and their table."""
