"""Exposures: rendering what a detector sees in one visit, and the product of all of them."""
