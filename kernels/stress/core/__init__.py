"""What every stress test stands on: cases, ranges of values, rounding, runs and reports."""
