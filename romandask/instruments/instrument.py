"""What an exposure is, and the interface that every telescope offers to the stages."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields
from typing import Literal, Protocol

import galsim
import numpy as np
import pandas as pd
from astropy.wcs import WCS
from numpy.polynomial.chebyshev import chebvander

from romandask.kernels.detectors.simple_detector import Detector
from romandask.kernels.rendering.psf import BrightPsf, PsfModel
from romandask.model.sky import Region
from romandask.model.spectra import Bandpass
from romandask.products.images import ImageProduct


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


class Instrument(Protocol):
    """A telescope and its camera, as the stages see it; one file a telescope."""

    name: str
    coadd_scale: float
    """Pixel scale of its coadds, arcsec."""
    pixel_scale: float
    """Native, arcsec."""
    shape: tuple[int, int]
    """Detector (ny, nx)."""
    field_radius: float
    """No detector reaches further from the boresight, degrees."""
    knot_smoothing: float
    """Sigma, arcsec, of the Gaussian that smooths knots of galaxies."""
    detector: Detector
    aperture: float
    """Radius of aperture photometry, arcsec: it holds most of the light of a point source."""
    detection: Literal["median", "peaks"]
    """median: Source Extractor on the median of bands; peaks: those of their weighted mean, smoothed with its PSF."""
    detection_bands: tuple[str, ...] | None
    """Bands that enter it; None for all."""

    @property
    def bands(self) -> tuple[str, ...]:
        """Bands of this pipeline."""

    @property
    def psf_settings(self) -> dict[str, object]:
        """What PSFs depend on but the exposure: a part of the hash of what is drawn with them."""

    @property
    def coadd(self) -> Literal["drizzle", "warp", "draw"]:
        """How tiles are made: drizzled or warped from exposures, or drawn directly from the cadence."""

    @property
    def calibrated(self) -> bool:
        """True where exposures are made with the calibrations of their detectors."""

    def calibrations(self, detectors: Sequence[int]) -> ImageProduct | None:
        """Return the lazy calibrations of some detectors; None where the instrument has none."""

    def bandpass(self, band: str) -> Bandpass:
        """Return a bandpass, with the wavelengths at which the PSF is known."""

    def plan(self, region: Region, seed: int) -> pd.DataFrame:
        """Return visits that cover a region: the columns of Exposure without the detector."""

    @property
    def detectors(self) -> tuple[int, ...]:
        """Numbers of the detectors."""

    def footprints(self, visits: pd.DataFrame) -> np.ndarray:
        """Return the corners (n, detectors, 4, 2), degrees, of every detector of visits (columns ra, dec, pa)."""

    def refused(self, visits: pd.DataFrame) -> np.ndarray:
        """True where the telescope cannot point there and then (columns ra, dec, mjd)."""

    def header(self, exposure: Exposure) -> dict:
        """Return the exact FITS header of an exposure."""

    def psf(self, exposure: Exposure) -> PsfModel:
        """Return the chromatic PSF of an exposure."""

    def psf_at(self, exposure: Exposure, x: float, y: float) -> PsfModel:
        """Return the PSF at one place, exactly: of no use elsewhere, and sooner made than the whole."""

    def psf_key(self, exposure: Exposure) -> tuple:
        """Return what tells the PSFs of exposures apart: where it is the same they are."""

    def psf_edges(self, exposure: Exposure) -> dict[int, float]:
        """Return `edges` of that PSF, without the work of the whole."""

    def bright_psfs(self, exposure: Exposure) -> tuple[BrightPsf, ...]:
        """Return the PSFs of its bright stars, the brightest last."""

    def profiles(self, exposure: Exposure, x: float, y: float) -> list[galsim.GSObject]:
        """Return GalSim's PSFs (arcsec, in the frame of the pixels, without their response), one a node, at a place."""

    def background(self, exposure: Exposure, header: dict, rows: slice = ..., columns: slice = ...) -> np.ndarray:
        """Return the expected electrons (ny, nx) that do not come from objects, of all or some pixels."""

    def sky_noise(self, exposure: Exposure, background: np.ndarray) -> float:
        """Return the noise of an empty pixel, electrons rms."""


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
