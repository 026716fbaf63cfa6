"""Telescopes, a folder each, behind one protocol (`instrument.Instrument`)."""
