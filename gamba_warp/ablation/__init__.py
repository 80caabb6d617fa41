"""``gamba ablate``: training and evaluation of the rows of a plan, and their table."""
