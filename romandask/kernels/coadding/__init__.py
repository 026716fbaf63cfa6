"""Resampling of exposures onto tiles."""
