"""Detection, photometry, matching and statistics on arrays."""
