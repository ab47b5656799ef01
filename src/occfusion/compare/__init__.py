"""Finished run folders beside each other: reading, statistics, tables, curves, pictures, pages."""
