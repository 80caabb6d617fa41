"""Studies of the training: a step by parts, and the loader."""
