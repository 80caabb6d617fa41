"""Training objective: the paper's losses, and ours."""
