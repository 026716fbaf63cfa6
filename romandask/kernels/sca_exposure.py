"""One exposure of an SCA: from expected light to data numbers with every effect, and back to electrons of light."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np

from romandask.kernels.brighter_fatter import brighter_fatter
from romandask.kernels.detector import SATURATED
from romandask.kernels.sca import (
    count_rate_linearity,
    count_rate_nonlinearity,
    digitise,
    expand,
    interpixel_capacitance,
    linear,
    nonlinear,
    quantum_efficiency,
    quantum_yield,
    saturate,
    without_capacitance,
)
from romandask.kernels.synthetic_sca import ADJACENT, BORDER, DISCONNECTED, HOT, LOW_EFFICIENCY, NOISY, SIDE

DISCONNECTED_FLAG, HOT_FLAG, ADJACENT_FLAG, LOW_EFFICIENCY_FLAG, NOISY_FLAG, PERSISTENCE_FLAG = 4, 8, 16, 32, 64, 128
FLAGS = {
    "disconnected": DISCONNECTED_FLAG, "hot": HOT_FLAG, "adjacent": ADJACENT_FLAG,
    "low_efficiency": LOW_EFFICIENCY_FLAG, "noisy": NOISY_FLAG, "persistence": PERSISTENCE_FLAG,
}  # fmt: skip
"""Bits of the dq plane beside those of the simple detector."""
_OF_PIXELS = (
    (DISCONNECTED, DISCONNECTED_FLAG), (HOT, HOT_FLAG), (ADJACENT, ADJACENT_FLAG),
    (LOW_EFFICIENCY, LOW_EFFICIENCY_FLAG), (NOISY, NOISY_FLAG),
)  # fmt: skip
_ROWS = 512
"""Rows that share a random generator."""
_SMALL = 20.0
"""Expected electrons up to which Poisson numbers are found by inversion."""

Planes = Callable[[str, slice], np.ndarray]
"""Gives some rows of the whole detector (BORDER included) of a named calibration; blocks, whole, where it has those."""
Generators = Callable[[str, int], np.random.Generator]
"""Gives the random generator of a named step and a block of rows."""


@dataclass(frozen=True)
class Response:
    """How an SCA answers the light of one band."""

    efficiency: np.ndarray
    """(64, 64) relative quantum efficiency of blocks of 64 pixels, averaged over the band."""
    electrons: np.ndarray
    """(32, 32) electrons a photon, of blocks of 128 pixels, averaged over the band."""
    exptime: float
    """Seconds."""


def expose(
    light: np.ndarray,
    planes: Planes,
    response: Response,
    generators: Generators,
    afterglow: np.ndarray | None = None,
    rays: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return data numbers (uint16) and dq (uint8), both (4088, 4088), of an exposure.

    Parameters
    ----------
    light : (4088, 4088) expected electrons of objects, sky and thermal emission, at nominal efficiency
    afterglow : (4088, 4088) current, e/s, of charge that earlier exposures left; None for none
    rays : (4096, 4096) electrons of cosmic rays (cosmic_rays.hits); None for none
    """
    inner = slice(BORDER, SIDE - BORDER)
    dq = np.zeros((SIDE, SIDE), np.uint8)
    charge = np.empty((SIDE, SIDE), np.float32)
    for block, rows in enumerate(_blocks()):
        mean = _padded(light, rows)
        mean = quantum_efficiency(mean, planes("RELQE1", rows), expand(response.efficiency, 64, rows))
        mean = count_rate_nonlinearity(mean, planes("CRNL", rows)[0], response.exptime)
        caught = generators("light", block).poisson(np.maximum(mean, 0))
        charge[rows] = quantum_yield(caught, expand(response.electrons, 128, rows), generators("yield", block))
    if rays is not None:
        charge += rays
    charge = brighter_fatter(charge, planes("BFE", slice(None)), 128)
    for block, rows in enumerate(_blocks()):
        dark = planes("DARK", rows) * np.float32(response.exptime)
        if afterglow is not None:
            late = _padded(afterglow, rows) * np.float32(response.exptime)
            # what is more than the noise of the sky's own electrons in the least
            dq[rows][late > 1] |= PERSISTENCE_FLAG
            dark = dark + late
        electrons = np.rint(charge[rows]) + poisson(dark, generators("dark", block))
        electrons, full = saturate(electrons, planes("SATURATE", rows).astype(np.float32))
        dq[rows][full] |= SATURATED
        charge[rows] = nonlinear(electrons, planes("CNL", rows).astype(np.float32))
    signal = interpixel_capacitance(charge, planes("IPC", slice(None)), 8)
    numbers = np.empty((SIDE, SIDE), np.uint16)
    for block, rows in enumerate(_blocks()):
        bits, here = planes("BADPIX", rows), signal[rows]
        here[bits & DISCONNECTED > 0] = 0
        for bit, flag in _OF_PIXELS:
            dq[rows][bits & bit > 0] |= flag
        noise = generators("read", block).standard_normal(here.shape, np.float32)
        here += noise * planes("READ", rows)[2].astype(np.float32)
        numbers[rows] = digitise(here, expand(planes("GAIN", slice(None)), 128, rows), planes("BIAS", rows))
    return numbers[inner, inner], dq[inner, inner]


