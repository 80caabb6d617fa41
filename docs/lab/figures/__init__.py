"""The tables and pictures of the pages, written from results that are kept: ``make figures``."""
