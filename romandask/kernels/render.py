"""Draw galaxies and stars on a pixel grid in Fourier space, noiselessly, into an image of expected electrons.

For each object the analytic transforms of its components (sheared, lensed, projected to pixels) are multiplied by the
chromatic PSF weighted by the component's own spectrum, folded to the pixel grid, and brought back by one inverse
real FFT a stamp.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import galsim
import numba
import numpy as np
from scipy import fft

from romandask.kernels.psf import PsfBasis

POINT, EXPONENTIAL, DEVAUCOULEURS, KNOTS = 0, 1, 2, 3
EXPONENTIAL_RADIUS = 1 / 1.6783469900166605
"""Scale length of an exponential disk over its half-light radius."""
KNOT_SIGMA = 1 / np.sqrt(2 * np.log(2))
"""Gaussian sigma over half-light radius."""
_BATCH_BYTES = 1 << 25
_TABLE = (-14.0, 22.0, 6000)


@dataclass(frozen=True)
class Scene:
    """Objects on one image; component c belongs to object `owner[c]`, and owners ascend."""

    x: np.ndarray
    """(n,) pixel coordinate, 0 at the centre of the first pixel."""
    y: np.ndarray
    """(n,)"""
    key: np.ndarray
    """(n,) uint64 identity from which knot positions derive."""
    owner: np.ndarray
    """(c,)"""
    kind: np.ndarray
    """(c,) POINT, EXPONENTIAL, DEVAUCOULEURS or KNOTS."""
    matrix: np.ndarray
    """(c, 2, 2) from a round profile of half-light radius 1 to pixels: size, shape, lensing and WCS."""
    smoothing: np.ndarray
    """(c, 2, 2) the same for the Gaussian, sigma 1, that smooths knots; zeros for none."""
    knots: np.ndarray
    """(c,) number of knots."""
    photons: np.ndarray
    """(c, nodes) electrons by PSF node."""

    def fluxes(self) -> np.ndarray:
        """Return the electrons of each object, (n,)."""
        return np.bincount(self.owner, self.photons.sum(axis=1), minlength=len(self.x))


def draw(scene: Scene, basis: PsfBasis, shape: tuple[int, int], faintest: float) -> np.ndarray:
    """Return the image (float32, electrons) of a scene.

    Parameters
    ----------
    shape : (ny, nx)
    faintest : surface brightness, electrons a pixel, below which a stamp may end
    """
    image = np.zeros(shape, np.float32)
    size = stamp_sizes(scene, basis, faintest)
    half = size // 2
    near = (scene.x > -half) & (scene.x < shape[1] - 1 + half) & (scene.y > -half) & (scene.y < shape[0] - 1 + half)
    start = np.searchsorted(scene.owner, np.arange(len(scene.x) + 1))
    table, photons = _devaucouleurs_table(), scene.photons.astype(np.float32)
    for stamp in np.unique(size[near]):
        chosen = np.flatnonzero(near & (size == stamp))
        batch = max(1, _BATCH_BYTES // (stamp * stamp * 12))
        for first in range(0, len(chosen), batch):
            rows = chosen[first : first + batch]
            transforms = np.zeros((len(rows), stamp, stamp // 2 + 1), np.complex64)
            _fill(
                transforms, rows, scene.x, scene.y, scene.key, start, scene.kind, scene.matrix, scene.smoothing,
                scene.knots, photons, basis.transforms, basis.size // stamp, basis.folds, table,
            )  # fmt: skip
            _add(image, fft.irfft2(transforms, s=(stamp, stamp), overwrite_x=True), rows, scene.x, scene.y)
    return image


def stamp_sizes(scene: Scene, basis: PsfBasis, faintest: float) -> np.ndarray:
    """Return the stamp size (n,) of each object: a power of two whose edge is fainter than `faintest` a pixel."""
    radius = np.zeros(len(scene.x))
    np.maximum.at(radius, scene.owner, _component_radii(scene, faintest))
    flux = scene.fluxes()
    size = np.full(len(scene.x), 32)
    while True:
        grow = (radius > size / 2 - 6) | (flux * _edge(basis, size) > faintest)
        grow &= size < basis.size
        if not grow.any():
            return size
        size = np.where(grow, size * 2, size)


def largest_stamp(flux: float, radius: float, faintest: float, limit: int) -> int:
    """Return the stamp size that the brightest object of a scene may need, before the PSF has been sampled.

    The spikes of Roman's PSF, its brightest part far out, are 0.04 flux / r^2 a pixel; a seeing-limited PSF is fainter.
    """
    reach = max((0.04 * flux / max(faintest, 1e-12)) ** 0.5, radius + 6, 16.0)
    return int(min(limit, 1 << int(np.ceil(np.log2(2 * reach)))))


def component_reach(scene: Scene, faintest: float) -> float:
    """Return the radius, pixels, at which the most extended component falls below `faintest`."""
    return float(_component_radii(scene, faintest).max(initial=0.0))


def _edge(basis: PsfBasis, size: np.ndarray) -> np.ndarray:
    sizes = np.array(sorted(basis.edge_brightness))
    values = np.array([basis.edge_brightness[k] for k in sizes])
    return values[np.searchsorted(sizes, np.minimum(size, basis.size))]


def _component_radii(scene: Scene, faintest: float) -> np.ndarray:
    """Radius, pixels, along the major axis where each component's own light falls below `faintest` a pixel."""
    flux = scene.photons.sum(axis=1)
    squares = (scene.matrix**2).sum(axis=(1, 2))
    area = np.abs(np.linalg.det(scene.matrix))
    major = np.sqrt((squares + np.sqrt(np.maximum(squares**2 - 4 * area**2, 0))) / 2)
    area = np.maximum(area, 1e-12)
    with np.errstate(divide="ignore"):
        disk = np.log(flux / (2 * np.pi * EXPONENTIAL_RADIUS**2 * area * faintest)) * EXPONENTIAL_RADIUS
        bulge = (1 + np.maximum(np.log(flux / (22.67 * area * faintest)) / 7.669, -1)) ** 4
    radius = np.where(scene.kind == EXPONENTIAL, disk, np.where(scene.kind == DEVAUCOULEURS, bulge, 0.0))
    # knots are Gaussian scattered; none of a hundred lies beyond about 3.5 sigma
    radius = np.where(scene.kind == KNOTS, 3.5 * KNOT_SIGMA, radius)
    smoothing = 4 * np.sqrt((scene.smoothing**2).sum(axis=(1, 2)))
    return np.where(flux > 0, np.maximum(radius, 0) * major + smoothing, 0.0)


