"""Rendering of galaxies and stars in Fourier space, and with GalSim as the reference."""
