"""The simple detector: sky, Poisson noise, saturation, read noise, whole electrons."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

SATURATED, NO_DATA = 1, 2
DQ_FLAGS = {"saturated": SATURATED, "no_data": NO_DATA}
"""Bits of the dq plane."""
_ROWS = 256


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
    Gaussian read noise is added (paper, section 4.3, simple model). Rows are drawn in order, in blocks that bound memory.
    """
    image = np.empty(expected.shape, np.int32)
    dq = np.zeros(expected.shape, np.uint8)
    background = np.broadcast_to(background, expected.shape)
    for first in range(0, expected.shape[0], _ROWS):
        rows = slice(first, first + _ROWS)
        # Fourier rendering rings slightly below zero, far below the background
        mean = np.maximum(expected[rows] + background[rows].astype(np.float64), 0.0)
        electrons = rng.poisson(mean)
        full = electrons >= detector.saturation
        dq[rows][full] |= SATURATED
        electrons = np.minimum(electrons, detector.saturation)
        noise = rng.standard_normal(mean.shape, dtype=np.float32) * np.float32(detector.read_noise)
        image[rows] = np.rint(electrons + noise).astype(np.int32)
    return image, dq


def noise_realisation(background: np.ndarray, detector: Detector, rng: np.random.Generator) -> np.ndarray:
    """Return an image (float32, electrons) of the noise of an empty field: zero mean, background plus read noise."""
    variance = np.asarray(background, np.float32) + np.float32(detector.read_noise**2)
    noise = rng.standard_normal(variance.shape, dtype=np.float32)
    return np.multiply(noise, np.sqrt(variance), out=noise)