@lru_cache(maxsize=1)
def _devaucouleurs_table() -> np.ndarray:
    """Transform of a de Vaucouleurs profile, half-light radius 1, against log k^2."""
    profile = galsim.DeVaucouleurs(half_light_radius=1.0)
    low, high, count = _TABLE
    waves = np.exp(np.linspace(low, high, count) / 2)
    return np.array([profile.kValue(wave, 0.0).real for wave in waves])


@numba.njit(nogil=True, cache=True)
def _hash(key, counter):
    """splitmix64 of an identity and a counter, to (0, 1)."""
    value = np.uint64(key) + np.uint64(counter) * np.uint64(0x9E3779B97F4A7C15)
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    value = value ^ (value >> np.uint64(31))
    return (np.float64(value >> np.uint64(11)) + 0.5) / 9007199254740992.0


@numba.njit(nogil=True, cache=True)
def knot_offset(key, knot):
    """Return the position of a knot in units of the half-light radius of a round Gaussian: the same in every image."""
    first = _hash(key, 2 * knot + 1)
    second = _hash(key, 2 * knot + 2)
    radius = 0.8493218002880191 * np.sqrt(-2.0 * np.log(first))
    return radius * np.cos(2 * np.pi * second), radius * np.sin(2 * np.pi * second)


@numba.njit(nogil=True, cache=True)
def _knot_sum(key, count, matrix, step, reach, out):
    """Add to `out` (2 reach, 2 reach + 1) the mean of the phases of an object's knots: a separable sum."""
    out[:] = 0
    columns = np.empty(2 * reach + 1, np.complex64)
    rows = np.empty(2 * reach, np.complex64)
    for knot in range(count):
        u, v = knot_offset(key, knot)
        x = matrix[0, 0] * u + matrix[0, 1] * v
        y = matrix[1, 0] * u + matrix[1, 1] * v
        for j in range(2 * reach + 1):
            columns[j] = np.exp(-1j * step * (j - reach) * x)
        for j in range(2 * reach):
            rows[j] = np.exp(-1j * step * (j - reach) * y) / count
        for j in range(2 * reach):
            for i in range(2 * reach + 1):
                out[j, i] += rows[j] * columns[i]


