"""Poisson numbers for the pixels of an image: the whole part of the mean from tables, the rest by inversion.

A Poisson number of mean m is the sum of two independent Poisson numbers, of the whole part of m and of its fractional
part. The tables of whole means fit in a processor's cache, and a number with a mean below one is found in a few steps:
together they take less than half the time of NumPy's rejection method, which draws the means that have no table.
"""

from __future__ import annotations

from functools import lru_cache

import numba
import numpy as np
from scipy.special import pdtr

MAX_TABLE_MEAN = 2048
"""Means below this have a table."""
_TABLE_SIGMAS = 7.5
"""Standard deviations from the mean that a table covers: one number in 10^13 lies beyond."""
_GUIDE_CELLS = 256
"""Number of cells of the unit interval; the guide has, for each cell, where in a table the search begins."""
_STRIP = 1024
"""Number of pixels that are worked on together."""
_STRIP_TERMS = 6
"""Terms of the distribution of the fractional part that are summed for a whole strip, without branches."""


def poisson(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Draw Poisson numbers.

    Each pixel uses one random number of 64 bits: 40 bits for the whole part of its mean, 24 bits for the fractional
    part.

    Parameters
    ----------
    mean : ndarray
        Means; they are rounded to float32.
    rng : Generator

    Returns
    -------
    ndarray, float32
        Whole numbers, as far as float32 holds them. The shape is that of `mean`.

    Raises
    ------
    ValueError
        If a mean is negative or not a number.
    """
    mean = np.ascontiguousarray(mean, np.float32)
    raw = rng.bit_generator.random_raw(mean.size)
    fraction = mean - np.floor(mean)
    np.negative(fraction, out=fraction)
    numbers = _numbers(mean.ravel(), np.exp(fraction, out=fraction).ravel(), raw, *_tables()).reshape(mean.shape)
    without_table = ~((mean >= 0) & (mean < MAX_TABLE_MEAN))
    if without_table.any():
        numbers[without_table] = rng.poisson(mean[without_table])
    return numbers


@lru_cache(maxsize=1)
def _tables() -> tuple[np.ndarray, np.ndarray, np.ndarray, np.ndarray]:
    """Return the cumulative distributions of all whole means below MAX_TABLE_MEAN.

    Returns
    -------
    starts : ndarray, shape (MAX_TABLE_MEAN + 1,)
        Index at which the table of each mean begins.
    least : ndarray, shape (MAX_TABLE_MEAN,)
        First number of each table.
    cumulative : ndarray, shape (starts[-1],)
        The tables, one after another.
    guide : ndarray, shape (MAX_TABLE_MEAN, _GUIDE_CELLS)
        Offset in the table at which the search begins, for each cell of the unit interval.
    """
    mean = np.arange(MAX_TABLE_MEAN)
    reach = _TABLE_SIGMAS * np.sqrt(mean)
    least = np.maximum(np.floor(mean - reach - 10), 0).astype(np.int64)
    length = np.ceil(mean + reach + 20).astype(np.int64) - least + 1
    starts = np.concatenate([[0], np.cumsum(length)])
    owner = np.repeat(mean, length)
    number = np.arange(starts[-1]) - np.repeat(starts[:-1] - least, length)
    cumulative = pdtr(number, owner.astype(float))
    # a search always ends at the last entry
    cumulative[starts[1:] - 1] = 2.0
    cells = np.arange(_GUIDE_CELLS) / _GUIDE_CELLS
    guide = np.stack([np.searchsorted(cumulative[a:b], cells) for a, b in zip(starts, starts[1:], strict=False)])
    return starts, least, cumulative, guide.astype(np.int16)


@numba.njit(nogil=True, cache=True)
def _numbers(mean, p_zero, raw, starts, least, cumulative, guide):
    """Return the numbers whose cumulative probabilities exceed the random numbers.

    `p_zero` is exp(-fractional part of the mean), the probability of 0. The other parameters are those of `poisson` and
    what `_tables` returns.
    """
    reciprocal = np.zeros(61, np.float32)
    for k in range(1, 61):
        reciprocal[k] = 1 / k
    size = mean.shape[0]
    out = np.empty(size, np.float32)
    fraction, remaining, probability = (
        np.empty(_STRIP, np.float32),
        np.empty(_STRIP, np.float32),
        np.empty(_STRIP, np.float32),
    )
    for first in range(0, size, _STRIP):
        count = min(_STRIP, size - first)
        numbers = out[first : first + count]
        for i in range(count):
            fraction[i] = mean[first + i] - np.floor(mean[first + i])
            probability[i] = p_zero[first + i]
            remaining[i] = np.float32(raw[first + i] & np.uint64(0xFFFFFF)) * np.float32(2.0**-24) - probability[i]
            numbers[i] = 0
        # sum the first few terms for all pixels at once, without a branch, and the rarely needed others pixel by pixel
        for k in range(1, _STRIP_TERMS):
            for i in range(count):
                numbers[i] += np.float32(remaining[i] > 0)
                probability[i] *= fraction[i] * reciprocal[k]
                remaining[i] -= probability[i]
        for i in range(count):
            k = _STRIP_TERMS - 1
            while remaining[i] > 0 and k < 60:
                numbers[i] += 1
                k += 1
                probability[i] *= fraction[i] * reciprocal[k]
                remaining[i] -= probability[i]
        for i in range(count):
            if 0 <= mean[first + i] < guide.shape[0]:
                whole = int(mean[first + i])
                uniform = np.float64(raw[first + i] >> np.uint64(24)) * 2.0**-40
                index = starts[whole] + guide[whole, int(uniform * _GUIDE_CELLS)]
                while cumulative[index] < uniform:
                    index += 1
                numbers[i] += least[whole] + index - starts[whole]
    return out
