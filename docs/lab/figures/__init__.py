"""Tables and pictures of the pages, written from stored results: ``make figures``."""
