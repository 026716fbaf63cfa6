"""Rubin Observatory's LSST camera."""
