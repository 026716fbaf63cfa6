"""Truth catalogs: galaxies and stars that are generated, or ingested from source catalogs."""
