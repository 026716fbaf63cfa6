"""Effects of Roman's detectors (SCAs), one function each: values in, values out, on a whole array or on some rows.

The order is that of Troxel et al. 2023, section 4.4: light (quantum efficiency, count-rate nonlinearity), the
brighter-fatter effect, persistence, dark current, saturation, classical nonlinearity, interpixel capacitance, bad
pixels, read noise, gain, bias, whole numbers.
"""

from __future__ import annotations

import numba
import numpy as np

STIMULI = np.array([1e3, 3e3, 1e4, 3e4, 1e5, 3e5])
"""Electrons at which persistence is measured, by plane of PERSIST."""
MEMORY = 10.0
"""Exposure times for which persistence is followed."""
RATE = 100.0
"""Electrons a second at which count-rate nonlinearity is defined to do nothing."""
LARGEST_DN = 65535
"""Of the data numbers that a detector returns."""


def expand(blocks: np.ndarray, block: int, rows: slice, columns: slice = slice(None)) -> np.ndarray:
    """Return values of blocks (..., ny, nx) at the pixels of some rows and columns.

    >>> expand(np.array([[1, 2]]), 2, slice(0, 1))
    array([[1, 1, 2, 2]])
    """
    ny, nx = (length * block for length in blocks.shape[-2:])
    first, last, _ = rows.indices(ny)
    # the rows of a block are one row, seen as many times as it is asked for
    wide = np.repeat(blocks[..., first // block : -(-last // block), :], block, axis=-1)[..., columns]
    if wide.shape[-2] == 1:
        return np.broadcast_to(wide, (*wide.shape[:-2], last - first, wide.shape[-1]))
    return wide[..., np.arange(first, last) // block - first // block, :]


def quantum_efficiency(light: np.ndarray, white: np.ndarray, coloured: np.ndarray) -> np.ndarray:
    """Return expected electrons from those of a detector of nominal efficiency.

    Parameters
    ----------
    light : (ny, nx) electrons
    white : (ny, nx) relative efficiency of each pixel (RELQE1)
    coloured : (ny, nx) or scalar, the blocks' (RELQE2), averaged over the band
    """
    return light * white * coloured


def band_mean(planes: np.ndarray, wave: np.ndarray, at: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the mean (...) over a band of planes (waves, ...) known at some wavelengths, nm.

    Parameters
    ----------
    wave : (waves,) ascending; beyond its ends the first and last planes hold
    at, weights : (n,) wavelengths of the band and the photons at each
    """
    place = np.interp(at, wave, np.arange(len(wave)))
    shares = np.clip(1 - np.abs(place[:, None] - np.arange(len(wave))), 0, 1)
    return np.tensordot((weights / np.sum(weights)) @ shares, planes, 1)


def quantum_yield(photons: np.ndarray, mean: np.ndarray | float, rng: np.random.Generator) -> np.ndarray:
    """Return electrons of photons that were caught: each makes one, and a second with a chance of mean - 1.

    Parameters
    ----------
    photons : (ny, nx) whole numbers
    mean : electrons a photon, 1 to 2 (QYIELD); shorter than about 0.8 micrometres it exceeds 1
    """
    if np.all(np.asarray(mean) <= 1):
        return photons
    return photons + rng.binomial(photons.astype(np.int64), np.clip(np.asarray(mean) - 1, 0, 1)).astype(photons.dtype)


def count_rate_nonlinearity(electrons: np.ndarray, exponent: np.ndarray | float, exptime: float) -> np.ndarray:
    """Return expected electrons as a detector collects them whose efficiency depends on the rate.

    A rate r, e/s, is counted as r (r / RATE)^exponent (CRNL; de Jong et al. 2006).
    """
    relative = np.maximum(electrons / (exptime * RATE), np.float32(1e-6))
    return electrons * np.exp(exponent * np.log(relative))


def count_rate_linearity(electrons: np.ndarray, exponent: np.ndarray | float, exptime: float) -> np.ndarray:
    """Return what `count_rate_nonlinearity` was given."""
    relative = np.maximum(electrons / (exptime * RATE), np.float32(1e-6))
    return electrons * np.exp(-exponent / (1 + np.asarray(exponent)) * np.log(relative))


def persistence(charge: np.ndarray, planes: np.ndarray, age: float) -> np.ndarray:
    """Return the current, e/s, that a pixel gives off after an exposure.

    Parameters
    ----------
    charge : (...,) electrons that the exposure left in pixels
    planes : (6, ...) electrons, f(Q) at the charges STIMULI (PERSIST)
    age : seconds since the exposure ended

    The current is f(Q) / age. Between the six charges f is linear, below the first it is proportional to the charge,
    above the last it is the power law through the last two.
    """
    charge = np.maximum(charge, 0)
    released = charge / STIMULI[0] * planes[0]
    for k in range(len(STIMULI) - 1):
        share = (charge - STIMULI[k]) / (STIMULI[k + 1] - STIMULI[k])
        between = planes[k] + share * (planes[k + 1] - planes[k])
        released = np.where(charge > STIMULI[k], between, released)
    with np.errstate(divide="ignore", invalid="ignore"):
        slope = np.log(planes[-1] / planes[-2]) / np.log(STIMULI[-1] / STIMULI[-2])
        beyond = planes[-1] * (np.maximum(charge, STIMULI[-1]) / STIMULI[-1]) ** slope
    high = (charge > STIMULI[-1]) & (planes[-2] > 0) & (planes[-1] > 0)
    return np.where(high, beyond, released) / age


def saturate(charge: np.ndarray, well: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return charge clipped at the full well (SATURATE), electrons, and where it was clipped."""
    return np.minimum(charge, well), charge >= well


def nonlinear(charge: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """Return the signal, electrons, of a charge Q: Q - b2 Q^2 - b3 Q^3 - b4 Q^4 (CNL: planes b2, b3, b4)."""
    return charge * (1 - charge * (planes[0] + charge * (planes[1] + charge * planes[2])))


def linear(signal: np.ndarray, planes: np.ndarray, steps: int = 4) -> np.ndarray:
    """Return the charge whose signal `nonlinear` gives, by Newton's steps; each squares an error of a per cent."""
    charge = np.asarray(signal, float)
    for _ in range(steps):
        slope = 1 - charge * (2 * planes[0] + charge * (3 * planes[1] + 4 * charge * planes[2]))
        charge = charge - (nonlinear(charge, planes) - signal) / np.maximum(slope, 0.1)
    return charge.astype(np.asarray(signal).dtype)


def interpixel_capacitance(
    signal: np.ndarray, kernels: np.ndarray, block: int, origin: tuple[int, int] = (0, 0)
) -> np.ndarray:
    """Return a signal (ny, nx) after every pixel has spread its own by its own kernel.

    Parameters
    ----------
    signal : (ny, nx) float32, electrons
    kernels : (3, 3, blocks y, blocks x), axes (dy, dx): the share of the source pixel's signal that appears there (IPC)
    block : pixels along a side of a block
    origin : row and column of the first pixel on the whole detector

    What would appear beyond the edge is lost.
    """
    kernels = np.ascontiguousarray(np.moveaxis(np.asarray(kernels, np.float32), (0, 1), (2, 3)))
    return _spread(np.ascontiguousarray(signal, np.float32), kernels, block, origin[0], origin[1])


@numba.njit(nogil=True, cache=True)
def _spread(signal, kernels, block, first_row, first_column):
    ny, nx = signal.shape
    out = np.zeros((ny, nx), np.float32)
    for y in range(ny):
        b = (first_row + y) // block
        x = 0
        while x < nx:
            a = (first_column + x) // block
            end = min(nx, (a + 1) * block - first_column)
            for j in range(-1, 2):
                if y + j < 0 or y + j >= ny:
                    continue
                for i in range(-1, 2):
                    share = kernels[b, a, j + 1, i + 1]
                    for k in range(max(x, -i), min(end, nx - i)):
                        out[y + j, k + i] += share * signal[y, k]
            x = end
    return out


def without_capacitance(
    signal: np.ndarray, kernels: np.ndarray, block: int, origin: tuple[int, int] = (0, 0), steps: int = 4
) -> np.ndarray:
    """Return the signal that `interpixel_capacitance` spread, by its Neumann series; each step gains a factor of 8."""
    found = signal.astype(np.float32)
    for _ in range(steps):
        found = found + (signal - interpixel_capacitance(found, kernels, block, origin))
    return found


def digitise(signal: np.ndarray, gain: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """Return data numbers (uint16) of signals in electrons: over the gain (e/DN), plus the bias, rounded, clipped."""
    return np.clip(np.rint(signal / gain + bias), 0, LARGEST_DN).astype(np.uint16)
