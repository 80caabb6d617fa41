"""The parts that every benchmark uses: cases, the clock, reports, pages and charts."""
