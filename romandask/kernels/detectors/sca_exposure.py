"""One exposure of an SCA: from expected light to data numbers with every effect, and back to electrons of light."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import numpy as np

from romandask.kernels.detectors.brighter_fatter import brighter_fatter
from romandask.kernels.detectors.poisson import poisson
from romandask.kernels.detectors.sca import (
    STIMULI,
    count_rate_linearity,
    count_rate_nonlinearity,
    digitise,
    expand,
    interpixel_capacitance,
    linear,
    nonlinear,
    persistence,
    quantum_efficiency,
    quantum_yield,
    saturate,
    without_capacitance,
)
from romandask.kernels.detectors.simple_detector import PERSISTENCE, SATURATED
from romandask.kernels.detectors.synthetic_sca import (
    ADJACENT,
    DISCONNECTED,
    HOT,
    LOW_EFFICIENCY,
    NOISY,
    REFERENCE_PIXELS,
    SCA_PIXELS,
)

DISCONNECTED_FLAG, HOT_FLAG, ADJACENT_FLAG, LOW_EFFICIENCY_FLAG, NOISY_FLAG = 4, 8, 16, 32, 64
COSMIC_RAY_FLAG = 256
FLAGS = {
    "disconnected": DISCONNECTED_FLAG,
    "hot": HOT_FLAG,
    "adjacent": ADJACENT_FLAG,
    "low_efficiency": LOW_EFFICIENCY_FLAG,
    "noisy": NOISY_FLAG,
    "persistence": PERSISTENCE,
    "cosmic_ray": COSMIC_RAY_FLAG,
}
"""Bits of the dq plane (uint16) beside those of the simple detector."""
JUMP = 50.0
"""Electrons of a cosmic ray, in a pixel, that give it away among the reads of an exposure (six times their noise)."""
LEAST = 0.1
"""Electrons of trapped charge, f(Q), that are followed: a thousandth of the sky's noise an exposure is far below."""
_OF_PIXELS = (
    (DISCONNECTED, DISCONNECTED_FLAG),
    (HOT, HOT_FLAG),
    (ADJACENT, ADJACENT_FLAG),
    (LOW_EFFICIENCY, LOW_EFFICIENCY_FLAG),
    (NOISY, NOISY_FLAG),
)
_ROWS = 32
"""Rows that share a random generator, and are worked on while they are in the processor's cache."""

Planes = Callable[[str, slice], np.ndarray]
"""Gives some rows of the whole detector (BORDER included) of a named calibration; blocks, whole, where it has those.

Of float64 calibrations float32 is enough; READ is the read noise of an exposure alone, electrons.
"""
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


@dataclass(frozen=True)
class Trapped:
    """Charge that an exposure leaves in traps, pixel by pixel: most have none worth following."""

    pixel: np.ndarray
    """(n,) int32, place in the flattened active area (4088, 4088)."""
    charge: np.ndarray
    """(n,) float32, f(Q), electrons; a time t later its current is f(Q) / t."""


def accumulate(
    light: np.ndarray, planes: Planes, response: Response, generators: Generators, rays: np.ndarray | None = None
) -> np.ndarray:
    """Return the charge (4096, 4096), electrons, that light leaves in pixels, before anything the detector adds.

    Parameters
    ----------
    light : (4088, 4088) expected electrons of objects, sky and thermal emission, at nominal efficiency
    rays : (4096, 4096) electrons of cosmic rays (cosmic_rays.hits); None for none
    """
    charge = np.empty((SCA_PIXELS, SCA_PIXELS), np.float32)
    for block, rows in enumerate(_blocks()):
        mean = _padded(light, rows)
        mean = quantum_efficiency(mean, planes("RELQE1", rows), expand(response.efficiency, 64, rows))
        mean = count_rate_nonlinearity(mean, planes("CRNL", rows)[0].astype(np.float32), response.exptime)
        caught = poisson(np.maximum(mean, 0), generators("light", block))
        charge[rows] = quantum_yield(caught, expand(response.electrons, 128, rows), generators("yield", block))
    if rays is not None:
        charge += rays
    return brighter_fatter(charge, planes("BFE", slice(None)), 128)


def trap(charge: np.ndarray, planes: Planes) -> Trapped:
    """Return what of a charge (4096, 4096) stays in traps.

    Left out are pixels with less than half the least charge at which persistence is measured, and those that keep less
    than LEAST.
    """
    found = []
    for rows in _blocks():
        first, last = max(rows.start, REFERENCE_PIXELS), min(rows.stop, SCA_PIXELS - REFERENCE_PIXELS)
        here = np.minimum(
            charge[first:last, REFERENCE_PIXELS : SCA_PIXELS - REFERENCE_PIXELS],
            planes("SATURATE", slice(first, last))[:, REFERENCE_PIXELS : SCA_PIXELS - REFERENCE_PIXELS],
        )
        y, x = np.nonzero(here > STIMULI[0] / 2)
        released = persistence(
            here[y, x], planes("PERSIST", slice(first, last))[:, y, x + REFERENCE_PIXELS].astype(np.float32), 1.0
        )
        kept = released >= LEAST
        pixel = (y[kept] + first - REFERENCE_PIXELS) * (SCA_PIXELS - 2 * REFERENCE_PIXELS) + x[kept]
        found.append((pixel.astype(np.int32), released[kept].astype(np.float32)))
    return Trapped(*(np.concatenate(column) for column in zip(*found, strict=True)))


def afterglow(left: Sequence[tuple[Trapped, float]]) -> np.ndarray | None:
    """Return the current (4088, 4088), e/s, of what exposures left, each with its age, s; None where there are none."""
    if not left:
        return None
    side = SCA_PIXELS - 2 * REFERENCE_PIXELS
    current = np.zeros(side * side, np.float32)
    for trapped, age in left:
        current[trapped.pixel] += trapped.charge / np.float32(age)
    return current.reshape(side, side)


