"""Rendering of galaxies and stars in Fourier space, to a noiseless image of expected electrons.

The analytic transform of each component of an object (sheared, lensed and projected to pixels) is multiplied by the
chromatic PSF at the position of the object, weighted by the spectrum of the component. The sum is folded to the pixel
grid and transformed back by one inverse real FFT per stamp.
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
    devaucouleurs_table,
    fill_transforms,
)
from romandask.kernels.rendering.psf import BrightPsf, Grid, PsfModel, stamp_frequencies, star_image
from romandask.kernels.rendering.stamp_images import add_stamps, subtract_periodic_images

MIN_STAMP = 32
"""Side of the smallest stamps, pixels."""
_BATCH_BYTES = 1 << 24
"""Memory of the PSFs, or of the images, of the objects that are drawn together."""
_MEASURABLE_FLUX = 1000
"""Flux, in units of `faintest`, above which the stamps of galaxies contain all but a thousandth of a disk."""
_PSF_TOLERANCE = 3e-4
"""PSF modes are left out if together they change no pixel by more than this fraction of the peak of a star."""


@dataclass(frozen=True)
class Scene:
    """The n objects on one image and their c components, which are sorted by object."""

    x: np.ndarray
    """Pixel coordinate along x, 0 at the centre of the first pixel, shape (n,)."""
    y: np.ndarray
    """Pixel coordinate along y, 0 at the centre of the first pixel, shape (n,)."""
    key: np.ndarray
    """Identity of the object, which decides the positions of its knots, shape (n,), uint64."""
    owner: np.ndarray
    """Index of the object that the component belongs to, shape (c,), ascending."""
    kind: np.ndarray
    """POINT, EXPONENTIAL, DEVAUCOULEURS or KNOTS, shape (c,)."""
    matrix: np.ndarray
    """Linear map from a round profile of half-light radius 1 to pixels, shape (c, 2, 2): size, shape, lensing, WCS."""
    smoothing: np.ndarray
    """Linear map from a round Gaussian of sigma 1 to the Gaussian in pixels that smooths knots, shape (c, 2, 2); zeros
    for no smoothing."""
    knots: np.ndarray
    """Number of knots, shape (c,)."""
    photons: np.ndarray
    """Electrons at each PSF node, shape (c, nodes)."""

    def fluxes(self) -> np.ndarray:
        """Return the electrons of each object, shape (n,)."""
        return np.bincount(self.owner, self.photons.sum(axis=1), minlength=len(self.x))


@dataclass(frozen=True)
class Stamps:
    """Stamp sizes and PSFs of the n objects of a scene."""

    size: np.ndarray
    """Side of the stamp, pixels, a power of two, shape (n,); 0 for an object without light on the image."""
    bright: np.ndarray
    """Index of the bright-star PSF of the object, shape (n,); -1 for the PSF model."""


def draw(
    scene: Scene,
    psf: PsfModel,
    shape: tuple[int, int],
    stamps: Stamps,
    faintest: float,
    bright: Sequence[BrightPsf] = (),
) -> np.ndarray:
    """Return the image of a scene.

    Parameters
    ----------
    scene : Scene
        Objects.
    psf : PsfModel
        PSF of the detector and band.
    shape : (int, int)
        Shape of the image (ny, nx).
    stamps : Stamps
        Result of `plan_stamps`.
    faintest : float, electrons/pixel
        Surface brightness for which the stamps were planned; it also sets the accuracy of the PSF.
    bright : sequence of BrightPsf
        PSFs of bright stars, that of the brightest last.

    Returns
    -------
    float32 array, shape (ny, nx), electrons
        Image.
    """
    image = np.zeros(shape, np.float32)
    wide = (stamps.size > psf.core.size) | ((stamps.bright >= 0) & (stamps.size > 0))
    _draw_core(image, scene, psf, stamps.size, wide, faintest)
    _draw_middle(image, scene, psf, np.where(wide & (stamps.bright < 0), stamps.size, 0))
    for number, star_psf in enumerate(bright):
        size = np.where(stamps.bright == number, stamps.size, 0)
        if size.any():
            draw_wide(image, scene, scene.photons @ star_psf.shares, star_psf.nodes, star_psf.grid, size)
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
    scene : Scene
        Objects.
    edges : dict of int to float, 1/pixel
        Surface brightness of a unit star at the edges of stamps, by stamp size; see `PsfModel.edges`.
    shape : (int, int)
        Shape of the image (ny, nx).
    faintest : float, electrons/pixel
        Largest surface brightness at the edge of a stamp.
    largest : int
        Side of the largest stamps, pixels; limits a stamp even if its edge is brighter than `faintest`.
    bright : sequence of BrightPsf
        PSFs of bright stars, that of the brightest last.
    """
    flux = scene.fluxes()
    is_star = np.ones(len(scene.x), bool)
    is_star[scene.owner[scene.kind != POINT]] = False
    bright_index = np.full(len(scene.x), -1)
    limit = np.full(len(scene.x), min(largest, max(edges)))
    for k, star_psf in enumerate(bright):
        chosen = is_star & (flux >= star_psf.min_electrons)
        bright_index[chosen], limit[chosen] = k, min(largest, star_psf.grid.size)
    # the stamps of bright stars are as large as their PSF, so that the PSF is not cut
    size = np.where(bright_index >= 0, limit, stamp_sizes(scene, edges, faintest, limit))
    return Stamps(np.where(on_image(scene, size, shape) & (flux > 0), size, 0), bright_index)


