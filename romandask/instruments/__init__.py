"""What differs between telescopes, one file a telescope, behind one interface (exposure.Instrument)."""
