"""The simple detector: sky, Poisson noise, saturation, read noise, whole electrons."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from romandask.kernels.detectors.poisson import poisson

SATURATED, NO_DATA, PERSISTENCE = 1, 2, 128
DQ_FLAGS = {"saturated": SATURATED, "no_data": NO_DATA}
"""Bits of the dq plane."""
TELLING = PERSISTENCE
"""Bits that tell something of a pixel and leave it usable; one with any other is not used."""
_ROWS = 64
"""Rows that are worked on while they are in the processor's cache."""


@dataclass(frozen=True)
class Detector:
    """Constants of a simple detector."""

    saturation: float
    """Electrons at which a pixel is clipped."""
    read_noise: float
    """Electrons rms of an exposure."""


def observe(
    expected: np.ndarray, background: np.ndarray, detector: Detector, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Return the observed image (int32, electrons) and its dq plane (uint8).

    Parameters
    ----------
    expected : (ny, nx) electrons of the objects, noiseless
    background : (ny, nx) or scalar; electrons of sky, thermal emission and dark current

    Poisson noise is drawn once per pixel from objects and background together, then clipped at saturation, then
    Gaussian read noise is added (paper, section 4.3, simple model). Rows are drawn in blocks that bound memory.
    """
    image = np.empty(expected.shape, np.int32)
    dq = np.zeros(expected.shape, np.uint8)
    background = np.broadcast_to(background, expected.shape)
    for first in range(0, expected.shape[0], _ROWS):
        rows = slice(first, first + _ROWS)
        # Fourier rendering rings slightly below zero, far below the background
        mean = np.maximum(expected[rows] + background[rows], np.float32(0))
        electrons = poisson(mean, rng)
        full = electrons >= detector.saturation
        dq[rows][full] |= SATURATED
        electrons = np.minimum(electrons, detector.saturation)
        noise = rng.standard_normal(mean.shape, dtype=np.float32) * np.float32(detector.read_noise)
        image[rows] = np.rint(electrons + noise).astype(np.int32)
    return image, dq


NOISE_ROWS = 256
"""Rows whose noise realisation shares one generator: parts of an image need not draw the whole."""


def usable(dq: np.ndarray) -> np.ndarray:
    """True for pixels that may be measured."""
    return dq & ~np.array(TELLING, dq.dtype) == 0


def noise_realisation(
    variance: np.ndarray,
    width: int,
    rows: slice,
    columns: slice,
    generator: Callable[[int], np.random.Generator],
) -> np.ndarray:
    """Return noise (float32, electrons) of zero mean and some variance.

    Parameters
    ----------
    variance : (ny, nx) electrons^2, of the rows and columns wanted
    width : columns of the whole detector
    generator : the random generator of a block of rows, by its number

    The values of a pixel do not depend on which part of the detector is asked for.
    """
    noise = np.empty(variance.shape, np.float32)
    for block in range(rows.start // NOISE_ROWS, -(-rows.stop // NOISE_ROWS)):
        first, last = max(rows.start, block * NOISE_ROWS), min(rows.stop, (block + 1) * NOISE_ROWS)
        drawn = generator(block).standard_normal((NOISE_ROWS, width), dtype=np.float32)
        noise[first - rows.start : last - rows.start] = drawn[
            first - block * NOISE_ROWS : last - block * NOISE_ROWS, columns
        ]
    return noise * np.sqrt(variance)
