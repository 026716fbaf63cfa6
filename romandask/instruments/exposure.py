"""The pointing of one detector in one visit, and the geometry of its pixels on the sky."""

from __future__ import annotations

from dataclasses import dataclass, fields
from functools import lru_cache
from typing import Any

import numpy as np
import pandas as pd
from astropy.wcs import WCS
from numpy.polynomial.chebyshev import chebvander

from romandask.kernels.detectors.chebyshev import chebyshev_surface

_KNOTS = 17
"""Number of positions along each axis of a detector at which `pixel_areas` computes areas exactly."""
_DEGREE = 8
"""Degree of the Chebyshev polynomials by which `pixel_areas` interpolates in each axis."""


@dataclass(frozen=True, kw_only=True)
class Exposure:
    """One detector of one visit."""

    visit: int
    """Number of the visit."""
    detector: int
    """Number of the detector."""
    band: str
    """Name of the band."""
    mjd: float
    """Start of the exposure, MJD, days."""
    exptime: float
    """Exposure time, seconds."""
    ra: float
    """Right ascension of the boresight, degrees; for Roman, of the centre of the focal plane."""
    dec: float
    """Declination of the same point, degrees."""
    pa: float
    """Position angle of the +y axis of the focal plane, degrees east of north."""
    seeing: float = np.nan
    """FWHM of the atmospheric PSF at 500 nm and zenith, arcsec; NaN in space."""
    airmass: float = np.nan
    """Airmass; NaN in space."""
    sky_brightness: float = np.nan
    """Sky brightness, AB mag / arcsec2; NaN in space."""

    @property
    def name(self) -> str:
        """Name of the unit: band, visit and detector."""
        return f"{self.band}-{self.visit}-{self.detector}"


EXPOSURE_COLUMNS = tuple(field.name for field in fields(Exposure))
"""Columns of a pointings table from which an exposure is made."""
_COLUMN_TYPES = {"visit": int, "detector": int, "band": str}
"""Types of the columns that are not float."""


def exposure_of(row: pd.Series) -> Exposure:
    """Return the exposure of a row of a pointings table."""
    return Exposure(**{name: _COLUMN_TYPES.get(name, float)(row[name]) for name in EXPOSURE_COLUMNS})


def exposures_of(table: pd.DataFrame) -> list[Exposure]:
    """Return the exposures of all rows of a pointings table."""
    columns = [table[name].tolist() for name in EXPOSURE_COLUMNS]
    return [Exposure(**dict(zip(EXPOSURE_COLUMNS, values, strict=True))) for values in zip(*columns, strict=True)]


def footprint(header: dict, shape: tuple[int, int]) -> np.ndarray:
    """Return the corners of an image on the sky.

    Parameters
    ----------
    header : dict
        FITS header of the WCS.
    shape : tuple of int
        Shape of the image (ny, nx).

    Returns
    -------
    ndarray, shape (4, 2), degrees
        Right ascension and declination of the outer corners of the corner pixels at (x, y) of (0, 0), (nx - 1, 0),
        (nx - 1, ny - 1) and (0, ny - 1).
    """
    ny, nx = shape
    x = np.array([-0.5, nx - 0.5, nx - 0.5, -0.5])
    y = np.array([-0.5, -0.5, ny - 0.5, ny - 0.5])
    return np.stack(WCS(header).all_pix2world(x, y, 0), axis=1)


WHOLE = slice(None)
"""All rows, or all columns."""


def pixel_areas(header: dict, shape: tuple[int, int], rows: slice = WHOLE, columns: slice = WHOLE) -> np.ndarray:
    """Return the solid angles of the pixels of an image.

    The area varies smoothly (SIP of fourth order). It is computed exactly on a coarse grid of 17 x 17 pixels and
    interpolated by Chebyshev polynomials of degree 8, with a relative accuracy better than 1e-6. A pixel has the same
    value, to the last bit, whatever part is requested.

    Parameters
    ----------
    header : dict
        FITS header of the WCS.
    shape : tuple of int
        Shape of the image (ny, nx).
    rows, columns : slice, optional
        Part of the image; by default the whole image.

    Returns
    -------
    ndarray, shape (rows, columns), float32, arcsec2
    """
    coefficients = _area_coefficients(tuple(header.items()), shape)
    y_at, x_at = (np.arange(n)[part] * 2 / (n - 1) - 1 for n, part in zip(shape, (rows, columns), strict=True))
    return chebyshev_surface(chebvander(y_at, _DEGREE), coefficients, chebvander(x_at, _DEGREE).T.astype(np.float32))


@lru_cache(maxsize=256)
def _area_coefficients(cards: tuple[tuple[str, Any], ...], shape: tuple[int, int]) -> np.ndarray:
    """Return the coefficients of the Chebyshev polynomials of `pixel_areas`, given the cards of the header."""
    wcs = WCS(dict(cards))
    ys, xs = (np.linspace(0, n - 1, _KNOTS) for n in shape)
    x, y = np.meshgrid(xs, ys)
    sides = {}
    for name, dx, dy in (("right", 0.5, 0), ("left", -0.5, 0), ("top", 0, 0.5), ("bottom", 0, -0.5)):
        sides[name] = np.stack(wcs.all_pix2world(x + dx, y + dy, 0))
    dec = np.radians((sides["right"][1] + sides["left"][1]) / 2)

    def offset_between(start: str, end: str) -> tuple[np.ndarray, np.ndarray]:
        """Return the offset from one side of each pixel to another, to the east and to the north, arcsec."""
        east = ((sides[end][0] - sides[start][0] + 180) % 360 - 180) * np.cos(dec)
        return east * 3600, (sides[end][1] - sides[start][1]) * 3600

    (x_east, x_north), (y_east, y_north) = offset_between("left", "right"), offset_between("bottom", "top")
    area = np.abs(x_east * y_north - x_north * y_east)
    y_terms, x_terms = (chebvander(2 * axis / axis[-1] - 1, _DEGREE) for axis in (ys, xs))
    return np.linalg.pinv(y_terms) @ area @ np.linalg.pinv(x_terms).T
