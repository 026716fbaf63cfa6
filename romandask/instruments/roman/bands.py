"""Roman's bands: constants of each filter that are not in GalSim. A new band is one entry of `BANDS`."""

from __future__ import annotations

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class RomanBand:
    """One filter of the Wide Field Instrument."""

    name: str
    """Name of the filter in GalSim."""
    optical_element: str
    """Name of the filter in the mission's data models (roman_datamodels)."""
    frequency_folds: int
    """Highest frequency that the optics transmit, as a whole multiple of the Nyquist frequency of the pixels."""
    dithers: tuple[int, ...]
    """Number of exposures of every field in each pass (Troxel et al. 2023, section 3)."""
    roll: float
    """Offset from the best roll, degrees, so that the fields of different bands are rotated against each other."""
    low_zodiacal: bool
    """True if the band is observed on dates of low zodiacal light; the other bands use the remaining dates."""
    depth: float | None = None
    """Published 5-sigma depth of point sources, AB mag (Troxel et al. 2023)."""


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
"""Bands by name, in order of wavelength."""
REFERENCE_BAND = "H158"
"""Band in which objects are counted and compared with the truth."""
COLOUR_BAND = "F184"
"""Band for the colour of an object between its counterparts in Rubin and Roman."""
