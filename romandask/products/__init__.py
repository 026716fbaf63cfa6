"""Lazy products over units: images and tables, read where they are stored and made where they are not."""
