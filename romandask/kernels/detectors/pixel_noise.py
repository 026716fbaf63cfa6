"""Gaussian noise that is a function of the pixel: a window has the noise of the whole detector, at its own cost.

Each pixel has random numbers of its own: its number on the detector, added to a key in steps of an odd constant, goes
through the finaliser of SplitMix64 (Steele, Lea & Flood 2014). Normal deviates are made from them with the ziggurat
method (Marsaglia & Tsang 2000; Doornik 2005), whose rare rejected trials take the next numbers of the pixel.
"""

from __future__ import annotations

import numba
import numpy as np

_LAYERS = 256
"""Layers of the ziggurat, of equal area."""
_TAIL = 3.6541528853610088
"""Where the lowest layer ends, and the tail begins."""
_AREA = 4.92867323399e-3
"""Area of a layer."""
_TRIALS = 64
"""Largest number of random numbers of a pixel; a pixel needs more with a probability below 1e-100."""


def _edges() -> np.ndarray:
    """Return the right edges of the layers, from the lowest to 0 (Doornik 2005)."""
    area = _AREA
    edges = np.zeros(_LAYERS + 1)
    edges[0], edges[1] = area / np.exp(-0.5 * _TAIL**2), _TAIL
    for k in range(2, _LAYERS):
        edges[k] = np.sqrt(-2 * np.log(area / edges[k - 1] + np.exp(-0.5 * edges[k - 1] ** 2)))
    return edges


_EDGES = _edges()


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _mixed(z):
    """Return the finaliser of SplitMix64."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    return z ^ (z >> np.uint64(31))


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _uniform(bits):
    """Return a number from 0 to 1, neither included, from the upper 53 of 64 bits."""
    return (np.float64(bits >> np.uint64(11)) + 0.5) * (1.0 / 9007199254740992.0)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def normal_deviate(key, number):
    """Return the normal deviate of a pixel, given a key and the number of the pixel, both uint64."""
    state = _mixed(key + number * np.uint64(0x9E3779B97F4A7C15))
    for trial in range(_TRIALS):
        bits = state if trial == 0 else _mixed(state + np.uint64(trial) * np.uint64(0xD1342543DE82EF95))
        layer = np.int64(bits & np.uint64(255))
        u = 2.0 * _uniform(bits) - 1.0
        x = u * _EDGES[layer]
        if abs(x) < _EDGES[layer + 1]:
            return x
        more = _mixed(bits + np.uint64(0xA0761D6478BD642F))
        v = _uniform(more)
        if layer == 0:
            # beyond the lowest layer: the tail
            w = _uniform(_mixed(more + np.uint64(0xE7037ED1A0B428DB)))
            far = -np.log(v) / _TAIL
            if -2.0 * np.log(w) >= far * far:
                return (_TAIL + far) if u > 0 else -(_TAIL + far)
        else:
            outer, inner = np.exp(-0.5 * (_EDGES[layer] ** 2 - x * x)), np.exp(-0.5 * (_EDGES[layer + 1] ** 2 - x * x))
            if outer + v * (inner - outer) < 1.0:
                return x
    return 0.0


@numba.njit(nogil=True, cache=True, error_model="numpy")
def pixel_noise(variance, width, first_row, first_column, key):
    """Return Gaussian noise of zero mean and given variance for a window of a detector.

    Parameters
    ----------
    variance : ndarray, shape (ny, nx), float32
        Variance of the pixels of the window.
    width : int
        Columns of the whole detector.
    first_row, first_column : int
        First pixel of the window.
    key : uint64
        Key of the realisation.

    Returns
    -------
    ndarray, shape (ny, nx), float32
    """
    noise = np.empty(variance.shape, np.float32)
    for y in range(variance.shape[0]):
        for x in range(variance.shape[1]):
            number = np.uint64((first_row + y) * width + first_column + x)
            noise[y, x] = np.float32(normal_deviate(key, number)) * np.sqrt(variance[y, x])
    return noise
