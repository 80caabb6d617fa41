"""The parts that every stress test uses: cases, ranges of values, rounding, runs and reports."""
