"""A CCD of Rubin's camera: from electrons to data numbers of sixteen amplifiers, and back."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numba
import numpy as np

from romandask.kernels.detectors.simple_detector import NO_DATA, SATURATED

AMPLIFIERS = (2, 8)
"""Rows and columns of the amplifiers: each half of a column is read at its own end."""
GAIN, GAIN_SPREAD = 1.6, 0.03
"""Electrons a data number, and its spread among amplifiers (relative)."""
NOISE_SPREAD, WELL_SPREAD = 0.05, 0.05
"""Of read noise and full well, relative."""
BIAS, BIAS_SPREAD = 22_000.0, 500.0
"""Data numbers that are added before conversion."""
LARGEST_DN = (1 << 18) - 1
"""Largest data number."""
COSMIC_RAY = 256
CCD_FLAGS = {"saturated": SATURATED, "no_data": NO_DATA, "cosmic_ray": COSMIC_RAY}
"""Bits of the dq plane (uint16)."""
FOUND = 50.0
"""Electrons of a cosmic ray, in a pixel, from which on it is taken to be found."""
RAYS = {"rate": 0.017, "depth": 100.0, "charge": 75.0}
"""Of muons at the ground: one a cm2 and minute; micrometres of silicon; electrons a micrometre, the most probable."""
ROWS = 250
"""Rows that share a random generator."""


@dataclass(frozen=True)
class Amplifiers:
    """What the amplifiers of a CCD do; arrays (2, 8)."""

    gain: np.ndarray
    """Electrons a data number."""
    bias: np.ndarray
    """Data numbers."""
    noise: np.ndarray
    """Electrons rms."""
    well: np.ndarray
    """Electrons that a pixel holds."""


def amplifiers(random: np.random.Generator, noise: float, well: float) -> Amplifiers:
    """Return amplifiers of some mean read noise and full well, electrons."""
    spread = random.standard_normal((4, *AMPLIFIERS))
    return Amplifiers(
        GAIN * (1 + GAIN_SPREAD * spread[0]),
        np.rint(BIAS + BIAS_SPREAD * spread[1]),
        noise * (1 + NOISE_SPREAD * spread[2]),
        well * (1 + WELL_SPREAD * spread[3]),
    )


def segments(shape: tuple[int, int]) -> list[tuple[int, int, slice, slice]]:
    """Return row and column of each amplifier with the rows and columns of pixels that it reads."""
    ny, nx = (np.linspace(0, side, count + 1).astype(int) for side, count in zip(shape, AMPLIFIERS, strict=True))
    return [
        (j, i, slice(ny[j], ny[j + 1]), slice(nx[i], nx[i + 1]))
        for j in range(AMPLIFIERS[0])
        for i in range(AMPLIFIERS[1])
    ]


def over_pixels(values: np.ndarray, shape: tuple[int, int], rows: slice) -> np.ndarray:
    """Return a number of each amplifier over some rows of pixels, float32."""
    out = np.empty((rows.stop - rows.start, shape[1]), np.float32)
    for j, i, up, across in segments(shape):
        low, high = max(up.start, rows.start) - rows.start, min(up.stop, rows.stop) - rows.start
        if high > low:
            out[low:high, across] = values[j, i]
    return out


def _over_rows(amplifiers: Amplifiers, shape: tuple[int, int], rows: slice) -> Iterator[np.ndarray]:
    """Yield gain, bias and read noise over some rows of pixels."""
    for values in (amplifiers.gain, amplifiers.bias, amplifiers.noise):
        yield over_pixels(values, shape, rows)


def bleed(charge: np.ndarray, amplifiers: Amplifiers) -> tuple[np.ndarray, np.ndarray]:
    """Return a charge (float32, electrons) of which no pixel holds more than its well, and which pixels are full.

    What a pixel cannot hold goes along its column, half of it either way, to the nearest pixels with room. It does not
    cross the middle of the CCD, and leaves it at the ends of the columns.
    """
    full = np.empty(charge.shape, bool)
    out = charge.copy()
    for j, i, rows, columns in segments(charge.shape):
        # turned, so that charge leaves past the first row: the last is the middle of the CCD
        part = out[rows, columns] if j == 0 else out[rows, columns][::-1]
        marks = full[rows, columns] if j == 0 else full[rows, columns][::-1]
        _bleed(part, np.float32(amplifiers.well[j, i]))
        marks[:] = part >= amplifiers.well[j, i] * (1 - 1e-6)
    return out, full


@numba.njit(nogil=True, cache=True)
def _bleed(charge, well):
    ny, nx = charge.shape
    for x in range(nx):
        for y in range(ny):
            if charge[y, x] <= well:
                continue
            excess = charge[y, x] - well
            charge[y, x] = well
            down, up = excess / 2, excess / 2
            k = y + 1
            while up > 0 and k < ny:
                moved = min(up, max(well - charge[k, x], np.float32(0)))
                charge[k, x] += moved
                up -= moved
                k += 1
            # what finds no room before the middle of the CCD turns back
            down += up
            k = y - 1
            while down > 0 and k >= 0:
                moved = min(down, max(well - charge[k, x], np.float32(0)))
                charge[k, x] += moved
                down -= moved
                k -= 1


def read_out(
    charge: np.ndarray, amplifiers: Amplifiers, generators: Callable[[int], np.random.Generator]
) -> np.ndarray:
    """Return what is read (int32, data numbers) of a charge (electrons).

    Parameters
    ----------
    generators : gives the random generator of a block of ROWS rows
    """
    raw = np.empty(charge.shape, np.int32)
    for block, first in enumerate(range(0, charge.shape[0], ROWS)):
        rows = slice(first, min(first + ROWS, charge.shape[0]))
        gain, bias, noise = _over_rows(amplifiers, charge.shape, rows)
        drawn = generators(block).standard_normal(gain.shape, dtype=np.float32)
        raw[rows] = np.clip(np.rint((charge[rows] + noise * drawn) / gain + bias), 0, LARGEST_DN)
    return raw


def calibrate(raw: np.ndarray, amplifiers: Amplifiers) -> tuple[np.ndarray, np.ndarray]:
    """Return the image (float32, electrons, sky included) and its variance of what was read."""
    image, variance = (np.empty(raw.shape, np.float32) for _ in range(2))
    for first in range(0, raw.shape[0], ROWS):
        rows = slice(first, min(first + ROWS, raw.shape[0]))
        gain, bias, noise = _over_rows(amplifiers, raw.shape, rows)
        image[rows] = (raw[rows] - bias) * gain
        # of Poisson numbers, read noise and whole data numbers
        variance[rows] = np.maximum(image[rows], 0) + noise**2 + gain**2 / 12
    return image, variance
