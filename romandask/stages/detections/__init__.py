"""Detection and photometry of the objects of each tile, their true counterparts and their zero points."""
