"""Geometry of Rubin's focal plane: 189 detectors in a gnomonic projection about the boresight."""

from __future__ import annotations

import numpy as np
import pandas as pd

PIXEL_SCALE = 0.2
"""Pixel scale, arcsec."""
DETECTOR_SHAPE = (4000, 4072)
"""Rows and columns of a detector."""
_VISITS_PER_BLOCK = 500
"""Number of visits whose corners are computed at a time, because the intermediate arrays are larger than the result."""


def detector_centres() -> np.ndarray:
    """Return the centres (189, 2) of the detectors on the focal plane, arcsec: 21 rafts of 3 x 3 detectors.

    The pitch is 127 mm between rafts and 42.25 mm between detectors (LSST Camera, LCA-280); the plate scale is
    20 arcsec/mm.
    """
    centres = [
        (127.0 * raft_x + 42.25 * x, 127.0 * raft_y + 42.25 * y)
        for raft_y in range(-2, 3)
        for raft_x in range(-2, 3)
        if not (abs(raft_x) == 2 and abs(raft_y) == 2)
        for y in range(-1, 2)
        for x in range(-1, 2)
    ]
    return np.array(centres) * 20.0


CENTRES = detector_centres()
"""Centres of the detectors, (189, 2), arcsec along the x and y axes of the focal plane."""


def corners(visits: pd.DataFrame, shape: tuple[int, int]) -> np.ndarray:
    """Return the corners of all detectors of n visits on the sky.

    Parameters
    ----------
    visits : DataFrame
        Columns ra, dec and pa, degrees.
    shape : tuple of int
        Shape of a detector (ny, nx), pixels.

    Returns
    -------
    ndarray, shape (n, 189, 4, 2), degrees
        Right ascension and declination, in the order of `exposure.footprint`.
    """
    half = np.array(shape[::-1]) * PIXEL_SCALE / 2
    offsets = CENTRES[:, None, :] + half * np.array([[-1, -1], [1, -1], [1, 1], [-1, 1]])
    x, y = np.radians(offsets.reshape(-1, 2).T / 3600)
    sky = np.empty((len(visits), len(CENTRES), 4, 2))
    for first in range(0, len(visits), _VISITS_PER_BLOCK):
        block = slice(first, first + _VISITS_PER_BLOCK)
        ra, dec, pa = (np.radians(visits[name].to_numpy(float)[block])[:, None] for name in ("ra", "dec", "pa"))
        xi, eta = -x * np.cos(pa) + y * np.sin(pa), x * np.sin(pa) + y * np.cos(pa)
        # the inverse gnomonic projection: axes to the meridian of the boresight on the equator, and to the pole
        meridian, pole = np.cos(dec) - eta * np.sin(dec), np.sin(dec) + eta * np.cos(dec)
        corner_ra = np.degrees(ra + np.arctan2(xi, meridian)) % 360
        corner_dec = np.degrees(np.arctan2(pole, np.hypot(xi, meridian)))
        sky[block] = np.stack([corner_ra, corner_dec], axis=-1).reshape(-1, len(CENTRES), 4, 2)
    return sky


def header_of(detector: int, ra: float, dec: float, pa: float, shape: tuple[int, int]) -> dict:
    """Return the TAN header of a detector of a visit.

    Parameters
    ----------
    detector : int
        Number of the detector, 0 to 188.
    ra, dec, pa : float, degrees
        Boresight, and position angle of the +y axis of the focal plane.
    shape : tuple of int
        Shape of a detector (ny, nx), pixels.
    """
    angle = np.radians(pa)
    x, y = CENTRES[detector]
    step = PIXEL_SCALE / 3600
    return {
        "CTYPE1": "RA---TAN",
        "CTYPE2": "DEC--TAN",
        "CUNIT1": "deg",
        "CUNIT2": "deg",
        "CRVAL1": float(ra),
        "CRVAL2": float(dec),
        "CRPIX1": (shape[1] + 1) / 2 - x / PIXEL_SCALE,
        "CRPIX2": (shape[0] + 1) / 2 - y / PIXEL_SCALE,
        "CD1_1": -step * np.cos(angle),
        "CD1_2": step * np.sin(angle),
        "CD2_1": step * np.sin(angle),
        "CD2_2": step * np.cos(angle),
        "RADESYS": "ICRS",
    }
