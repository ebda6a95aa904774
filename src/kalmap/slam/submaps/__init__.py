"""Divide and conquer: local maps, the forest that joins them, and what landmark maps bring to it."""
