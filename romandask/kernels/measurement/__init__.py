"""Detection, photometry, image differences, matching and shear statistics, on arrays."""
