"""One exposure of an SCA: from expected light to data numbers with all effects, and back to electrons of light."""

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
"""Bits of the dq plane (uint16), by name, in addition to those of the simple detector."""
JUMP_THRESHOLD = 50.0
"""Charge of a cosmic ray in a pixel above which it shows as a jump between the reads of an exposure, electrons: six
times the read noise."""
MIN_TRAPPED_CHARGE = 0.1
"""Least trapped charge f(Q) that is followed, electrons. It adds at most twice as much to a later exposure, far below
the noise of the sky."""
_DQ_OF_BADPIX = (
    (DISCONNECTED, DISCONNECTED_FLAG),
    (HOT, HOT_FLAG),
    (ADJACENT, ADJACENT_FLAG),
    (LOW_EFFICIENCY, LOW_EFFICIENCY_FLAG),
    (NOISY, NOISY_FLAG),
)
"""Bits of BADPIX and the bits of the dq plane that they set."""
_ROWS = 32
"""Number of rows that share a random generator and are worked on at a time, so that they stay in the processor's
cache."""

Planes = Callable[[str, slice], np.ndarray]
"""Returns rows of a calibration, given its name and the rows.

Rows are those of the whole detector, reference pixels included. A calibration in blocks is returned whole. float32 is
enough for float64 calibrations. READ is the read noise of an exposure alone, electrons.
"""
Generators = Callable[[str, int], np.random.Generator]
"""Returns the random generator of a block of rows in one step, given the name of the step and the block's number."""


@dataclass(frozen=True)
class Response:
    """Response of an SCA to the light of one band."""

    efficiency: np.ndarray
    """Relative quantum efficiency of blocks of 64 x 64 pixels, averaged over the band, (64, 64)."""
    electrons: np.ndarray
    """Electrons per photon in blocks of 128 x 128 pixels, averaged over the band, (32, 32)."""
    exptime: float
    """Exposure time, seconds."""


@dataclass(frozen=True)
class Trapped:
    """Charge that an exposure leaves in traps, for the pixels in which it is worth following: a small part of all."""

    pixel: np.ndarray
    """Index in the flattened active area of 4088 x 4088 pixels, (n,) int32."""
    charge: np.ndarray
    """Trapped charge f(Q), (n,) float32, electrons. At a time t after the exposure its current is f(Q) / t."""


def accumulate(
    light: np.ndarray, planes: Planes, response: Response, generators: Generators, rays: np.ndarray | None = None
) -> np.ndarray:
    """Draw the charge that light and cosmic rays leave in pixels, before dark current and readout.

    Parameters
    ----------
    light : ndarray, shape (4088, 4088), electrons
        Expected electrons of sources, sky and thermal emission at nominal efficiency.
    planes : Planes
        Calibrations of the SCA.
    response : Response
        Response of the SCA in the band.
    generators : Generators
    rays : ndarray, shape (4096, 4096), electrons, optional
        Charge of cosmic rays (`cosmic_rays.hits`); None for no cosmic rays.

    Returns
    -------
    ndarray, shape (4096, 4096), float32, electrons
    """
    charge = np.empty((SCA_PIXELS, SCA_PIXELS), np.float32)
    for block, rows in enumerate(_blocks()):
        mean = _padded(light, rows)
        mean = quantum_efficiency(mean, planes("RELQE1", rows), expand(response.efficiency, 64, rows))
        mean = count_rate_nonlinearity(mean, planes("CRNL", rows)[0].astype(np.float32), response.exptime)
        detected = poisson(np.maximum(mean, 0), generators("light", block))
        charge[rows] = quantum_yield(detected, expand(response.electrons, 128, rows), generators("yield", block))
    if rays is not None:
        charge += rays
    return brighter_fatter(charge, planes("BFE", slice(None)), 128)


def trap(charge: np.ndarray, planes: Planes) -> Trapped:
    """Return the part of a charge (4096, 4096), electrons, that stays in traps.

    Pixels with less than half of the lowest charge at which persistence is measured are left out, and pixels with a
    trapped charge below MIN_TRAPPED_CHARGE.
    """
    parts = []
    for rows in _blocks():
        first, last = max(rows.start, REFERENCE_PIXELS), min(rows.stop, SCA_PIXELS - REFERENCE_PIXELS)
        clipped = np.minimum(
            charge[first:last, REFERENCE_PIXELS : SCA_PIXELS - REFERENCE_PIXELS],
            planes("SATURATE", slice(first, last))[:, REFERENCE_PIXELS : SCA_PIXELS - REFERENCE_PIXELS],
        )
        y, x = np.nonzero(clipped > STIMULI[0] / 2)
        released = persistence(
            clipped[y, x], planes("PERSIST", slice(first, last))[:, y, x + REFERENCE_PIXELS].astype(np.float32), 1.0
        )
        kept = released >= MIN_TRAPPED_CHARGE
        pixel = (y[kept] + first - REFERENCE_PIXELS) * (SCA_PIXELS - 2 * REFERENCE_PIXELS) + x[kept]
        parts.append((pixel.astype(np.int32), released[kept].astype(np.float32)))
    return Trapped(*(np.concatenate(column) for column in zip(*parts, strict=True)))


