"""Every writing command killed at random moments, and on a disk that fills up."""
