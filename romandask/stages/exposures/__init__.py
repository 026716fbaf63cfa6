"""Exposures of single detectors in single visits: rendering, readout and their product."""
