"""Coadds: tiles that are drizzled, warped or drawn directly, and their PSFs."""
