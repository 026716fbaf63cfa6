"""The way in: source catalogs, spectra and lists of visits, read from files into one normal form."""
