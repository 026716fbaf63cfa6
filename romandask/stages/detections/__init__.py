"""Objects of each tile, their photometry, their true counterparts and their zero points."""
