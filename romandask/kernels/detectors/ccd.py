"""CCDs of Rubin's camera: charge overflow, readout through sixteen amplifiers to data numbers, and calibration."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numba
import numpy as np

from romandask.kernels.detectors.simple_detector import NO_DATA, SATURATED

AMPLIFIERS = (2, 8)
"""Rows and columns of amplifiers on a CCD: each half of a pixel column is read out at its own end."""
GAIN, GAIN_SPREAD = 1.6, 0.03
"""Mean gain, electrons per data number, and its relative spread (1 sigma) among amplifiers."""
NOISE_SPREAD, WELL_SPREAD = 0.05, 0.05
"""Relative spread (1 sigma) of the read noise and of the full well among amplifiers."""
BIAS, BIAS_SPREAD = 22_000.0, 500.0
"""Mean bias level, data numbers, and its spread (1 sigma) among amplifiers."""
LARGEST_DN = (1 << 18) - 1
"""Largest data number of the 18-bit converter."""
COSMIC_RAY = 256
"""Bit of the dq plane for pixels hit by a cosmic ray."""
CCD_FLAGS = {"saturated": SATURATED, "no_data": NO_DATA, "cosmic_ray": COSMIC_RAY}
"""Bits of the dq plane (uint16), by name."""
COSMIC_RAY_THRESHOLD = 50.0
"""Charge of a cosmic ray in a pixel above which the pixel is flagged, electrons."""
RAYS = {"rate": 0.017, "depth": 100.0, "charge": 75.0}
"""Arguments of `cosmic_rays.tracks` for muons at the ground: rate, 1/cm2/s (one per cm2 and minute); thickness of the
silicon, micrometres; most probable charge, electrons per micrometre."""
ROWS = 250
"""Number of rows that share a random generator."""


@dataclass(frozen=True)
class Amplifiers:
    """Constants of the amplifiers of a CCD, each of shape (2, 8)."""

    gain: np.ndarray
    """Gain, electrons per data number."""
    bias: np.ndarray
    """Bias level, data numbers."""
    noise: np.ndarray
    """Read noise, electrons rms."""
    well: np.ndarray
    """Full well of a pixel, electrons."""


def amplifiers(random: np.random.Generator, noise: float, well: float) -> Amplifiers:
    """Draw the amplifiers of a CCD.

    Parameters
    ----------
    random : Generator
    noise : float, electrons
        Mean read noise.
    well : float, electrons
        Mean full well.
    """
    spread = random.standard_normal((4, *AMPLIFIERS))
    return Amplifiers(
        GAIN * (1 + GAIN_SPREAD * spread[0]),
        np.rint(BIAS + BIAS_SPREAD * spread[1]),
        noise * (1 + NOISE_SPREAD * spread[2]),
        well * (1 + WELL_SPREAD * spread[3]),
    )


def segments(shape: tuple[int, int]) -> list[tuple[int, int, slice, slice]]:
    """Return the pixels that each amplifier reads: (amplifier row, amplifier column, pixel rows, pixel columns)."""
    ny, nx = (np.linspace(0, length, count + 1).astype(int) for length, count in zip(shape, AMPLIFIERS, strict=True))
    return [
        (j, i, slice(ny[j], ny[j + 1]), slice(nx[i], nx[i + 1]))
        for j in range(AMPLIFIERS[0])
        for i in range(AMPLIFIERS[1])
    ]


def over_pixels(values: np.ndarray, shape: tuple[int, int], rows: slice) -> np.ndarray:
    """Return the values of the amplifiers at each pixel of some rows.

    Parameters
    ----------
    values : ndarray, shape (2, 8)
        One value per amplifier.
    shape : tuple of int
        Rows and columns of the CCD.
    rows : slice

    Returns
    -------
    ndarray, shape (rows, columns), float32
    """
    out = np.empty((rows.stop - rows.start, shape[1]), np.float32)
    for j, i, own_rows, own_columns in segments(shape):
        low = max(own_rows.start, rows.start) - rows.start
        high = min(own_rows.stop, rows.stop) - rows.start
        if high > low:
            out[low:high, own_columns] = values[j, i]
    return out


def _over_rows(amplifiers: Amplifiers, shape: tuple[int, int], rows: slice) -> Iterator[np.ndarray]:
    """Yield gain, bias and read noise at each pixel of some rows."""
    for values in (amplifiers.gain, amplifiers.bias, amplifiers.noise):
        yield over_pixels(values, shape, rows)


def bleed(charge: np.ndarray, amplifiers: Amplifiers) -> tuple[np.ndarray, np.ndarray]:
    """Return the charge after bleeding: no pixel holds more than its full well.

    The excess charge of a pixel moves along its column, half in each direction, to the nearest pixels that are not
    full. It does not cross the middle of the CCD, where it turns back; it is lost at the ends of the columns.

    Parameters
    ----------
    charge : ndarray, shape (ny, nx), float32, electrons
    amplifiers : Amplifiers

    Returns
    -------
    charge : ndarray, shape (ny, nx), float32, electrons
    full : ndarray, shape (ny, nx), bool
        True for pixels at their full well.
    """
    full = np.empty(charge.shape, bool)
    out = charge.copy()
    for j, i, rows, columns in segments(charge.shape):
        # flip the upper half: charge is then lost beyond the first row, and the last row is at the middle of the CCD
        half = out[rows, columns] if j == 0 else out[rows, columns][::-1]
        at_well = full[rows, columns] if j == 0 else full[rows, columns][::-1]
        _bleed(half, np.float32(amplifiers.well[j, i]))
        at_well[:] = half >= amplifiers.well[j, i] * (1 - 1e-6)
    return out, full


@numba.njit(nogil=True, cache=True)
def _bleed(charge, well):
    """Spread the excess charge of full pixels along their columns, in place; row 0 is the end that is read out."""
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
            # charge that reaches the middle of the CCD turns back
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
    """Return the data numbers of a charge.

    Parameters
    ----------
    charge : ndarray, shape (ny, nx), electrons
    amplifiers : Amplifiers
    generators : callable
        Returns the random generator of a block of ROWS rows, given the number of the block.

    Returns
    -------
    ndarray, shape (ny, nx), int32, data numbers
    """
    raw = np.empty(charge.shape, np.int32)
    for block, first in enumerate(range(0, charge.shape[0], ROWS)):
        rows = slice(first, min(first + ROWS, charge.shape[0]))
        gain, bias, noise = _over_rows(amplifiers, charge.shape, rows)
        drawn = generators(block).standard_normal(gain.shape, dtype=np.float32)
        raw[rows] = np.clip(np.rint((charge[rows] + noise * drawn) / gain + bias), 0, LARGEST_DN)
    return raw


def calibrate(raw: np.ndarray, amplifiers: Amplifiers) -> tuple[np.ndarray, np.ndarray]:
    """Return the calibrated image of data numbers, and its variance.

    Parameters
    ----------
    raw : ndarray, shape (ny, nx), int32, data numbers
    amplifiers : Amplifiers

    Returns
    -------
    image : ndarray, shape (ny, nx), float32, electrons
        It includes the sky.
    variance : ndarray, shape (ny, nx), float32, electrons^2
    """
    image, variance = (np.empty(raw.shape, np.float32) for _ in range(2))
    for first in range(0, raw.shape[0], ROWS):
        rows = slice(first, min(first + ROWS, raw.shape[0]))
        gain, bias, noise = _over_rows(amplifiers, raw.shape, rows)
        image[rows] = (raw[rows] - bias) * gain
        # Poisson noise, read noise, and rounding to whole data numbers
        variance[rows] = np.maximum(image[rows], 0) + noise**2 + gain**2 / 12
    return image, variance
