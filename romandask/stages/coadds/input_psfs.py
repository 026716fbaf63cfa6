"""PSFs of drizzled coadds: of each exposure as it enters a tile, and of a star anywhere as the coadd has it."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import lru_cache

import numpy as np
from astropy.wcs import WCS

from romandask.instruments.exposure import Exposure
from romandask.instruments.instrument import Instrument
from romandask.kernels.coadding.coadd_psf import drizzled_psf, native_star
from romandask.kernels.coadding.drizzle import Sums
from romandask.kernels.coadding.pixel_map import pixel_map
from romandask.model.tiles import tangent_header
from romandask.stages.psf_images import OVERSAMPLING, psf_image

RADIUS = 3.0
"""Half the side of the PSF images, arcsec, for a pixel of 0.0575 arcsec; larger pixels get larger images."""


def psf_side(instrument: Instrument) -> int:
    """Return the side of the PSF images of an instrument's coadds, pixels, odd."""
    radius = RADIUS * max(1.0, instrument.coadd_scale / 0.1)
    return 2 * int(round(radius / instrument.coadd_scale)) + 1


@dataclass(frozen=True)
class _Middle:
    """The middle of the detector of all exposures with one PSF."""

    key: tuple
    instrument: Instrument = field(compare=False)
    exposure: Exposure = field(compare=False)


@lru_cache(maxsize=40)
def _middle_image(middle: _Middle) -> np.ndarray:
    ny, nx = middle.instrument.shape
    return psf_image(middle.instrument, middle.exposure, (nx - 1) / 2, (ny - 1) / 2).astype(np.float32)


def jacobian(source: WCS, target: WCS, x: float, y: float) -> np.ndarray:
    """Return d(x, y on the target) / d(x, y on the source), (2, 2), at a place on the source."""
    near = np.array([[0.5, 0.0], [-0.5, 0.0], [0.0, 0.5], [0.0, -0.5]]) + [x, y]
    there = np.stack(target.all_world2pix(*source.all_pix2world(*near.T, 0), 0, quiet=True))
    return np.stack([there[:, 0] - there[:, 1], there[:, 2] - there[:, 3]], axis=1)


def input_psf(
    instrument: Instrument, exposure: Exposure, source: WCS, ra: float, dec: float, pixfrac: float
) -> np.ndarray:
    """Return a unit star of flat f_nu (side, side) of an exposure as it enters the tile around a position.

    It is the PSF in the middle of the detector (Troxel et al. 2023, section 5.2), turned as the exposure is there.
    """
    ny, nx = instrument.shape
    x, y = np.clip(np.array(source.all_world2pix(ra, dec, 0, quiet=True), float), 0, [nx - 1, ny - 1])
    at = [float(value) for value in source.all_pix2world(x, y, 0)]
    side = psf_side(instrument)
    target = WCS(tangent_header(*at, side, instrument.coadd_scale))
    fine = _middle_image(_Middle(instrument.psf_key(exposure), instrument, exposure))
    return drizzled_psf(fine, OVERSAMPLING, jacobian(source, target, x, y), pixfrac, side).astype(np.float32)


def star_on(
    target: WCS,
    stamp: int,
    ra: float,
    dec: float,
    exposures: list[tuple[Exposure, WCS, float]],
    instrument: Instrument,
    pixfrac: float,
    shares: np.ndarray | None,
) -> np.ndarray:
    """Return a unit star (stamp, stamp) as exposures drizzled on a grid have it, each with its own pixels and PSF.

    Parameters
    ----------
    target : of the stamp
    exposures : with WCS and weight
    shares : (nodes,) photons of its spectrum by node of the band; those of flat f_nu where none are given
    """
    sums = Sums((stamp, stamp), 1, pixfrac)
    for exposure, source, weight in exposures:
        x, y = (float(value) for value in source.all_world2pix(ra, dec, 0))
        change = jacobian(source, target, x, y)
        half = int(np.ceil(0.75 * stamp / np.sqrt(abs(np.linalg.det(change))))) + 2
        column, row = round(x), round(y)
        fine = psf_image(instrument, exposure, x, y, shares)
        star = native_star(fine, OVERSAMPLING, half, x - column, y - row) / abs(np.linalg.det(change))
        rows, columns = slice(row - half, row + half + 1), slice(column - half, column + half + 1)
        light = np.full(star.shape, weight, np.float32)
        sums.add([([star], light, pixel_map(source, target, rows, columns))])
    return sums.means()[0]
