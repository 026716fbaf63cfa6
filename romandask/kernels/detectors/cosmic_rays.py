"""Cosmic rays: straight tracks of charge that particles leave in a detector."""

from __future__ import annotations

import numba
import numpy as np

RATE = 5.5
"""Particles per cm2 and second at L2, secondary particles included."""
PIXEL_SIZE = 10.0
"""Side of a pixel, micrometres."""
DEPTH = 5.0
"""Thickness of the layer in which charge is made, micrometres."""
CHARGE = 500.0
"""Most probable charge, electrons per micrometre: 1 keV (minimum ionising, 7.6 g/cm3) at 2 eV per electron."""
MOYAL_WIDTH = 0.15
"""Width of the Moyal distribution of the charge per micrometre, over the most probable charge. It has the tail of a
Landau distribution."""
MAX_PATH = 100.0
"""Longest path, in units of the depth: a longer path, nearly parallel to the layer, ends where the particle stops."""


def tracks(
    shape: tuple[int, int],
    exptime: float,
    rng: np.random.Generator,
    rate: float = RATE,
    depth: float = DEPTH,
    charge: float = CHARGE,
) -> np.ndarray:
    """Draw the cosmic-ray tracks of an exposure.

    Directions are isotropic, so the flux through the surface of the layer is proportional to the cosine of the angle of
    incidence. The defaults of rate, depth and charge are those of Roman's SCAs.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the detector.
    exptime : float, seconds
    rng : Generator
    rate : float, 1/cm2/s
        Rate of particles.
    depth : float, micrometres
        Thickness of the layer in which charge is made.
    charge : float, electrons per micrometre
        Most probable charge.

    Returns
    -------
    ndarray, shape (n, 5)
        For each track: x and y of its start (pixels), its length in x and in y (pixels), its charge (electrons).
    """
    area = shape[0] * shape[1] * (PIXEL_SIZE * 1e-4) ** 2
    n = rng.poisson(rate * area * exptime)
    # the flux is proportional to the cosine, so the square of the cosine is uniform
    cosine = np.sqrt(rng.uniform(0, 1, n))
    path = np.minimum(depth / np.maximum(cosine, 1e-9), depth * MAX_PATH)
    across = path * np.sqrt(1 - cosine**2) / PIXEL_SIZE
    angle = rng.uniform(0, 2 * np.pi, n)
    normal = rng.standard_normal(n)
    # a Moyal variate is minus the logarithm of the square of a normal variate
    loss = charge * (1 + MOYAL_WIDTH * -np.log(np.maximum(normal**2, 1e-12)))
    x, y = rng.uniform(-0.5, shape[1] - 0.5, n), rng.uniform(-0.5, shape[0] - 0.5, n)
    return np.stack([x, y, across * np.cos(angle), across * np.sin(angle), np.maximum(loss, 0) * path], axis=1)


def hits(shape: tuple[int, int], tracks: np.ndarray) -> np.ndarray:
    """Return the charge that tracks leave in the pixels of a detector; charge beyond its edges is lost.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the detector.
    tracks : ndarray, shape (n, 5)
        As `tracks` returns them.

    Returns
    -------
    ndarray, shape (ny, nx), float32, electrons
    """
    image = np.zeros(shape, np.float32)
    _draw(image, tracks)
    return image


@numba.njit(nogil=True, cache=True)
def _draw(image, tracks):
    ny, nx = image.shape
    for n in range(tracks.shape[0]):
        x, y, dx, dy, charge = tracks[n]
        # divide the charge over steps of an eighth of a pixel
        steps = int(8 * np.hypot(dx, dy)) + 1
        for k in range(steps):
            share = (k + 0.5) / steps
            i, j = int(np.floor(x + share * dx + 0.5)), int(np.floor(y + share * dy + 0.5))
            if 0 <= i < nx and 0 <= j < ny:
                image[j, i] += charge / steps
