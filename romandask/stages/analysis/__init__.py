"""Measurements on the object tables: samples, blends, differences, shear, validation."""
