"""Light of the objects of a scene outside their stamps."""

from __future__ import annotations

import numpy as np

from romandask.kernels.rendering.profiles import profile_tables
from romandask.kernels.rendering.pyramid import Pyramid, add_galaxy_pixels, pyramid
from romandask.kernels.rendering.rings import Rings
from romandask.kernels.rendering.stamps import Scene, Stamps


def add_wings(
    image: np.ndarray,
    scene: Scene,
    radii: tuple[np.ndarray, np.ndarray],
    rings: Rings,
    stamps: Stamps,
    missing: np.ndarray | None = None,
    ends: np.ndarray | None = None,
) -> None:
    """Add the light of objects outside their stamps to an image.

    Parameters
    ----------
    image : float32 array, shape (ny, nx), electrons
        Image; modified in place.
    scene : Scene
        Objects.
    radii : (array, array), shape (components,), pixels
        Radii of the components, as `component_extents` returns them, and radii within which they are bright. There the
        light of galaxies is added pixel by pixel.
    rings : Rings
        Rings of the PSF.
    stamps : Stamps
        Stamps of the objects.
    missing : array, shape (n,), electrons, optional
        Light that the PSF scatters out of the stamp of each object; by default, and where NaN, that of `rings`.
    ends : int array, shape (n,), pixels, optional
        Side of the PSF of each object with a bright-star PSF; by default that of the stamp.
    """
    grids = pyramid(image.shape)
    missing = np.full(len(scene.x), np.nan) if missing is None else missing
    ends = stamps.inside if ends is None else ends
    lit = np.flatnonzero(stamps.inside)
    photons = np.stack([np.bincount(scene.owner, node, minlength=len(scene.x))[lit] for node in scene.photons.T], 1)
    x, y, missing, side = scene.x[lit], scene.y[lit], missing[lit], stamps.inside[lit]
    light = rings.outside(photons, side)
    total = light.sum(axis=1)
    has_rings = total > 1e-6 * photons.sum(axis=1)
    factor = np.where(np.isnan(missing), 1.0, missing / np.where(has_rings, total, 1.0))
    beside = has_rings & (stamps.bright[lit] < 0)
    grids.add_points(x[beside], y[beside], light[beside] * factor[beside, None], rings)
    cut = (stamps.bright[lit] >= 0) & (side < ends[lit]) & ~np.isnan(missing)
    grids.add_power_laws(x[cut], y[cut], missing[cut], side[cut], ends[lit][cut])
    scattered = np.zeros(len(scene.x))
    scattered[lit] = total * factor / photons.sum(axis=1)
    _add_galaxy_wings(image, grids, scene, radii, stamps, scattered)
    grids.add_to(image)


def _add_galaxy_wings(
    image: np.ndarray,
    grids: Pyramid,
    scene: Scene,
    radii: tuple[np.ndarray, np.ndarray],
    stamps: Stamps,
    scattered: np.ndarray,
) -> None:
    """Add the light of galaxies outside their stamps, to an image where it is bright, to grids elsewhere.

    `scattered` is the fraction of the light of each object that the PSF scatters out of the stamp, shape (n,); it is
    added as that of a point.
    """
    (extent, bright_radius), side = radii, stamps.inside[scene.owner]
    used = np.flatnonzero((side > 0) & (extent > side / 2))
    owner, light = scene.owner[used], scene.photons[used].sum(axis=1) * (1 - scattered[scene.owner[used]])
    side, x, y, kind, matrix = side[used], scene.x[owner], scene.y[owner], scene.kind[used], scene.matrix[used]
    bright_radius = bright_radius[used]
    start = side.copy()
    for n in np.flatnonzero(bright_radius > side / 2):
        start[n] = 1 << int(np.ceil(np.log2(2 * bright_radius[n])))
        corner = int(np.floor(x[n])) - side[n] // 2, int(np.floor(y[n])) - side[n] // 2
        add_galaxy_pixels(image, x[n], y[n], kind[n], matrix[n], light[n], start[n], *corner, side[n], profile_tables())
    grids.add_galaxies(x, y, kind, matrix, light, start, extent[used])
