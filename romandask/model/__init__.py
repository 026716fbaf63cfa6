"""Frozen values and arithmetic: no I/O, no dask, no instrument."""