def _draw_core(
    image: np.ndarray, scene: Scene, psf: PsfModel, size: np.ndarray, wide: np.ndarray, faintest: float
) -> None:
    """Add objects to an image, each with the PSF at its position.

    For `wide` objects, whose stamps are larger than the core of the PSF model or which have a bright-star PSF, only the
    difference from the PSF in the middle of the detector is added, on a stamp of the size of the core. The rest is
    added by `_draw_middle` or `draw_wide`.
    """
    x, y = scene.x[scene.owner], scene.y[scene.owner]
    photons = scene.photons.astype(np.float32)
    weights = psf.weights(photons, x, y)
    wide_component = wide[scene.owner]
    weights[wide_component] = psf.difference_weights(photons[wide_component], x[wide_component], y[wide_component])
    peak = photons.sum(axis=1) * np.float32(psf.peaks[0])
    modes = _required_modes(weights, psf.peaks, np.clip(peak * _PSF_TOLERANCE, 0.05 * faintest, 0.5 * faintest))
    first = np.searchsorted(scene.owner, np.arange(len(scene.x) + 1))
    core_size = np.minimum(size, psf.core.size)
    if not psf.degree:
        core_size = np.where(wide, 0, core_size)
    for stamp in np.unique(core_size[core_size > 0]):
        frequencies = psf.frequencies(int(stamp))
        _draw(image, scene, np.flatnonzero(core_size == stamp), first, weights, modes, frequencies, int(stamp))


def _draw_middle(image: np.ndarray, scene: Scene, psf: PsfModel, size: np.ndarray) -> None:
    """Add objects with stamps larger than the core of the PSF model, with the PSF in the middle of the detector."""
    first = np.searchsorted(scene.owner, np.arange(len(scene.x) + 1))
    weights = scene.photons.astype(np.float32)
    modes = np.full(len(scene.owner), weights.shape[1])
    for stamp in np.unique(size[size > 0]):
        frequencies = psf.wide_frequencies(int(stamp))
        _draw(image, scene, np.flatnonzero(size == stamp), first, weights, modes, frequencies, int(stamp))


