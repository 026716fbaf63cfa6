"""Lazy products over units: images and tables, read from the store if they are stored, otherwise made."""
