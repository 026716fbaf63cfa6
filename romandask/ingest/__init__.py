"""Readers of input files: source catalogs, which are brought into one normal form, spectra and lists of visits."""