def read_out(
    charge: np.ndarray,
    planes: Planes,
    response: Response,
    generators: Generators,
    late: np.ndarray | None = None,
    rays: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Return data numbers (uint16) and dq (uint16), both (4088, 4088), of the charge (4096, 4096) of an exposure.

    Parameters
    ----------
    late : (4088, 4088) current, e/s, of charge that earlier exposures left (`afterglow`); None for none
    rays : (4096, 4096) electrons of cosmic rays that are in the charge; None for none
    """
    inner = slice(REFERENCE_PIXELS, SCA_PIXELS - REFERENCE_PIXELS)
    dq = np.zeros((SCA_PIXELS, SCA_PIXELS), np.uint16)
    if rays is not None:
        dq[rays > JUMP] |= COSMIC_RAY_FLAG
    signal = np.empty((SCA_PIXELS, SCA_PIXELS), np.float32)
    for block, rows in enumerate(_blocks()):
        dark = planes("DARK", rows).astype(np.float32) * np.float32(response.exptime)
        if late is not None:
            added = _padded(late, rows) * np.float32(response.exptime)
            # what is more than the noise of the sky's own electrons in the least
            dq[rows][added > 1] |= PERSISTENCE
            dark = dark + added
        electrons = np.rint(charge[rows]) + poisson(dark, generators("dark", block))
        electrons, full = saturate(electrons, planes("SATURATE", rows).astype(np.float32))
        dq[rows][full] |= SATURATED
        signal[rows] = nonlinear(electrons, planes("CNL", rows))
    signal = interpixel_capacitance(signal, planes("IPC", slice(None)), 8)
    numbers = np.empty((SCA_PIXELS, SCA_PIXELS), np.uint16)
    for block, rows in enumerate(_blocks()):
        bits, here = planes("BADPIX", rows), signal[rows]
        here[bits & DISCONNECTED > 0] = 0
        for bit, flag in _OF_PIXELS:
            dq[rows][bits & bit > 0] |= flag
        noise = generators("read", block).standard_normal(here.shape, np.float32)
        here += noise * planes("READ", rows).astype(np.float32)
        numbers[rows] = digitise(here, expand(planes("GAIN", slice(None)), 128, rows), planes("BIAS", rows))
    return numbers[inner, inner], dq[inner, inner]


def calibrate(numbers: np.ndarray, planes: Planes, response: Response) -> tuple[np.ndarray, np.ndarray]:
    """Return electrons of light at nominal efficiency (4088, 4088), sky included, and their variance, of data numbers.

    Bias, gain, interpixel capacitance, classical nonlinearity, dark current, quantum efficiency and count-rate
    nonlinearity are undone, with the detector's own calibration; the brighter-fatter effect, which moves charge between
    neighbours and loses none, is not. Of pixels that catch no light both results are 0.
    """
    inner = slice(REFERENCE_PIXELS, SCA_PIXELS - REFERENCE_PIXELS)
    signal = np.zeros((SCA_PIXELS, SCA_PIXELS), np.float32)
    signal[inner, inner] = numbers
    kernels = planes("IPC", slice(None))
    for rows in _blocks():
        gain = expand(planes("GAIN", slice(None)), 128, rows)
        signal[rows] = (signal[rows] - planes("BIAS", rows)) * gain
    # beyond what was read there is nothing
    edge = np.ones((SCA_PIXELS, SCA_PIXELS), bool)
    edge[inner, inner] = False
    signal[edge] = 0
    signal = without_capacitance(signal, kernels, 8)
    variance = np.empty((SCA_PIXELS, SCA_PIXELS), np.float32)
    for rows in _blocks():
        electrons = linear(signal[rows], planes("CNL", rows), 3)
        dark = planes("DARK", rows).astype(np.float32) * np.float32(response.exptime)
        relative = planes("RELQE1", rows) * expand(response.efficiency, 64, rows)
        relative = relative * expand(response.electrons, 128, rows)
        gain = expand(planes("GAIN", slice(None)), 128, rows)
        # noise that was added after the signal had spread grows with its inverse, by the sum of its squares
        middle = expand(kernels[1, 1], 8, rows)
        grown = 1 / middle**2 * (1 + (1 - middle) ** 2 / 4 / middle**2)
        read = planes("READ", rows).astype(np.float32) ** 2 + gain**2 / 12
        lit = relative > 0
        safe = np.where(lit, relative, 1)
        light = count_rate_linearity(
            (electrons - dark) / safe, planes("CRNL", rows)[0].astype(np.float32), response.exptime
        )
        variance[rows] = np.where(lit, (np.maximum(electrons, 0) + read * grown) / safe**2, 0)
        signal[rows] = np.where(lit, light, 0)
    return signal[inner, inner], variance[inner, inner]


def _blocks() -> list[slice]:
    return [slice(first, first + _ROWS) for first in range(0, SCA_PIXELS, _ROWS)]


def _padded(image: np.ndarray, rows: slice) -> np.ndarray:
    """Return rows of the whole detector of an image of its active pixels: reference pixels have nothing."""
    out = np.zeros((rows.stop - rows.start, SCA_PIXELS), np.float32)
    first, last = max(rows.start - REFERENCE_PIXELS, 0), min(rows.stop - REFERENCE_PIXELS, image.shape[0])
    out[
        first + REFERENCE_PIXELS - rows.start : last + REFERENCE_PIXELS - rows.start,
        REFERENCE_PIXELS : SCA_PIXELS - REFERENCE_PIXELS,
    ] = image[first:last]
    return out
