"""What every benchmark stands on: cases, the clock, reports, pages and charts."""
