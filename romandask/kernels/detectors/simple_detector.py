"""The simple detector model: sky, Poisson noise, saturation, read noise, rounding to whole electrons."""

from __future__ import annotations

import itertools
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from romandask.kernels.detectors.poisson import poisson

SATURATED, NO_DATA, PERSISTENCE = 1, 2, 128
DQ_FLAGS = {"saturated": SATURATED, "no_data": NO_DATA}
"""Bits of the dq plane of every detector, by name."""
NOT_DRAWN = 4
"""Bit of the dq plane of a simple detector: the pixel is in a part of the detector that was not drawn."""
SIMPLE_FLAGS = {**DQ_FLAGS, "not_drawn": NOT_DRAWN}
"""Bits of the dq plane of a simple detector, by name."""
NOT_DRAWN_VALUE = -(2**31)
"""Value of the images where they were not drawn; no electrons look like it."""
INFORMATIONAL_FLAGS = PERSISTENCE
"""Bits that leave a pixel usable. A pixel with any other bit is not used."""
NOISE_BLOCK = 256
"""Side, pixels, of the blocks of a detector that have their own random numbers: a part is drawn without the rest."""
_ROWS = 64
"""Number of rows of a block that are worked on at a time, so that they stay in the processor's cache."""
WHOLE = (slice(None), slice(None))
"""All rows and columns of a detector."""


@dataclass(frozen=True)
class Detector:
    """Constants of a simple detector."""

    saturation: float
    """Charge at which a pixel is clipped, electrons."""
    read_noise: float
    """Read noise of an exposure, electrons rms."""


def observe(
    expected: np.ndarray,
    background: np.ndarray,
    detector: Detector,
    generator: Callable[[int, int], np.random.Generator],
    window: tuple[slice, slice] = WHOLE,
) -> tuple[np.ndarray, np.ndarray]:
    """Draw the observed image of an exposure.

    Poisson noise is drawn once per pixel, for sources and background together. The electrons are clipped at saturation,
    then Gaussian read noise is added (simple model of Troxel et al. 2023, section 4.3). The random numbers of a pixel
    do not depend on which window of the detector is drawn.

    Parameters
    ----------
    expected : ndarray, shape (ny, nx), electrons
        Noiseless image of the sources.
    background : ndarray, shape (ny, nx), or float, electrons
        Sky, thermal emission and dark current.
    detector : Detector
    generator : callable
        Returns the random generator of a block of NOISE_BLOCK x NOISE_BLOCK pixels, given the numbers of the block
        along y and x.
    window : (slice, slice), optional
        Rows and columns to draw, which begin and end at edges of blocks or of the detector; by default all.

    Returns
    -------
    image : ndarray, shape (ny, nx), int32, electrons
        NOT_DRAWN_VALUE outside the window.
    dq : ndarray, shape (ny, nx), uint8
        Bits of SIMPLE_FLAGS; NOT_DRAWN outside the window.
    """
    ny, nx = expected.shape
    image = np.full(expected.shape, NOT_DRAWN_VALUE, np.int32)
    dq = np.full(expected.shape, NOT_DRAWN, np.uint8)
    background = np.broadcast_to(background, expected.shape)
    rows, columns = (part.indices(side)[:2] for part, side in zip(window, (ny, nx), strict=True))
    for low, left in itertools.product(range(*rows, NOISE_BLOCK), range(*columns, NOISE_BLOCK)):
        rng = generator(low // NOISE_BLOCK, left // NOISE_BLOCK)
        for first in range(low, min(low + NOISE_BLOCK, ny), _ROWS):
            part = slice(first, min(first + _ROWS, low + NOISE_BLOCK)), slice(left, left + NOISE_BLOCK)
            # rendering by Fourier transforms leaves slightly negative values, far smaller than the background
            mean = np.maximum(expected[part] + background[part], np.float32(0))
            electrons = poisson(mean, rng)
            dq[part] = np.where(electrons >= detector.saturation, np.uint8(SATURATED), np.uint8(0))
            electrons = np.minimum(electrons, np.float32(detector.saturation))
            noise = rng.standard_normal(mean.shape, dtype=np.float32) * np.float32(detector.read_noise)
            image[part] = np.rint(electrons + noise)
    return image, dq


def usable(dq: np.ndarray) -> np.ndarray:
    """Return a mask of the pixels that may be measured, from a dq plane."""
    return dq & ~np.array(INFORMATIONAL_FLAGS, dq.dtype) == 0
