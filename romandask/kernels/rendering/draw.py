"""Rendering of galaxies and stars in Fourier space, to a noiseless image of expected electrons.

The analytic transform of each component of an object (sheared, lensed and projected to pixels) is multiplied by the
chromatic PSF at the position of the object, weighted by the spectrum of the component. The sum is folded to the pixel
grid and transformed back by one inverse real FFT per stamp.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numpy as np
from scipy import fft

from romandask.kernels.rendering.fourier import Frequencies, devaucouleurs_table, fill_transforms
from romandask.kernels.rendering.profiles import profile_tables
from romandask.kernels.rendering.psf import BrightPsf, Grid, PsfModel, stamp_frequencies, star_image
from romandask.kernels.rendering.stamp_images import add_stamps, subtract_periodic_images
from romandask.kernels.rendering.stamps import Scene, Stamps, component_extents, component_radii
from romandask.kernels.rendering.wings import add_wings

_BATCH_BYTES = 1 << 24
"""Memory of the PSFs, or of the images, of the objects that are drawn together."""
_PSF_TOLERANCE = 3e-4
"""PSF modes are left out if together they change no pixel by more than this fraction of the peak of a star."""


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
    drawn = np.zeros(len(scene.owner))
    radii = component_extents(scene), component_radii(scene, faintest)
    wide = (stamps.size > psf.core.size) | ((stamps.bright >= 0) & (stamps.size > 0))
    _draw_core(image, drawn, scene, radii, psf, stamps.size, wide, faintest)
    _draw_middle(image, drawn, scene, radii, psf, np.where(wide & (stamps.bright < 0), stamps.size, 0))
    for number, star_psf in enumerate(bright):
        size = np.where(stamps.bright == number, stamps.size, 0)
        if size.any():
            drawn += draw_wide(image, scene, scene.photons @ star_psf.shares, star_psf.nodes, star_psf.grid, size)
    missing = np.bincount(scene.owner, scene.photons.sum(axis=1) - drawn, minlength=len(scene.x))
    ends = np.array([psf.grid.size, *(star_psf.grid.size for star_psf in bright)])[stamps.bright + 1]
    add_wings(image, scene, radii, psf.rings, stamps, np.where(stamps.size > 0, missing, np.nan), ends)
    return image


def _draw_core(
    image: np.ndarray,
    drawn: np.ndarray,
    scene: Scene,
    radii: tuple[np.ndarray, np.ndarray],
    psf: PsfModel,
    size: np.ndarray,
    wide: np.ndarray,
    faintest: float,
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
    first = _first_components(scene)
    core_size = np.minimum(size, psf.core.size)
    if not psf.degree:
        core_size = np.where(wide, 0, core_size)
    for stamp in np.unique(core_size[core_size > 0]):
        frequencies = psf.frequencies(int(stamp))
        chosen = np.flatnonzero(core_size == stamp)
        _draw(image, drawn, scene, radii, chosen, first, weights, modes, frequencies, int(stamp))


def _draw_middle(
    image: np.ndarray,
    drawn: np.ndarray,
    scene: Scene,
    radii: tuple[np.ndarray, np.ndarray],
    psf: PsfModel,
    size: np.ndarray,
) -> None:
    """Add objects with stamps larger than the core of the PSF model, with the PSF in the middle of the detector."""
    first = _first_components(scene)
    weights = scene.photons.astype(np.float32)
    modes = np.full(len(scene.owner), weights.shape[1])
    for stamp in np.unique(size[size > 0]):
        frequencies = psf.wide_frequencies(int(stamp))
        chosen = np.flatnonzero(size == stamp)
        _draw(image, drawn, scene, radii, chosen, first, weights, modes, frequencies, int(stamp))


def draw_wide(
    image: np.ndarray,
    scene: Scene,
    photons: np.ndarray,
    nodes: Iterable[np.ndarray],
    grid: Grid,
    size: np.ndarray,
) -> np.ndarray:
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

    Returns
    -------
    array, shape (components,), electrons
        Light that the PSF leaves on the stamps.
    """
    drawn = np.zeros(len(scene.owner))
    if not size.any():
        return drawn
    first = _first_components(scene)
    modes = np.ones(len(scene.owner), np.int64)
    radii = component_extents(scene), np.zeros(len(scene.owner))
    sizes = np.unique(size[size > 0])
    for node, transform in enumerate(nodes):
        weights = np.ascontiguousarray(photons[:, node : node + 1], np.float32)
        # a stamp as large as the grid is not cut from an image
        fine = star_image(transform, grid, grid.folds)[None] if sizes[0] < grid.size else np.empty((1, 0, 0))
        for stamp in sizes:
            frequencies = stamp_frequencies(transform[None], fine, grid, int(stamp))
            chosen = np.flatnonzero(size == stamp)
            _draw(image, drawn, scene, radii, chosen, first, weights, modes, frequencies, int(stamp))
    return drawn


def _draw(
    image: np.ndarray,
    drawn: np.ndarray,
    scene: Scene,
    radii: tuple[np.ndarray, np.ndarray],
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
    drawn : array, shape (components,), electrons
        Light that the PSF leaves on the stamps; added to.
    radii : (array, array), shape (components,), pixels
        Results of `component_extents` and of `component_radii`.
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
    count = np.diff(first)[chosen]
    # objects that need similar numbers of modes go together: one matrix product gives the PSFs of all their components
    object_modes = np.zeros(len(scene.x), int)
    np.maximum.at(object_modes, scene.owner, modes)
    object_modes = object_modes[chosen]
    order = np.argsort(object_modes, kind="stable")
    light = np.zeros(len(scene.owner))
    batch = max(1, _BATCH_BYTES // max(stamp * stamp * 4, int(count.max(initial=1)) * len(frequencies.x) * 8))
    for start in range(0, len(chosen), batch):
        part = order[start : start + batch]
        objects, n_modes = chosen[part], int(object_modes[part].max())
        begin = np.concatenate([[0], np.cumsum(count[part])])
        components = np.repeat(first[objects] - begin[:-1], count[part]) + np.arange(begin[-1])
        part_weights = np.ascontiguousarray(weights[components, :n_modes])
        light[components] = part_weights @ frequencies.totals[:n_modes]
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
        subtract_periodic_images(
            images, objects, scene.x, scene.y, first, scene.kind, scene.matrix, light, *radii, profile_tables()
        )
        add_stamps(image, images, objects, scene.x, scene.y)
    drawn += light


def _first_components(scene: Scene) -> np.ndarray:
    """Return the index of the first component of each object, and the number of components, shape (n + 1,)."""
    return np.searchsorted(scene.owner, np.arange(len(scene.x) + 1))


def _required_modes(weights: np.ndarray, peaks: np.ndarray, tolerance: np.ndarray) -> np.ndarray:
    """Return the number of modes of each component such that the others together stay below a surface brightness.

    `tolerance` is that surface brightness for each component, electrons/pixel.
    """
    remainder = np.cumsum((np.abs(weights) * peaks.astype(np.float32))[:, ::-1], axis=1)[:, ::-1]
    return np.maximum((remainder > tolerance[:, None]).sum(axis=1), 1)
