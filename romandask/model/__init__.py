"""Frozen values and arithmetic: no dask, no instrument."""
