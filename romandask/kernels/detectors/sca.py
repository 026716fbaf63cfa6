"""Effects of Roman's detectors (SCAs), one function each, on a whole array or on some of its rows.

The order is that of Troxel et al. 2023, section 4.4: light (quantum efficiency, count-rate nonlinearity), the
brighter-fatter effect, persistence, dark current, saturation, classical nonlinearity, interpixel capacitance, bad
pixels, read noise, gain, bias, rounding to whole data numbers. Names in capitals (RELQE1) are the calibrations of the
paper's table 1.
"""

from __future__ import annotations

import numba
import numpy as np

STIMULI = np.array([1e3, 3e3, 1e4, 3e4, 1e5, 3e5])
"""Charges at which persistence is measured, one for each plane of PERSIST, electrons."""
MEMORY = 10.0
"""Time for which persistence is followed, in units of the exposure time."""
REFERENCE_RATE = 100.0
"""Count rate at which count-rate nonlinearity has no effect by definition, electrons per second."""
LARGEST_DN = 65535
"""Largest data number that a detector returns."""


def expand(blocks: np.ndarray, block: int, rows: slice, columns: slice = slice(None)) -> np.ndarray:
    """Return the values of blocks of pixels at the pixels of some rows and columns.

    Parameters
    ----------
    blocks : ndarray, shape (..., blocks y, blocks x)
    block : int
        Pixels along a side of a block.
    rows, columns : slice
        Pixels of the whole detector.

    Returns
    -------
    ndarray, shape (..., rows, columns)
        A read-only view if all rows lie in one block.

    Examples
    --------
    >>> expand(np.array([[1, 2]]), 2, slice(0, 1))
    array([[1, 1, 2, 2]])
    """
    ny, nx = (length * block for length in blocks.shape[-2:])
    first, last, _ = rows.indices(ny)
    # rows of one block are equal: broadcast one row instead of copying it
    wide = np.repeat(blocks[..., first // block : -(-last // block), :], block, axis=-1)[..., columns]
    if wide.shape[-2] == 1:
        return np.broadcast_to(wide, (*wide.shape[:-2], last - first, wide.shape[-1]))
    return wide[..., np.arange(first, last) // block - first // block, :]


def quantum_efficiency(light: np.ndarray, white: np.ndarray, coloured: np.ndarray) -> np.ndarray:
    """Apply the relative quantum efficiency to expected electrons at nominal efficiency.

    Parameters
    ----------
    light : ndarray, shape (ny, nx), electrons
    white : ndarray, shape (ny, nx)
        Relative efficiency of each pixel (RELQE1).
    coloured : ndarray, shape (ny, nx), or float
        Relative efficiency of the blocks of pixels, averaged over the band (RELQE2).
    """
    return light * white * coloured


def band_mean(planes: np.ndarray, wave: np.ndarray, band_wave: np.ndarray, weights: np.ndarray) -> np.ndarray:
    """Return the mean over a band of planes that are known at some wavelengths.

    Parameters
    ----------
    planes : ndarray, shape (waves, ...)
    wave : ndarray, shape (waves,), nm
        Wavelengths of the planes, ascending. Beyond its ends the first and the last plane are used.
    band_wave : ndarray, shape (n,), nm
        Wavelengths of the band.
    weights : ndarray, shape (n,)
        Photons at each wavelength of the band.

    Returns
    -------
    ndarray, shape (...)
    """
    position = np.interp(band_wave, wave, np.arange(len(wave)))
    shares = np.clip(1 - np.abs(position[:, None] - np.arange(len(wave))), 0, 1)
    return np.tensordot((weights / np.sum(weights)) @ shares, planes, 1)


def quantum_yield(photons: np.ndarray, mean: np.ndarray | float, rng: np.random.Generator) -> np.ndarray:
    """Return the electrons of detected photons: each makes one, and a second one with a probability of `mean` - 1.

    Parameters
    ----------
    photons : ndarray, shape (ny, nx), whole numbers
    mean : ndarray, shape (ny, nx), or float
        Mean electrons per photon, 1 to 2 (QYIELD); it exceeds 1 at wavelengths below about 0.8 micrometres.
    rng : Generator

    Returns
    -------
    ndarray, shape (ny, nx)
        `photons` itself if no mean exceeds 1.
    """
    if np.all(np.asarray(mean) <= 1):
        return photons
    return photons + rng.binomial(photons.astype(np.int64), np.clip(np.asarray(mean) - 1, 0, 1)).astype(photons.dtype)


def count_rate_nonlinearity(electrons: np.ndarray, exponent: np.ndarray | float, exptime: float) -> np.ndarray:
    """Apply count-rate nonlinearity to expected electrons.

    A rate r is counted as r (r / REFERENCE_RATE)^exponent (de Jong et al. 2006).

    Parameters
    ----------
    electrons : ndarray, electrons
    exponent : ndarray or float
        Exponent of the count rate (CRNL).
    exptime : float, seconds
    """
    relative = np.maximum(electrons / (exptime * REFERENCE_RATE), np.float32(1e-6))
    return electrons * np.exp(exponent * np.log(relative))


def count_rate_linearity(electrons: np.ndarray, exponent: np.ndarray | float, exptime: float) -> np.ndarray:
    """Undo `count_rate_nonlinearity`; the parameters are the same."""
    relative = np.maximum(electrons / (exptime * REFERENCE_RATE), np.float32(1e-6))
    return electrons * np.exp(-exponent / (1 + np.asarray(exponent)) * np.log(relative))


def persistence(charge: np.ndarray, planes: np.ndarray, age: float) -> np.ndarray:
    """Return the persistence current of pixels after an exposure.

    The current is f(Q) / age. f is linear between the six charges STIMULI, proportional to the charge below the first,
    and the power law through the last two above the last.

    Parameters
    ----------
    charge : ndarray, shape (...), electrons
        Charge Q that the exposure collected.
    planes : ndarray, shape (6, ...), electrons
        f(Q) at the charges STIMULI (PERSIST).
    age : float, seconds
        Time since the exposure ended.

    Returns
    -------
    ndarray, shape (...), electrons per second
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
    """Clip charge at the full well (SATURATE), electrons; return it and a mask of the pixels at the full well."""
    return np.minimum(charge, well), charge >= well


def nonlinear(charge: np.ndarray, planes: np.ndarray) -> np.ndarray:
    """Apply classical nonlinearity to a charge Q: return Q - b2 Q^2 - b3 Q^3 - b4 Q^4.

    Parameters
    ----------
    charge : ndarray, shape (...), electrons
    planes : ndarray, shape (3, ...)
        Coefficients b2, b3, b4 (CNL), 1/electron, 1/electron^2, 1/electron^3.

    Returns
    -------
    ndarray, shape (...), electrons
    """
    return charge * (1 - charge * (planes[0] + charge * (planes[1] + charge * planes[2])))


def linear(signal: np.ndarray, planes: np.ndarray, steps: int = 4) -> np.ndarray:
    """Undo `nonlinear` with some steps of Newton's method.

    Each step squares the relative error, which is about a per cent at first.
    """
    charge = np.asarray(signal, float)
    for _ in range(steps):
        slope = 1 - charge * (2 * planes[0] + charge * (3 * planes[1] + 4 * charge * planes[2]))
        charge = charge - (nonlinear(charge, planes) - signal) / np.maximum(slope, 0.1)
    return charge.astype(np.asarray(signal).dtype)


def interpixel_capacitance(
    signal: np.ndarray, kernels: np.ndarray, block: int, origin: tuple[int, int] = (0, 0)
) -> np.ndarray:
    """Apply interpixel capacitance: spread the signal of every pixel over its neighbours with the pixel's own kernel.

    Signal that would appear beyond the edge is lost.

    Parameters
    ----------
    signal : ndarray, shape (ny, nx), float32, electrons
    kernels : ndarray, shape (3, 3, blocks y, blocks x)
        Share of the source pixel's signal that appears at (dy, dx) from it, for each block of pixels (IPC).
    block : int
        Pixels along a side of a block.
    origin : tuple of int
        Row and column, on the whole detector, of the first pixel.

    Returns
    -------
    ndarray, shape (ny, nx), float32, electrons
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
    """Undo `interpixel_capacitance` with its Neumann series; each step reduces the error by a factor of 8."""
    corrected = signal.astype(np.float32)
    for _ in range(steps):
        corrected = corrected + (signal - interpixel_capacitance(corrected, kernels, block, origin))
    return corrected


def digitise(signal: np.ndarray, gain: np.ndarray, bias: np.ndarray) -> np.ndarray:
    """Return the data numbers of a signal: divided by the gain, plus the bias, rounded and clipped.

    Parameters
    ----------
    signal : ndarray, electrons
    gain : ndarray, electrons per data number
    bias : ndarray, data numbers

    Returns
    -------
    ndarray, uint16
    """
    return np.clip(np.rint(signal / gain + bias), 0, LARGEST_DN).astype(np.uint16)
