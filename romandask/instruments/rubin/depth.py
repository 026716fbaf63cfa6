"""Limiting depths of Rubin's visits, and of the coadd of visits at positions on the sky."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike

from romandask.instruments.rubin.bands import BANDS
from romandask.model.sky import covering_sums

SYSTEM_FWHM = 0.4
"""FWHM of telescope, optics and camera at airmass 1, arcsec: 0.25, 0.08 and 0.30 in quadrature (SMTN-002)."""


def effective_fwhm(band: str, seeing500: ArrayLike, airmass: ArrayLike) -> np.ndarray:
    """Return FWHMeff, arcsec: the FWHM of the Gaussian with the same number of noise pixels as the PSF.

    FWHMeff = 1.16 sqrt(FWHMsys^2 + 1.04 FWHMatm^2), with FWHMatm ~ lambda^-0.3 and both FWHMs ~ airmass^0.6 (SMTN-002).

    Parameters
    ----------
    band : str
        Name of the band.
    seeing500 : array-like, arcsec
        FWHM of the atmospheric PSF at 500 nm and zenith.
    airmass : array-like
        Airmass.
    """
    atmosphere = np.asarray(seeing500) * (BANDS[band].effective_wave / 500) ** -0.3
    return 1.16 * np.sqrt(SYSTEM_FWHM**2 + 1.04 * atmosphere**2) * np.asarray(airmass) ** 0.6


def visit_depth(
    band: str, seeing500: ArrayLike, airmass: ArrayLike, sky_brightness: ArrayLike, exptime: ArrayLike
) -> np.ndarray:
    """Return the 5-sigma depth m5, AB mag, of point sources in visits of one band.

    The formulas are those of SMTN-002 and of Ivezic et al. (2019), equations 6 and 7.

    Parameters
    ----------
    band : str
        Name of the band.
    seeing500 : array-like, arcsec
        FWHM of the atmospheric PSF at 500 nm and zenith.
    airmass : array-like
        Airmass.
    sky_brightness : array-like, AB mag / arcsec2
        Brightness of the sky.
    exptime : array-like, seconds
        Exposure time of a visit that is read out once.
    """
    sky, exptime, airmass = np.asarray(sky_brightness), np.asarray(exptime), np.asarray(airmass)
    photons = exptime / 30 * 10 ** (-0.4 * (sky - BANDS[band].dark_sky))
    read = BANDS[band].read_loss - 1.25 * np.log10(1 + (10 ** (0.8 * BANDS[band].read_loss) - 1) / photons)
    return (
        BANDS[band].depth_30s
        + read
        + 0.5 * (sky - 21)
        + 2.5 * np.log10(0.7 / effective_fwhm(band, seeing500, airmass))
        + 1.25 * np.log10(exptime / 30)
        - BANDS[band].extinction * (airmass - 1)
    )


def coadd_depth(depths: ArrayLike, axis: int | None = None) -> np.ndarray:
    """Return the depth, AB mag, of the optimally weighted coadd of visits: 1.25 log10(sum 10^(0.8 m5)).

    Parameters
    ----------
    depths : array-like, AB mag
        5-sigma depths m5 of the visits.
    axis : int, optional
        Axis of the visits; by default all elements are visits of one coadd.
    """
    return 1.25 * np.log10(np.sum(10 ** (0.8 * np.asarray(depths)), axis=axis))


def depth_map(ra: np.ndarray, dec: np.ndarray, footprints: np.ndarray, depths: ArrayLike) -> np.ndarray:
    """Return the depth of the coadd of visits at positions on the sky.

    Parameters
    ----------
    ra, dec : ndarray, shape (p,), degrees
        Positions.
    footprints : ndarray, shape (n, detectors, 4, 2), degrees
        Corners of the detectors of n visits of one band, as `Instrument.footprints` returns them.
    depths : array-like, shape (n,), AB mag
        5-sigma depths m5 of the visits.

    Returns
    -------
    ndarray, shape (p,), AB mag
        Coadded depth; -inf at positions that no detector covers.
    """
    weights = np.repeat(10 ** (0.8 * np.asarray(depths, float)), footprints.shape[1])
    with np.errstate(divide="ignore"):
        return 1.25 * np.log10(covering_sums(footprints.reshape(-1, 4, 2), ra, dec, weights))
