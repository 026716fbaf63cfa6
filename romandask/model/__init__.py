"""Immutable values and plain arithmetic, independent of dask and of the instruments."""
