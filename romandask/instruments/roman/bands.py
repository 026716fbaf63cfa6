"""Roman's bands: all that differs from band to band and is not in GalSim. A new band is one entry here."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class RomanBand:
    """One filter of the Wide Field Instrument, by the name that GalSim has for it."""

    name: str
    optical_element: str
    """Name of the filter in the mission's data models."""
    frequency_folds: int
    """Multiples of the pixels' Nyquist frequency that the optics reach."""
    dithers: tuple[int, ...]
    """Exposures of every field in each pass (Troxel et al. 2023, section 3)."""
    roll: float
    """Difference from the best roll, degrees: tiles of different bands are turned against each other."""
    low_zodiacal: bool
    """True where dates of low zodiacal light are chosen; the other bands take the remaining time."""
    depth: float | None = None
    """5-sigma depth of point sources, AB mag (Troxel et al. 2023)."""


BANDS: dict[str, RomanBand] = {
    band.name: band
    for band in (
        RomanBand(
            name="Y106",
            optical_element="F106",
            frequency_folds=3,
            dithers=(4, 3),
            roll=-9.0,
            low_zodiacal=True,
            depth=26.9,
        ),
        RomanBand(
            name="J129",
            optical_element="F129",
            frequency_folds=3,
            dithers=(4, 4),
            roll=-3.0,
            low_zodiacal=True,
            depth=26.9,
        ),
        RomanBand(
            name="H158",
            optical_element="F158",
            frequency_folds=2,
            dithers=(4, 3),
            roll=3.0,
            low_zodiacal=True,
            depth=26.9,
        ),
        RomanBand(
            name="F184",
            optical_element="F184",
            frequency_folds=2,
            dithers=(4, 3),
            roll=9.0,
            low_zodiacal=False,
            depth=26.2,
        ),
    )
}
"""In order of wavelength."""
REFERENCE_BAND = "H158"
"""Band in which objects are counted and compared with the truth."""
COLOUR_BAND = "F184"
"""Band of the colour between Rubin's and Roman's counterparts of an object."""
