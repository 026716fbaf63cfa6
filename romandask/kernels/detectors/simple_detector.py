"""The simple detector model: sky, Poisson noise, saturation, read noise, rounding to whole electrons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from romandask.kernels.detectors.poisson import poisson

SATURATED, NO_DATA, PERSISTENCE = 1, 2, 128
DQ_FLAGS = {"saturated": SATURATED, "no_data": NO_DATA}
"""Bits of the dq plane, by name."""
INFORMATIONAL_FLAGS = PERSISTENCE
"""Bits that leave a pixel usable. A pixel with any other bit is not used."""
_ROWS = 64
"""Number of rows that are worked on at a time, so that they stay in the processor's cache."""


@dataclass(frozen=True)
class Detector:
    """Constants of a simple detector."""

    saturation: float
    """Charge at which a pixel is clipped, electrons."""
    read_noise: float
    """Read noise of an exposure, electrons rms."""


def observe(
    expected: np.ndarray, background: np.ndarray, detector: Detector, rng: np.random.Generator
) -> tuple[np.ndarray, np.ndarray]:
    """Draw the observed image of an exposure.

    Poisson noise is drawn once per pixel, for sources and background together. The electrons are clipped at saturation,
    then Gaussian read noise is added (simple model of Troxel et al. 2023, section 4.3). Rows are drawn in blocks, which
    limits the memory.

    Parameters
    ----------
    expected : ndarray, shape (ny, nx), electrons
        Noiseless image of the sources.
    background : ndarray, shape (ny, nx), or float, electrons
        Sky, thermal emission and dark current.
    detector : Detector
    rng : Generator

    Returns
    -------
    image : ndarray, shape (ny, nx), int32, electrons
    dq : ndarray, shape (ny, nx), uint8
        Bits of DQ_FLAGS.
    """
    image = np.empty(expected.shape, np.int32)
    dq = np.zeros(expected.shape, np.uint8)
    background = np.broadcast_to(background, expected.shape)
    for first in range(0, expected.shape[0], _ROWS):
        rows = slice(first, first + _ROWS)
        # rendering by Fourier transforms leaves slightly negative values, far smaller than the background
        mean = np.maximum(expected[rows] + background[rows], np.float32(0))
        electrons = poisson(mean, rng)
        full = electrons >= detector.saturation
        dq[rows][full] |= SATURATED
        electrons = np.minimum(electrons, detector.saturation)
        noise = rng.standard_normal(mean.shape, dtype=np.float32) * np.float32(detector.read_noise)
        image[rows] = np.rint(electrons + noise).astype(np.int32)
    return image, dq


def usable(dq: np.ndarray) -> np.ndarray:
    """Return a mask of the pixels that may be measured, from a dq plane."""
    return dq & ~np.array(INFORMATIONAL_FLAGS, dq.dtype) == 0