def calibrate(numbers: np.ndarray, planes: Planes, response: Response) -> tuple[np.ndarray, np.ndarray]:
    """Return electrons of light at nominal efficiency (4088, 4088), sky included, and their variance, of data numbers.

    Bias, gain, interpixel capacitance, classical nonlinearity, dark current, quantum efficiency and count-rate
    nonlinearity are undone, with the detector's own calibration; the brighter-fatter effect, which moves charge between
    neighbours and loses none, is not. Of pixels that catch no light both results are 0.
    """
    inner = slice(BORDER, SIDE - BORDER)
    signal = np.zeros((SIDE, SIDE), np.float32)
    signal[inner, inner] = numbers
    kernels = planes("IPC", slice(None))
    for rows in _blocks():
        gain = expand(planes("GAIN", slice(None)), 128, rows)
        signal[rows] = (signal[rows] - planes("BIAS", rows)) * gain
    # beyond what was read there is nothing
    edge = np.ones((SIDE, SIDE), bool)
    edge[inner, inner] = False
    signal[edge] = 0
    signal = without_capacitance(signal, kernels, 8)
    variance = np.empty((SIDE, SIDE), np.float32)
    for rows in _blocks():
        electrons = linear(signal[rows], planes("CNL", rows).astype(np.float32), 3)
        dark = planes("DARK", rows) * np.float32(response.exptime)
        relative = planes("RELQE1", rows) * expand(response.efficiency, 64, rows)
        relative = relative * expand(response.electrons, 128, rows)
        gain = expand(planes("GAIN", slice(None)), 128, rows)
        # noise that was added after the signal had spread grows with its inverse, by the sum of its squares
        middle = expand(kernels[1, 1], 8, rows)
        grown = 1 / middle**2 * (1 + (1 - middle) ** 2 / 4 / middle**2)
        read = planes("READ", rows)[2].astype(np.float32) ** 2 + gain**2 / 12
        lit = relative > 0
        safe = np.where(lit, relative, 1)
        light = count_rate_linearity((electrons - dark) / safe, planes("CRNL", rows)[0], response.exptime)
        variance[rows] = np.where(lit, (np.maximum(electrons, 0) + read * grown) / safe**2, 0)
        signal[rows] = np.where(lit, light, 0)
    return signal[inner, inner], variance[inner, inner]


def poisson(mean: np.ndarray, rng: np.random.Generator) -> np.ndarray:
    """Return Poisson numbers (float32) of mostly small means, by inversion of uniform ones."""
    uniform = rng.random(mean.shape, np.float32)
    found = _invert(np.ascontiguousarray(mean, np.float32).ravel(), uniform.ravel()).reshape(mean.shape)
    large = mean > _SMALL
    found[large] = rng.poisson(mean[large])
    return found


@numba.njit(nogil=True, cache=True)
def _invert(mean, uniform):
    out = np.zeros(mean.shape[0], np.float32)
    for i in range(mean.shape[0]):
        if mean[i] <= 0 or mean[i] > _SMALL:
            continue
        share = np.exp(-np.float64(mean[i]))
        below, k = share, 0
        while uniform[i] > below and k < 100:
            k += 1
            share *= mean[i] / k
            below += share
        out[i] = k
    return out


def _blocks() -> list[slice]:
    return [slice(first, first + _ROWS) for first in range(0, SIDE, _ROWS)]


def _padded(image: np.ndarray, rows: slice) -> np.ndarray:
    """Return rows of the whole detector of an image of its active pixels: reference pixels have nothing."""
    out = np.zeros((rows.stop - rows.start, SIDE), np.float32)
    first, last = max(rows.start - BORDER, 0), min(rows.stop - BORDER, image.shape[0])
    out[first + BORDER - rows.start : last + BORDER - rows.start, BORDER : SIDE - BORDER] = image[first:last]
    return out
