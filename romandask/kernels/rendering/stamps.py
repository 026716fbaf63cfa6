"""Scenes of galaxies and stars, and the stamps on which their objects are drawn."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from romandask.kernels.rendering.fourier import (
    DEVAUCOULEURS,
    EXPONENTIAL,
    EXPONENTIAL_RADIUS,
    KNOT_SIGMA,
    KNOTS,
    POINT,
)
from romandask.kernels.rendering.profiles import light_radius
from romandask.kernels.rendering.psf import BrightPsf
from romandask.kernels.rendering.rings import FIRST_SIDE

MIN_STAMP = FIRST_SIDE
"""Side of the smallest stamps, pixels."""
_SMALLEST_SHARE = 0.25
"""Surface brightness at the edges of the smallest stamps, in units of that at others: they are for objects that no
image shows one by one, because wings that begin so near the middle change the size of an object by half a per cent."""
_LEAST_RADIUS = 1.2
"""Radius, in half-light radii, of the part of a galaxy that its stamp contains, however faint it is."""
_MEASURABLE_FLUX = 1000
"""Flux, in units of `faintest`, above which the stamps of galaxies contain all but a thousandth of a disk."""
_TAIL = 2e-4
"""Fraction of the light of an object that may lie beyond the extent of each of its components."""


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
    inside: np.ndarray
    """Side of the square around the object, pixels, beyond which its light is in wings, shape (n,); 0 for no light.

    It is `size`, also where the stamp does not overlap the image but the wings may."""

    def only(self, chosen: np.ndarray) -> Stamps:
        """Return the stamps of chosen objects, given as a mask of shape (n,); the others have no light."""
        return Stamps(np.where(chosen, self.size, 0), self.bright, np.where(chosen, self.inside, 0))


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
    inside = np.where(flux > 0, size, 0)
    return Stamps(np.where(on_image(scene, size, shape), inside, 0), bright_index, inside)


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
    # the PSF scatters out of the stamp as if the light were in the middle
    least = _LEAST_RADIUS * major_axes(scene) * (scene.photons.sum(axis=1) > 0)
    np.maximum.at(radius, scene.owner, np.maximum(component_radii(scene, faintest), least))
    flux = scene.fluxes()
    size = np.full(len(scene.x), MIN_STAMP)
    while True:
        limit = np.where(size > MIN_STAMP, faintest, _SMALLEST_SHARE * faintest)
        grow = (radius > size / 2 - np.minimum(size / 4, 6)) | (flux * _edge(edges, size) > limit)
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

    The radius is that of the profile before convolution with the PSF.

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
    area = np.maximum(np.abs(np.linalg.det(scene.matrix)), 1e-12)
    with np.errstate(divide="ignore"):
        disk = np.log(flux / (2 * np.pi * EXPONENTIAL_RADIUS**2 * area * faintest)) * EXPONENTIAL_RADIUS
        bulge = (1 + np.maximum(np.log(flux / (22.67 * area * faintest)) / 7.669, -1)) ** 4
    radius = np.where(scene.kind == EXPONENTIAL, disk, np.where(scene.kind == DEVAUCOULEURS, bulge, 0.0))
    # light beyond a stamp is drawn on coarse grids, on which the moments of its pixels are not kept: for objects bright
    # enough to be measured, at most a thousandth of the light may lie there
    bright = scene.fluxes()[scene.owner] > _MEASURABLE_FLUX * faintest
    contained = np.select([scene.kind == EXPONENTIAL, scene.kind == DEVAUCOULEURS], [5.5, 10.0])
    radius = np.where(bright, np.maximum(radius, contained), radius)
    # the positions of knots are Gaussian; not one in a hundred knots lies beyond about 3.5 sigma
    radius = np.where(scene.kind == KNOTS, 3.5 * KNOT_SIGMA, radius)
    smoothing = 4 * np.sqrt((scene.smoothing**2).sum(axis=(1, 2)))
    return np.where(flux > 0, np.maximum(radius, 0) * major_axes(scene) + smoothing, 0.0)


def component_extents(scene: Scene) -> np.ndarray:
    """Return the radius, pixels, beyond which each component has no light that counts; 0 for points and knots."""
    flux = scene.photons.sum(axis=1)
    with np.errstate(divide="ignore", invalid="ignore"):
        outside = np.where(flux > 0, _TAIL * scene.fluxes()[scene.owner] / flux, 1.0)
    return np.where(flux > 0, light_radius(scene.kind, outside), 0.0) * major_axes(scene)


def major_axes(scene: Scene) -> np.ndarray:
    """Return the half-light radius of each component along its major axis, pixels."""
    squares = (scene.matrix**2).sum(axis=(1, 2))
    area = np.linalg.det(scene.matrix)
    return np.sqrt((squares + np.sqrt(np.maximum(squares**2 - 4 * area**2, 0))) / 2)
