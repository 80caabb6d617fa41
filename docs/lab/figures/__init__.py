"""Tables of the pages, written from stored results: ``make figures``."""
