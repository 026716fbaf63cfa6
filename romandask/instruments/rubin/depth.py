"""Limiting depths of Rubin's visits and of the coadd of visits at points of the sky."""

from __future__ import annotations

import numpy as np

from romandask.model.sky import covering_sums

C_M = {"u": 23.390261, "g": 24.506791, "r": 24.489914, "i": 24.372551, "z": 24.202753, "y": 23.769195}
"""m5 of 30 s at zenith, sky 21 mag / arcsec2 and FWHMeff 0.7 arcsec, AB mag.

rubin_scheduler's SysEngVals (syseng_throughputs 1.7), with which OpSim's runs up to version 3.2 were made. Ivezic et
al. (2019, table 2) have 23.09, 24.42, 24.44, 24.32, 24.16, 23.73; SMTN-002 (throughputs 1.9: three silver mirrors) has
22.97, 24.58, 24.60, 24.54, 24.37, 23.84.
"""
EXTINCTION = {"u": 0.502296, "g": 0.213738, "r": 0.125886, "i": 0.096182, "z": 0.068623, "y": 0.169504}
"""k_m, mag an airmass (SysEngVals)."""
READ_LOSS = {"u": 0.371939, "g": 0.098515, "r": 0.051961, "i": 0.036845, "z": 0.024581, "y": 0.018609}
"""Depth that the read noise of 30 s in the dark costs, mag: SMTN-002's dC_m^inf (SysEngVals)."""
DARK_SKY = {"u": 22.960730, "g": 22.257758, "r": 21.196590, "i": 20.477419, "z": 19.599578, "y": 18.610405}
"""Dark zenith sky at which READ_LOSS holds, AB mag / arcsec2 (SysEngVals)."""
EFFECTIVE_WAVE = {"u": 365.5, "g": 480.0, "r": 622.2, "i": 754.1, "z": 868.2, "y": 991.7}
"""nm"""
SYSTEM_FWHM = 0.4
"""Telescope, optics and camera, arcsec at airmass 1: 0.25, 0.08 and 0.30 in quadrature (SMTN-002)."""


def effective_fwhm(band: str, seeing500, airmass):
    """Return FWHMeff, arcsec, the Gaussian of as many noise pixels as the PSF, from the FWHM at 500 nm and zenith.

    FWHMeff = 1.16 sqrt(FWHMsys^2 + 1.04 FWHMatm^2) with FWHMatm ~ lambda^-0.3, and both ~ airmass^0.6 (SMTN-002).
    """
    atmosphere = np.asarray(seeing500) * (EFFECTIVE_WAVE[band] / 500) ** -0.3
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
    photons = exptime / 30 * 10 ** (-0.4 * (sky - DARK_SKY[band]))
    read = READ_LOSS[band] - 1.25 * np.log10(1 + (10 ** (0.8 * READ_LOSS[band]) - 1) / photons)
    return (
        C_M[band]
        + read
        + 0.5 * (sky - 21)
        + 2.5 * np.log10(0.7 / effective_fwhm(band, seeing500, airmass))
        + 1.25 * np.log10(exptime / 30)
        - EXTINCTION[band] * (airmass - 1)
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
