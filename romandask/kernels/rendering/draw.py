"""Draw galaxies and stars on a pixel grid in Fourier space, noiselessly, into an image of expected electrons.

For each object the analytic transforms of its components (sheared, lensed, projected to pixels) are multiplied by the
chromatic PSF of its place weighted by the component's own spectrum, folded to the pixel grid, and brought back by one
inverse real FFT a stamp.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass

import numpy as np
from scipy import fft

from romandask.kernels.rendering.fourier import (
    DEVAUCOULEURS,
    EXPONENTIAL,
    EXPONENTIAL_RADIUS,
    KNOT_SIGMA,
    KNOTS,
    POINT,
    Frequencies,
    add,
    devaucouleurs_table,
    fill,
    unfold,
)
from romandask.kernels.rendering.psf import BrightPsf, Grid, PsfModel, stamp_frequencies, star_image

SMALLEST = 32
"""Smallest stamp, pixels a side."""
_BATCH_BYTES = 1 << 24
"""Of the PSFs, or the images, of objects that are drawn together."""
_MEASURED = 1000
"""Of `faintest`: objects with more light are drawn on stamps that hold all but a thousandth of a disk."""
_PRECISION = 3e-4
"""Modes of the PSF are left out where together they change no pixel by more than this share of a star's peak."""


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


@dataclass(frozen=True)
class Stamps:
    """How the objects of a scene are drawn."""

    size: np.ndarray
    """(n,) side, pixels, a power of two; 0 where an object has no light on the image."""
    bright: np.ndarray
    """(n,) -1, or which of the PSFs of bright stars is the object's."""


def draw(
    scene: Scene,
    psf: PsfModel,
    shape: tuple[int, int],
    stamps: Stamps,
    faintest: float,
    bright: Sequence[BrightPsf] = (),
) -> np.ndarray:
    """Return the image (float32, electrons) of a scene.

    Parameters
    ----------
    shape : (ny, nx)
    stamps : what `plan_stamps` returns
    faintest : surface brightness, electrons a pixel, that stamps were planned for: the PSF is as accurate
    bright : PSFs of bright stars, the brightest last
    """
    image = np.zeros(shape, np.float32)
    wide = (stamps.size > psf.core.size) | ((stamps.bright >= 0) & (stamps.size > 0))
    _draw_core(image, scene, psf, stamps.size, wide, faintest)
    _draw_middle(image, scene, psf, np.where(wide & (stamps.bright < 0), stamps.size, 0))
    for number, star in enumerate(bright):
        own = stamps.bright == number
        if stamps.size[own].any():
            draw_wide(image, scene, scene.photons @ star.shares, star.nodes(), star.grid, np.where(own, stamps.size, 0))
    return image


def plan_stamps(
    scene: Scene,
    edges: dict[int, float],
    shape: tuple[int, int],
    faintest: float,
    largest: int,
    bright: Sequence[BrightPsf] = (),
) -> Stamps:
    """Return the stamps of a scene.

    Parameters
    ----------
    edges : those of its PsfModel
    shape : (ny, nx)
    faintest : surface brightness, electrons a pixel, below which a stamp may end
    largest : no stamp is larger, pixels a side
    bright : PSFs of bright stars, the brightest last
    """
    flux = scene.fluxes()
    star = np.ones(len(scene.x), bool)
    star[scene.owner[scene.kind != POINT]] = False
    number = np.full(len(scene.x), -1)
    limit = np.full(len(scene.x), min(largest, max(edges)))
    for k, one in enumerate(bright):
        own = star & (flux >= one.least)
        number[own], limit[own] = k, min(largest, one.grid.size)
    # bright stars take all that their PSF has, so that it need not be cut
    size = np.where(number >= 0, limit, stamp_sizes(scene, edges, faintest, limit))
    return Stamps(np.where(on_image(scene, size, shape) & (flux > 0), size, 0), number)


def _draw_core(
    image: np.ndarray, scene: Scene, psf: PsfModel, size: np.ndarray, wide: np.ndarray, faintest: float
) -> None:
    """Add objects to an image, each with the PSF of its place.

    Of `wide` objects only the difference from the PSF in the middle of the detector is drawn here, on a stamp of the
    model's core, for others to add the rest.
    """
    x, y = scene.x[scene.owner], scene.y[scene.owner]
    photons = scene.photons.astype(np.float32)
    weights = psf.weights(photons, x, y)
    far = wide[scene.owner]
    weights[far] = psf.shifted(photons[far], x[far], y[far])
    peak = photons.sum(axis=1) * np.float32(psf.peaks[0])
    modes = _needed(weights, psf.peaks, np.clip(peak * _PRECISION, 0.05 * faintest, 0.5 * faintest))
    first = np.searchsorted(scene.owner, np.arange(len(scene.x) + 1))
    core = np.minimum(size, psf.core.size)
    if not psf.degree:
        core = np.where(wide, 0, core)
    for stamp in np.unique(core[core > 0]):
        waves = psf.frequencies(int(stamp))
        _draw(image, scene, np.flatnonzero(core == stamp), first, weights, modes, waves, int(stamp))


def _draw_middle(image: np.ndarray, scene: Scene, psf: PsfModel, size: np.ndarray) -> None:
    """Add objects on stamps larger than the model's core, with the PSF in the middle of the detector."""
    first = np.searchsorted(scene.owner, np.arange(len(scene.x) + 1))
    weights = scene.photons.astype(np.float32)
    every = np.full(len(scene.owner), weights.shape[1])
    for stamp in np.unique(size[size > 0]):
        waves = psf.wide_frequencies(int(stamp))
        _draw(image, scene, np.flatnonzero(size == stamp), first, weights, every, waves, int(stamp))