def draw_wide(
    image: np.ndarray,
    scene: Scene,
    photons: np.ndarray,
    nodes: Iterable[np.ndarray],
    grid: Grid,
    size: np.ndarray,
) -> None:
    """Add objects to an image with a PSF that does not vary over the detector, on stamps of any size.

    Only one node of the PSF is in memory at a time, because the PSFs of the brightest stars are large.

    Parameters
    ----------
    image : float32 array, shape (ny, nx), electrons
        Image; modified in place.
    scene : Scene
        Objects.
    photons : array, shape (components, nodes)
        Electrons of each component at each node of this PSF.
    nodes : iterable of complex64 arrays, shape (grid.shape)
        Transforms of the PSF at each node.
    grid : Grid
        Frequencies of the transforms.
    size : int array, shape (objects,)
        Sides of the stamps, pixels; objects of size 0 are not drawn.
    """
    if not size.any():
        return
    first = np.searchsorted(scene.owner, np.arange(len(scene.x) + 1))
    modes = np.ones(len(scene.owner), np.int64)
    sizes = np.unique(size[size > 0])
    for node, transform in enumerate(nodes):
        weights = np.ascontiguousarray(photons[:, node : node + 1], np.float32)
        # a stamp as large as the grid is not cut from an image
        fine = star_image(transform, grid, grid.folds)[None] if sizes[0] < grid.size else np.empty((1, 0, 0))
        for stamp in sizes:
            frequencies = stamp_frequencies(transform[None], fine, grid, int(stamp))
            chosen = np.flatnonzero(size == stamp)
            _draw(image, scene, chosen, first, weights, modes, frequencies, int(stamp))


