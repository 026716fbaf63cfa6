"""Coadds: drizzled, warped or drawn tiles, and their PSFs."""
