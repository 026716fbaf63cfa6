"""Poisson numbers of the pixels of an image: whole means from tables, what is left of them by inversion.

A Poisson number of mean m is the sum of one of the whole part of m and one of the rest, independent of each other. The
tables of whole means fit a processor's cache, and numbers below one are few: both together take less than half the time
of the rejection method of NumPy, which draws the means that no table has.
"""

from __future__ import annotations

from functools import lru_cache

import numba
import numpy as np
from scipy.special import pdtr

MOST = 2048
"""Largest mean that has a table."""
_REACH = 7.5
"""Standard deviations that tables reach from their mean: one number in 10^13 lies beyond."""
_CELLS = 256
"""Of the unit interval, for each of which the guide tells where in a table to begin."""
_STRIP = 1024
"""Pixels whose numbers are found together."""
_ALIKE = 6
"""Numbers up to this are found for a whole strip."""


def poisson(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return Poisson numbers (float32, as whole as that holds) of an array of means.

    One random number of 64 bits decides a pixel: 40 of them the number of the whole part of its mean, 24 that of the
    rest.

    Raises
    ------
    ValueError
        If a mean is negative or not a number.
    """
    mean = np.ascontiguousarray(mean, np.float32)
    raw = rng.bit_generator.random_raw(mean.size)
    rest = mean - np.floor(mean)
    np.negative(rest, out=rest)
    found = _numbers(mean.ravel(), np.exp(rest, out=rest).ravel(), raw, *_tables()).reshape(mean.shape)
    others = ~((mean >= 0) & (mean < MOST))
    if others.any():
        found[others] = rng.poisson(mean[others])
    return found


@lru_cache(maxsize=1)
def _tables() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return, of whole means below MOST: where each table begins, its first number, all tables, and the guide."""
    mean = np.arange(MOST)
    reach = _REACH * np.sqrt(mean)
    least = np.maximum(np.floor(mean - reach - 10), 0).astype(np.int64)
    length = np.ceil(mean + reach + 20).astype(np.int64) - least + 1
    starts = np.concatenate([[0], np.cumsum(length)])
    owner = np.repeat(mean, length)
    number = np.arange(starts[-1]) - np.repeat(starts[:-1] - least, length)
    cumulative = pdtr(number, owner.astype(float))
    # no uniform number passes the last
    cumulative[starts[1:] - 1] = 2.0
    cells = np.arange(_CELLS) / _CELLS
    guide = np.stack([np.searchsorted(cumulative[a:b], cells) for a, b in zip(starts, starts[1:], strict=False)])
    return starts, least, cumulative, guide.astype(np.int16)


@numba.njit(nogil=True, cache=True)
def _numbers(mean, none, raw, starts, least, cumulative, guide):
    """Return the numbers whose cumulative probabilities pass the random ones; `none` is exp(-rest of the mean)."""
    over = np.zeros(61, np.float32)
    for k in range(1, 61):
        over[k] = 1 / k
    size = mean.shape[0]
    out = np.empty(size, np.float32)
    rest, left, share = np.empty(_STRIP, np.float32), np.empty(_STRIP, np.float32), np.empty(_STRIP, np.float32)
    for first in range(0, size, _STRIP):
        count = min(_STRIP, size - first)
        found = out[first : first + count]
        for i in range(count):
            rest[i] = mean[first + i] - np.floor(mean[first + i])
            share[i] = none[first + i]
            left[i] = np.float32(raw[first + i] & np.uint64(0xFFFFFF)) * np.float32(2.0**-24) - share[i]
            found[i] = 0
        # the first few numbers for all pixels at once, without a branch; the rare larger ones one by one
        for k in range(1, _ALIKE):
            for i in range(count):
                found[i] += np.float32(left[i] > 0)
                share[i] *= rest[i] * over[k]
                left[i] -= share[i]
        for i in range(count):
            k = _ALIKE - 1
            while left[i] > 0 and k < 60:
                found[i] += 1
                k += 1
                share[i] *= rest[i] * over[k]
                left[i] -= share[i]
        for i in range(count):
            if 0 <= mean[first + i] < guide.shape[0]:
                whole = int(mean[first + i])
                uniform = np.float64(raw[first + i] >> np.uint64(24)) * 2.0**-40
                place = starts[whole] + guide[whole, int(uniform * _CELLS)]
                while cumulative[place] < uniform:
                    place += 1
                found[i] += least[whole] + place - starts[whole]
    return out
