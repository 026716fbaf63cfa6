"""Numerical work on one unit: arrays in, arrays out; no dask, no files."""
