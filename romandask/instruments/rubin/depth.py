"""Limiting depths of Rubin's visits and of the coadd of visits at points of the sky."""

from __future__ import annotations

import numpy as np

from romandask.instruments.rubin.bands import BANDS
from romandask.model.sky import covering_sums

SYSTEM_FWHM = 0.4
"""Telescope, optics and camera, arcsec at airmass 1: 0.25, 0.08 and 0.30 in quadrature (SMTN-002)."""


def effective_fwhm(band: str, seeing500, airmass):
    """Return FWHMeff, arcsec, the Gaussian of as many noise pixels as the PSF, from the FWHM at 500 nm and zenith.

    FWHMeff = 1.16 sqrt(FWHMsys^2 + 1.04 FWHMatm^2) with FWHMatm ~ lambda^-0.3, and both ~ airmass^0.6 (SMTN-002).
    """
    atmosphere = np.asarray(seeing500) * (BANDS[band].effective_wave / 500) ** -0.3
    return 1.16 * np.sqrt(SYSTEM_FWHM**2 + 1.04 * atmosphere**2) * np.asarray(airmass) ** 0.6


def visit_depth(band: str, seeing500, airmass, sky_brightness, exptime):
    """Return m5, AB mag, of a point source in visits of one band (SMTN-002; Ivezic et al. 2019, equations 6 and 7).

    Parameters
    ----------
    seeing500 : atmospheric FWHM at 500 nm and zenith, arcsec
    sky_brightness : AB mag / arcsec2
    exptime : seconds, read once
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


def coadd_depth(depths, axis: int | None = None):
    """Return the depth, AB mag, of the optimally weighted coadd of visits: 1.25 log10(sum 10^(0.8 m5))."""
    return 1.25 * np.log10(np.sum(10 ** (0.8 * np.asarray(depths)), axis=axis))


def depth_map(ra, dec, footprints: np.ndarray, depths: np.ndarray) -> np.ndarray:
    """Return the coadded depth, AB mag, at positions in degrees, -inf where no detector looked.

    Parameters
    ----------
    footprints : (n, detectors, 4, 2) corners of the detectors of visits of one band, degrees, in order
    depths : (n,) m5 of the visits, AB mag
    """
    weights = np.repeat(10 ** (0.8 * np.asarray(depths, float)), footprints.shape[1])
    with np.errstate(divide="ignore"):
        return 1.25 * np.log10(covering_sums(footprints.reshape(-1, 4, 2), ra, dec, weights))