def _draw(
    image: np.ndarray,
    scene: Scene,
    chosen: np.ndarray,
    first: np.ndarray,
    weights: np.ndarray,
    modes: np.ndarray,
    frequencies: Frequencies,
    stamp: int,
) -> None:
    """Add chosen objects, all with stamps of one size, to an image.

    Parameters
    ----------
    image, scene
        As for `draw_wide`.
    chosen : int array, shape (k,)
        Indices of the objects.
    first : int array, shape (n + 1,)
        Index of the first component of each object of the scene.
    weights : float32 array, shape (components, modes)
        Weights of the PSF modes for each component.
    modes : int array, shape (components,)
        Number of PSF modes to use for each component.
    frequencies : Frequencies
        PSF modes at the frequencies of the stamp.
    stamp : int
        Side of the stamps, pixels.
    """
    light = weights @ frequencies.totals[: weights.shape[1]]
    count = np.diff(first)[chosen]
    # objects that need similar numbers of modes go together: one matrix product gives the PSFs of all their components
    object_modes = np.zeros(len(scene.x), int)
    np.maximum.at(object_modes, scene.owner, modes)
    object_modes = object_modes[chosen]
    order = np.argsort(object_modes, kind="stable")
    batch = max(1, _BATCH_BYTES // max(stamp * stamp * 4, int(count.max(initial=1)) * len(frequencies.x) * 8))
    for start in range(0, len(chosen), batch):
        part = order[start : start + batch]
        objects, n_modes = chosen[part], int(object_modes[part].max())
        begin = np.concatenate([[0], np.cumsum(count[part])])
        components = np.repeat(first[objects] - begin[:-1], count[part]) + np.arange(begin[-1])
        part_weights = np.ascontiguousarray(weights[components, :n_modes])
        psf_real = part_weights @ frequencies.real[:n_modes]
        psf_imaginary = part_weights @ frequencies.imaginary[:n_modes]
        transforms = np.empty((len(objects), stamp, stamp // 2 + 1), np.complex64)
        fill_transforms(
            transforms,
            objects,
            scene.x,
            scene.y,
            scene.key,
            first,
            scene.kind,
            scene.matrix,
            scene.smoothing,
            scene.knots,
            begin,
            psf_real,
            psf_imaginary,
            frequencies.starts,
            frequencies.x,
            frequencies.y,
            devaucouleurs_table(),
        )
        images = fft.irfft2(transforms, s=(stamp, stamp), overwrite_x=True)
        subtract_periodic_images(images, objects, scene.x, scene.y, first, scene.kind, scene.matrix, light)
        add_stamps(image, images, objects, scene.x, scene.y)


def _required_modes(weights: np.ndarray, peaks: np.ndarray, tolerance: np.ndarray) -> np.ndarray:
    """Return the number of modes of each component such that the others together stay below a surface brightness.

    `tolerance` is that surface brightness for each component, electrons/pixel.
    """
    remainder = np.cumsum((np.abs(weights) * peaks.astype(np.float32))[:, ::-1], axis=1)[:, ::-1]
    return np.maximum((remainder > tolerance[:, None]).sum(axis=1), 1)


def stamp_sizes(scene: Scene, edges: dict[int, float], faintest: float, largest: np.ndarray | int) -> np.ndarray:
    """Return the stamp size of each object: the smallest power of two whose edge is fainter than a surface brightness.

    Parameters
    ----------
    scene : Scene
        Objects.
    edges : dict of int to float, 1/pixel
        Surface brightness of a unit star at the edges of stamps, by stamp size; beyond the largest size it falls as
        r^-2.
    faintest : float, electrons/pixel
        Largest surface brightness at the edge.
    largest : int or int array, shape (n,)
        Largest stamp size of each object, pixels.

    Returns
    -------
    int array, shape (n,), pixels
        Sides of the stamps.
    """
    radius = np.zeros(len(scene.x))
    np.maximum.at(radius, scene.owner, component_radii(scene, faintest))
    flux = scene.fluxes()
    size = np.full(len(scene.x), MIN_STAMP)
    while True:
        grow = (radius > size / 2 - np.minimum(size / 4, 6)) | (flux * _edge(edges, size) > faintest)
        grow &= size < largest
        if not grow.any():
            return size
        size = np.where(grow, size * 2, size)


def on_image(scene: Scene, size: np.ndarray, shape: tuple[int, int]) -> np.ndarray:
    """Return True for the objects, shape (n,), whose stamps overlap an image of shape (ny, nx)."""
    half = size // 2
    across = (scene.x > -half) & (scene.x < shape[1] - 1 + half)
    return across & (scene.y > -half) & (scene.y < shape[0] - 1 + half)


def _edge(edges: dict[int, float], size: np.ndarray) -> np.ndarray:
    """Return the surface brightness of a unit star at the edges of stamps of any size."""
    sizes = np.array(sorted(edges))
    values = np.array([edges[k] for k in sizes])
    return values[np.searchsorted(sizes, np.minimum(size, sizes[-1]))] * np.minimum(sizes[-1] / size, 1.0) ** 2


def component_radii(scene: Scene, faintest: float) -> np.ndarray:
    """Return the radius along the major axis at which each component falls below a surface brightness.

    The radius is that of the profile before convolution with the PSF. It is larger for bright galaxies, whose stamps
    must contain almost all of their light.

    Parameters
    ----------
    scene : Scene
        Objects.
    faintest : float, electrons/pixel
        Surface brightness.

    Returns
    -------
    array, shape (components,), pixels
        Radii; 0 for points and for components without light.
    """
    flux = scene.photons.sum(axis=1)
    squares = (scene.matrix**2).sum(axis=(1, 2))
    area = np.abs(np.linalg.det(scene.matrix))
    major = np.sqrt((squares + np.sqrt(np.maximum(squares**2 - 4 * area**2, 0))) / 2)
    area = np.maximum(area, 1e-12)
    with np.errstate(divide="ignore"):
        disk = np.log(flux / (2 * np.pi * EXPONENTIAL_RADIUS**2 * area * faintest)) * EXPONENTIAL_RADIUS
        bulge = (1 + np.maximum(np.log(flux / (22.67 * area * faintest)) / 7.669, -1)) ** 4
    radius = np.where(scene.kind == EXPONENTIAL, disk, np.where(scene.kind == DEVAUCOULEURS, bulge, 0.0))
    # light beyond half a stamp is not convolved correctly: for objects bright enough to be measured, at most a
    # thousandth of the light may lie there
    bright = scene.fluxes()[scene.owner] > _MEASURABLE_FLUX * faintest
    radius = np.where(
        bright,
        np.maximum(radius, np.select([scene.kind == EXPONENTIAL, scene.kind == DEVAUCOULEURS], [5.5, 10.0])),
        radius,
    )
    # the positions of knots are Gaussian; not one in a hundred knots lies beyond about 3.5 sigma
    radius = np.where(scene.kind == KNOTS, 3.5 * KNOT_SIGMA, radius)
    smoothing = 4 * np.sqrt((scene.smoothing**2).sum(axis=(1, 2)))
    return np.where(flux > 0, np.maximum(radius, 0) * major + smoothing, 0.0)
