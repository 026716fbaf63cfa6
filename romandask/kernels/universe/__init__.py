"""The generated universe: matter, galaxies, stars, spectra and fluxes."""