def draw_wide(
    image: np.ndarray,
    scene: Scene,
    photons: np.ndarray,
    nodes: Iterable[np.ndarray],
    grid: Grid,
    size: np.ndarray,
) -> None:
    """Add objects to an image with PSFs that are the same everywhere, on stamps of any size.

    One PSF is in memory at a time, for those of the brightest stars are large.

    Parameters
    ----------
    photons : (components, nodes) electrons by PSF
    nodes : the transforms (grid.shape) of the PSFs
    size : (objects,) stamps; 0 leaves an object out
    """
    if not size.any():
        return
    first = np.searchsorted(scene.owner, np.arange(len(scene.x) + 1))
    one = np.ones(len(scene.owner), np.int64)
    sizes = np.unique(size[size > 0])
    for node, transform in enumerate(nodes):
        weights = np.ascontiguousarray(photons[:, node : node + 1], np.float32)
        # a stamp as large as the grid needs no image to cut
        fine = star_image(transform, grid, grid.folds)[None] if sizes[0] < grid.size else np.empty((1, 0, 0))
        for stamp in sizes:
            waves = stamp_frequencies(transform[None], fine, grid, int(stamp))
            chosen = np.flatnonzero(size == stamp)
            _draw(image, scene, chosen, first, weights, one, waves, int(stamp))


def _draw(
    image: np.ndarray,
    scene: Scene,
    chosen: np.ndarray,
    first: np.ndarray,
    weights: np.ndarray,
    modes: np.ndarray,
    waves: Frequencies,
    stamp: int,
) -> None:
    light = weights @ waves.totals[: weights.shape[1]]
    count = np.diff(first)[chosen]
    # objects that need as many modes together: one product of matrices gives the PSFs of all their components
    needed = np.zeros(len(scene.x), int)
    np.maximum.at(needed, scene.owner, modes)
    needed = needed[chosen]
    order = np.argsort(needed, kind="stable")
    room = max(1, _BATCH_BYTES // max(stamp * stamp * 4, int(count.max(initial=1)) * len(waves.x) * 8))
    for start in range(0, len(chosen), room):
        part = order[start : start + room]
        rows, most = chosen[part], int(needed[part].max())
        begin = np.concatenate([[0], np.cumsum(count[part])])
        own = np.repeat(first[rows] - begin[:-1], count[part]) + np.arange(begin[-1])
        psfs = [np.ascontiguousarray(weights[own, :most]) @ plane[:most] for plane in (waves.real, waves.imaginary)]
        transforms = np.empty((len(rows), stamp, stamp // 2 + 1), np.complex64)
        fill(
            transforms,
            rows,
            scene.x,
            scene.y,
            scene.key,
            first,
            scene.kind,
            scene.matrix,
            scene.smoothing,
            scene.knots,
            begin,
            *psfs,
            waves.starts,
            waves.x,
            waves.y,
            devaucouleurs_table(),
        )
        images = fft.irfft2(transforms, s=(stamp, stamp), overwrite_x=True)
        unfold(images, rows, scene.x, scene.y, first, scene.kind, scene.matrix, light)
        add(image, images, rows, scene.x, scene.y)


def _needed(weights: np.ndarray, peaks: np.ndarray, tolerance: np.ndarray) -> np.ndarray:
    """Return how many modes each component needs so that those left out stay below a surface brightness, its own."""
    rest = np.cumsum((np.abs(weights) * peaks.astype(np.float32))[:, ::-1], axis=1)[:, ::-1]
    return np.maximum((rest > tolerance[:, None]).sum(axis=1), 1)


def stamp_sizes(scene: Scene, edges: dict[int, float], faintest: float, largest: np.ndarray | int) -> np.ndarray:
    """Return the stamp size (n,) of each object: a power of two whose edge is fainter than `faintest` a pixel.

    Parameters
    ----------
    edges : surface brightness of a unit star, 1/pixel, at the edge of stamps by size; beyond the last it falls as r^-2
    """
    radius = np.zeros(len(scene.x))
    np.maximum.at(radius, scene.owner, component_radii(scene, faintest))
    flux = scene.fluxes()
    size = np.full(len(scene.x), SMALLEST)
    while True:
        grow = (radius > size / 2 - np.minimum(size / 4, 6)) | (flux * _edge(edges, size) > faintest)
        grow &= size < largest
        if not grow.any():
            return size
        size = np.where(grow, size * 2, size)


def on_image(scene: Scene, size: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return True for objects (n,) whose stamps touch the image."""
    half = size // 2
    across = (scene.x > -half) & (scene.x < shape[1] - 1 + half)
    return across & (scene.y > -half) & (scene.y < shape[0] - 1 + half)


def _edge(edges: dict[int, float], size: np.ndarray) -> np.ndarray:
    known = np.array(sorted(edges))
    values = np.array([edges[k] for k in known])
    return values[np.searchsorted(known, np.minimum(size, known[-1]))] * np.minimum(known[-1] / size, 1.0) ** 2


def component_radii(scene: Scene, faintest: float) -> np.ndarray:
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
    # what lies beyond half a stamp is not convolved as it should be: of objects that will be measured, a thousandth
    bright = scene.fluxes()[scene.owner] > _MEASURED * faintest
    radius = np.where(
        bright,
        np.maximum(radius, np.select([scene.kind == EXPONENTIAL, scene.kind == DEVAUCOULEURS], [5.5, 10.0])),
        radius,
    )
    # knots are Gaussian scattered; none of a hundred lies beyond about 3.5 sigma
    radius = np.where(scene.kind == KNOTS, 3.5 * KNOT_SIGMA, radius)
    smoothing = 4 * np.sqrt((scene.smoothing**2).sum(axis=(1, 2)))
    return np.where(flux > 0, np.maximum(radius, 0) * major + smoothing, 0.0)
