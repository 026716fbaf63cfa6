"""The true universe: generated, or ingested from source catalogs."""
