"""Drawing galaxies and stars in Fourier space, and GalSim as the reference."""
