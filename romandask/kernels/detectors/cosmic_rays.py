"""Cosmic rays: straight tracks of charge that particles leave in a detector."""

from __future__ import annotations

import numba
import numpy as np

RATE = 5.5
"""Particles a cm2 and second at L2, secondary ones included."""
PIXEL = 10.0
"""Micrometres."""
DEPTH = 5.0
"""Micrometres of the layer in which charge is made."""
CHARGE = 500.0
"""Electrons a micrometre, the most probable: 1 keV (minimum ionising, 7.6 g/cm3) at 2 eV an electron."""
SPREAD = 0.15
"""Width of Moyal's distribution of the charge a micrometre, over the most probable: its tail is Landau's."""
LONGEST = 100.0
"""Depths: a longer path, all but along the layer, ends where its particle stops."""


def tracks(
    shape: tuple[int, int],
    exptime: float,
    rng: np.random.Generator,
    rate: float = RATE,
    depth: float = DEPTH,
    charge: float = CHARGE,
) -> np.ndarray:
    """Return the tracks (n, 5) of an exposure: x, y (pixels), length in x and in y (pixels), charge (electrons).

    Rate, depth and charge a micrometre are, if not given, those of Roman's SCAs.

    Particles come from all sides alike, so that through the layer's surface they come with the cosine of their angle.
    """
    area = shape[0] * shape[1] * (PIXEL * 1e-4) ** 2
    n = rng.poisson(rate * area * exptime)
    # the flux through a surface goes as cos, so cos^2 is uniform
    cosine = np.sqrt(rng.uniform(0, 1, n))
    path = np.minimum(depth / np.maximum(cosine, 1e-9), depth * LONGEST)
    across = path * np.sqrt(1 - cosine**2) / PIXEL
    angle = rng.uniform(0, 2 * np.pi, n)
    normal = rng.standard_normal(n)
    # Moyal: minus the logarithm of the square of a normal number
    loss = charge * (1 + SPREAD * -np.log(np.maximum(normal**2, 1e-12)))
    x, y = rng.uniform(-0.5, shape[1] - 0.5, n), rng.uniform(-0.5, shape[0] - 0.5, n)
    return np.stack([x, y, across * np.cos(angle), across * np.sin(angle), np.maximum(loss, 0) * path], axis=1)


def hits(shape: tuple[int, int], found: np.ndarray) -> np.ndarray:
    """Return the charge (float32, electrons) that tracks leave in pixels; what falls beyond the edge is lost."""
    image = np.zeros(shape, np.float32)
    _draw(image, found)
    return image


@numba.njit(nogil=True, cache=True)
def _draw(image, found):
    ny, nx = image.shape
    for n in range(found.shape[0]):
        x, y, dx, dy, charge = found[n]
        # steps of an eighth of a pixel
        steps = int(8 * np.hypot(dx, dy)) + 1
        for k in range(steps):
            share = (k + 0.5) / steps
            i, j = int(np.floor(x + share * dx + 0.5)), int(np.floor(y + share * dy + 0.5))
            if 0 <= i < nx and 0 <= j < ny:
                image[j, i] += charge / steps
