"""Detector effects and their calibration: from expected light to data numbers, and back to electrons."""
