"""Resampling exposures onto tiles."""