@numba.njit(nogil=True, cache=True, fastmath=True)
def _fill(transforms, chosen, x, y, keys, start, kind, matrix, smoothing, knots, photons, psf, stride, folds, table):
    """Write the folded transforms of stamps: (stamps, size, size / 2 + 1), stamp origin at floor(x) - size / 2."""
    size = transforms.shape[1]
    nodes = psf.shape[0]
    reach = folds * size // 2
    step = 2 * np.pi / size
    centre = psf.shape[1] // 2
    scale = (table.shape[0] - 1) / (22.0 + 14.0)
    columns = np.empty(2 * reach + 1, np.complex64)
    rows = np.empty(2 * reach, np.complex64)
    clumps = np.empty((1, 1), np.complex64)
    for s in range(chosen.shape[0]):
        n = chosen[s]
        shift_x = x[n] - np.floor(x[n]) + size // 2
        shift_y = y[n] - np.floor(y[n]) + size // 2
        for j in range(2 * reach + 1):
            columns[j] = np.exp(-1j * step * (j - reach) * shift_x)
        for j in range(2 * reach):
            rows[j] = np.exp(-1j * step * (j - reach) * shift_y)
        for c in range(start[n], start[n + 1]):
            if kind[c] == 3:
                if clumps.shape[0] != 2 * reach:
                    clumps = np.empty((2 * reach, 2 * reach + 1), np.complex64)
                _knot_sum(keys[n], knots[c], matrix[c], step, reach, clumps)
            for jy in range(-reach + 1, reach):
                gy = jy % size
                ky = step * jy
                for jx in range(-reach, reach + 1):
                    gx = jx % size
                    if gx > size // 2:
                        continue
                    kx = step * jx
                    amplitude = np.complex64(0)
                    if jx >= 0:
                        for w in range(nodes):
                            amplitude += photons[c, w] * psf[w, centre + jy * stride, jx * stride]
                    else:
                        for w in range(nodes):
                            amplitude += photons[c, w] * psf[w, centre - jy * stride, -jx * stride]
                        amplitude = np.conj(amplitude)
                    if kind[c] == 3:
                        a = smoothing[c, 0, 0] * kx + smoothing[c, 1, 0] * ky
                        b = smoothing[c, 0, 1] * kx + smoothing[c, 1, 1] * ky
                        amplitude *= clumps[jy + reach, jx + reach] * np.float32(np.exp(-(a * a + b * b) / 2))
                    elif kind[c] != 0:
                        a = matrix[c, 0, 0] * kx + matrix[c, 1, 0] * ky
                        b = matrix[c, 0, 1] * kx + matrix[c, 1, 1] * ky
                        q = a * a + b * b
                        if kind[c] == 1:
                            t = 1.0 + q * (0.5958243473776976 * 0.5958243473776976)
                            amplitude *= np.float32(1.0 / (t * np.sqrt(t)))
                        else:
                            position = (np.log(q + 1e-30) + 14.0) * scale
                            position = min(max(position, 0.0), table.shape[0] - 1.001)
                            low = int(position)
                            share = position - low
                            amplitude *= np.float32(table[low] * (1 - share) + table[low + 1] * share)
                    transforms[s, gy, gx] += amplitude * columns[jx + reach] * rows[jy + reach]


@numba.njit(nogil=True, cache=True)
def _add(image, stamps, chosen, x, y):
    """Add stamps to the image where they fall on it."""
    ny, nx = image.shape
    size = stamps.shape[1]
    for s in range(chosen.shape[0]):
        x0 = int(np.floor(x[chosen[s]])) - size // 2
        y0 = int(np.floor(y[chosen[s]])) - size // 2
        for j in range(max(0, -y0), min(size, ny - y0)):
            for i in range(max(0, -x0), min(size, nx - x0)):
                image[y0 + j, x0 + i] += stamps[s, j, i]
