"""What the training makes small: the paper's losses, and ours."""
