"""An exposure, one detector of one visit, and the geometry of its pixels."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np
import pandas as pd
from astropy.wcs import WCS
from numpy.polynomial.chebyshev import chebvander


@dataclass(frozen=True)
class Exposure:
    """One detector of one visit."""

    visit: int
    detector: int
    band: str
    mjd: float
    """Start, days."""
    exptime: float
    """Seconds."""
    ra: float
    """Boresight (Roman: centre of the focal plane), degrees."""
    dec: float
    """Degrees."""
    pa: float
    """Position angle of the focal plane's +y axis, degrees east of north."""
    seeing: float = np.nan
    """Atmospheric FWHM at 500 nm and zenith, arcsec; NaN in space."""
    airmass: float = np.nan
    sky_brightness: float = np.nan
    """AB mag / arcsec2; NaN in space."""

    @property
    def name(self) -> str:
        """Unit name: band, visit and detector."""
        return f"{self.band}-{self.visit}-{self.detector}"


EXPOSURE_COLUMNS = tuple(field.name for field in fields(Exposure))


def exposure_of(row: pd.Series) -> Exposure:
    """Return the exposure of a row of a pointings table."""
    kinds = {"visit": int, "detector": int, "band": str}
    return Exposure(**{name: kinds.get(name, float)(row[name]) for name in EXPOSURE_COLUMNS})


def exposures_of(table: pd.DataFrame) -> list[Exposure]:
    """Return the exposures of all rows of a pointings table."""
    columns = [table[name].tolist() for name in EXPOSURE_COLUMNS]
    return [Exposure(*values) for values in zip(*columns, strict=True)]


def footprint(header: dict, shape: tuple[int, int]) -> np.ndarray:
    """Return the corners (4, 2) of an image on the sky, degrees, in order."""
    ny, nx = shape
    x = np.array([-0.5, nx - 0.5, nx - 0.5, -0.5])
    y = np.array([-0.5, -0.5, ny - 0.5, ny - 0.5])
    return np.stack(WCS(header).all_pix2world(x, y, 0), axis=1)


WHOLE = slice(None)


def pixel_areas(
    header: dict, shape: tuple[int, int], rows: slice = WHOLE, columns: slice = WHOLE, knots: int = 17
) -> np.ndarray:
    """Return the area, arcsec2, of the pixels of some rows and columns of an image, (ny, nx) float32.

    The area varies smoothly (SIP of fourth order): it is computed exactly on a coarse grid and interpolated by
    Chebyshev polynomials of eighth order, to better than 1e-6.
    """
    wcs = WCS(header)
    ys, xs = (np.linspace(0, n - 1, knots) for n in shape)
    x, y = np.meshgrid(xs, ys)
    sides = {}
    for name, dx, dy in (("e", 0.5, 0), ("w", -0.5, 0), ("n", 0, 0.5), ("s", 0, -0.5)):
        sides[name] = np.stack(wcs.all_pix2world(x + dx, y + dy, 0))
    middle = np.radians((sides["e"][1] + sides["w"][1]) / 2)

    def step_of(a: str, b: str) -> tuple[np.ndarray, np.ndarray]:
        east = ((sides[a][0] - sides[b][0] + 180) % 360 - 180) * np.cos(middle)
        return east * 3600, (sides[a][1] - sides[b][1]) * 3600

    (xe, xn), (ye, yn) = step_of("e", "w"), step_of("n", "s")
    area = np.abs(xe * yn - xn * ye)
    left, right = (chebvander(2 * axis / axis[-1] - 1, 8) for axis in (ys, xs))
    coefficients = np.linalg.pinv(left) @ area @ np.linalg.pinv(right).T
    at = [np.arange(n)[part] * 2 / (n - 1) - 1 for n, part in zip(shape, (rows, columns), strict=True)]
    return (chebvander(at[0], 8) @ coefficients).astype(np.float32) @ chebvander(at[1], 8).T.astype(np.float32)