def afterglow(earlier: Sequence[tuple[Trapped, float]]) -> np.ndarray | None:
    """Return the persistence current of the charge that earlier exposures left in traps.

    Parameters
    ----------
    earlier : sequence of (Trapped, float)
        Trapped charge of each earlier exposure, and the time since the exposure ended, seconds.

    Returns
    -------
    ndarray, shape (4088, 4088), float32, electrons per second, or None
        None if there are no earlier exposures.
    """
    if not earlier:
        return None
    side = SCA_PIXELS - 2 * REFERENCE_PIXELS
    current = np.zeros(side * side, np.float32)
    for trapped, age in earlier:
        current[trapped.pixel] += trapped.charge / np.float32(age)
    return current.reshape(side, side)


def read_out(
    charge: np.ndarray,
    planes: Planes,
    response: Response,
    generators: Generators,
    persistence_current: np.ndarray | None = None,
    rays: np.ndarray | None = None,
) -> tuple[np.ndarray, np.ndarray]:
    """Read out the charge of an exposure.

    Parameters
    ----------
    charge : ndarray, shape (4096, 4096), electrons
        As `accumulate` returns it.
    planes, response, generators
        As in `accumulate`.
    persistence_current : ndarray, shape (4088, 4088), electrons per second, optional
        Current of the charge that earlier exposures left in traps (`afterglow`); None for none.
    rays : ndarray, shape (4096, 4096), electrons, optional
        Charge of the cosmic rays that are in `charge`; None for no cosmic rays.

    Returns
    -------
    numbers : ndarray, shape (4088, 4088), uint16, data numbers
    dq : ndarray, shape (4088, 4088), uint16
        Bits of FLAGS and of the simple detector.
    """
    inner = slice(REFERENCE_PIXELS, SCA_PIXELS - REFERENCE_PIXELS)
    dq = np.zeros((SCA_PIXELS, SCA_PIXELS), np.uint16)
    if rays is not None:
        dq[rays > JUMP_THRESHOLD] |= COSMIC_RAY_FLAG
    signal = np.empty((SCA_PIXELS, SCA_PIXELS), np.float32)
    for block, rows in enumerate(_blocks()):
        dark = planes("DARK", rows).astype(np.float32) * np.float32(response.exptime)
        if persistence_current is not None:
            added = _padded(persistence_current, rows) * np.float32(response.exptime)
            # flag pixels to which persistence adds more than an electron
            dq[rows][added > 1] |= PERSISTENCE
            dark = dark + added
        electrons = np.rint(charge[rows]) + poisson(dark, generators("dark", block))
        electrons, full = saturate(electrons, planes("SATURATE", rows).astype(np.float32))
        dq[rows][full] |= SATURATED
        signal[rows] = nonlinear(electrons, planes("CNL", rows))
    signal = interpixel_capacitance(signal, planes("IPC", slice(None)), 8)
    numbers = np.empty((SCA_PIXELS, SCA_PIXELS), np.uint16)
    for block, rows in enumerate(_blocks()):
        bits, block_signal = planes("BADPIX", rows), signal[rows]
        block_signal[bits & DISCONNECTED > 0] = 0
        for bit, flag in _DQ_OF_BADPIX:
            dq[rows][bits & bit > 0] |= flag
        noise = generators("read", block).standard_normal(block_signal.shape, np.float32)
        block_signal += noise * planes("READ", rows).astype(np.float32)
        numbers[rows] = digitise(block_signal, expand(planes("GAIN", slice(None)), 128, rows), planes("BIAS", rows))
    return numbers[inner, inner], dq[inner, inner]


def calibrate(numbers: np.ndarray, planes: Planes, response: Response) -> tuple[np.ndarray, np.ndarray]:
    """Calibrate data numbers: return the electrons of light at nominal efficiency, and their variance.

    Corrected for are bias, gain, interpixel capacitance, classical nonlinearity, dark current, quantum efficiency and
    count-rate nonlinearity, with the calibrations of the SCA itself. The brighter-fatter effect, which moves charge
    between neighbours and conserves the total, is not corrected for.

    Parameters
    ----------
    numbers : ndarray, shape (4088, 4088), data numbers
    planes, response
        As in `accumulate`.

    Returns
    -------
    light : ndarray, shape (4088, 4088), float32, electrons
        It includes the sky; 0 for pixels that detect no light.
    variance : ndarray, shape (4088, 4088), float32, electrons^2
        0 for pixels that detect no light.
    """
    inner = slice(REFERENCE_PIXELS, SCA_PIXELS - REFERENCE_PIXELS)
    signal = np.zeros((SCA_PIXELS, SCA_PIXELS), np.float32)
    signal[inner, inner] = numbers
    kernels = planes("IPC", slice(None))
    for rows in _blocks():
        gain = expand(planes("GAIN", slice(None)), 128, rows)
        signal[rows] = (signal[rows] - planes("BIAS", rows)) * gain
    # reference pixels were not read out
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
        # read noise is added after interpixel capacitance: its correction amplifies it by the sum of its squares
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
    """Return the blocks of rows of the whole detector."""
    return [slice(first, first + _ROWS) for first in range(0, SCA_PIXELS, _ROWS)]


def _padded(image: np.ndarray, rows: slice) -> np.ndarray:
    """Return some rows of the whole detector, given the image of its active pixels; reference pixels are 0."""
    out = np.zeros((rows.stop - rows.start, SCA_PIXELS), np.float32)
    first, last = max(rows.start - REFERENCE_PIXELS, 0), min(rows.stop - REFERENCE_PIXELS, image.shape[0])
    out[
        first + REFERENCE_PIXELS - rows.start : last + REFERENCE_PIXELS - rows.start,
        REFERENCE_PIXELS : SCA_PIXELS - REFERENCE_PIXELS,
    ] = image[first:last]
    return out
