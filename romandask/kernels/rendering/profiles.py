"""Surface brightness of galaxy profiles, from tables, and the radii that contain their light."""

from __future__ import annotations

from functools import lru_cache

import numba
import numpy as np
from scipy.special import gammaincc

from romandask.kernels.rendering.fourier import DEVAUCOULEURS, EXPONENTIAL

EXPONENTIAL_B = 1.6783469900166605
"""b of the profile exp(-b r) of an exponential disk, where r is in half-light radii."""
DEVAUCOULEURS_B = 7.669249442500805
"""b of the de Vaucouleurs profile exp(-b r^(1/4)), where r is in half-light radii."""
_DEVAUCOULEURS_FLUX = 5040 * 4 * 2 * np.pi / DEVAUCOULEURS_B**8
"""Flux of the de Vaucouleurs profile exp(-b r^(1/4)) with half-light radius 1: 8 pi Gamma(8) / b^8."""
_FIRST_OCTAVE, _OCTAVES, _CELL_BITS = -16, 40, 6
"""The tables have 64 cells in each octave of r^2, from 2^-16 on. The cell of a float32 is read from its bits."""
_SHIFT = 23 - _CELL_BITS
_FIRST_CELL = (127 + _FIRST_OCTAVE) << _CELL_BITS


@lru_cache(maxsize=1)
def profile_tables() -> np.ndarray:
    """Return tables of the surface brightness of an exponential and of a de Vaucouleurs profile, of flux 1.

    Returns
    -------
    float64 array, shape (2, cells + 1)
        Surface brightness at squares of the radius, in units of the half-light radius: 64 steps in each octave.
    """
    octave, step = np.divmod(np.arange((_OCTAVES << _CELL_BITS) + 1), 1 << _CELL_BITS)
    radius = np.sqrt(2.0 ** (octave + _FIRST_OCTAVE) * (1 + step / (1 << _CELL_BITS)))
    disk = EXPONENTIAL_B**2 / (2 * np.pi) * np.exp(-EXPONENTIAL_B * radius)
    return np.stack([disk, np.exp(-DEVAUCOULEURS_B * radius**0.25) / _DEVAUCOULEURS_FLUX])


@numba.njit(nogil=True, cache=True)
def surface_brightness(tables, kind, square):
    """Return the surface brightness, times |det M|, of a galaxy profile of flux 1.

    Parameters
    ----------
    tables : float64 array
        Result of `profile_tables`.
    kind : int
        EXPONENTIAL or DEVAUCOULEURS.
    square : float
        Square of the distance from the centre in the frame in which the profile is round, in half-light radii.
    """
    bits = np.float32(max(square, 2.0**_FIRST_OCTAVE)).view(np.int32)
    index = min((bits >> _SHIFT) - _FIRST_CELL, tables.shape[1] - 2)
    fraction = (bits & ((1 << _SHIFT) - 1)) * (1.0 / (1 << _SHIFT))
    row = 0 if kind == EXPONENTIAL else 1
    return tables[row, index] + fraction * (tables[row, index + 1] - tables[row, index])


@lru_cache(maxsize=1)
def _tails() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Return radii, and the logarithms of the light outside them of both profiles."""
    radius = np.geomspace(0.1, 2000, 400)
    disk = gammaincc(2, EXPONENTIAL_B * radius)
    return radius, np.log(np.maximum(disk, 1e-30)), np.log(gammaincc(8, DEVAUCOULEURS_B * radius**0.25))


def light_radius(kind: np.ndarray, outside: np.ndarray) -> np.ndarray:
    """Return the radii of round profiles beyond which a fraction of their light lies.

    Parameters
    ----------
    kind : int array, shape (n,)
        Kinds of components.
    outside : array, shape (n,)
        Fractions.

    Returns
    -------
    array, shape (n,), half-light radii
        Radii; 0 for kinds other than EXPONENTIAL and DEVAUCOULEURS.
    """
    radius, disk, bulge = _tails()
    wanted = np.log(np.clip(outside, 1e-12, 1))
    out = np.zeros(len(kind))
    for one, tail in ((EXPONENTIAL, disk), (DEVAUCOULEURS, bulge)):
        chosen = kind == one
        out[chosen] = np.interp(-wanted[chosen], -tail, radius)
    return out
