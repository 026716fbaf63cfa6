"""The second renderer: GalSim draws object by object, by FFT; slow, independent of the first, and its oracle."""

from __future__ import annotations

from collections.abc import Callable

import galsim
import numpy as np

from romandask.kernels.rendering.draw import Scene, Stamps
from romandask.kernels.rendering.fourier import DEVAUCOULEURS, EXPONENTIAL, KNOTS, knot_offset

Place = tuple[int, int]
LEAST_SHARE = 1e-9
"""A component with a smaller share of an object's light is not drawn."""


def draw_objects(
    scene: Scene,
    psfs: Callable[[float, float], tuple[Place, list[galsim.GSObject]]],
    shape: tuple[int, int],
    stamps: Stamps,
    pixel_scale: float,
) -> np.ndarray:
    """Return the image (float32, electrons) of a scene.

    Parameters
    ----------
    psfs : gives for a pixel position the place whose PSFs are used there, and these PSFs (arcsec), one a node
    shape : (ny, nx)
    stamps : sizes of the stamps; those of objects that are not drawn are 0
    pixel_scale : arcsec
    """
    image = galsim.ImageD(shape[1], shape[0], xmin=0, ymin=0, scale=1.0)
    places = [psfs(x, y)[0] if size else None for x, y, size in zip(scene.x, scene.y, stamps.size, strict=True)]
    first = np.searchsorted(scene.owner, np.arange(len(scene.x) + 1))
    # by place, for a place's PSFs are costly
    for n in sorted(np.flatnonzero(stamps.size), key=lambda n: (places[n], n)):
        _, nodes = psfs(scene.x[n], scene.y[n])
        profile = object_profile(scene, n, first, [psf.dilate(1 / pixel_scale) for psf in nodes])
        size = int(stamps.size[n])
        x0, y0 = int(np.floor(scene.x[n])) - size // 2, int(np.floor(scene.y[n])) - size // 2
        bounds = galsim.BoundsI(x0, x0 + size - 1, y0, y0 + size - 1)
        stamp = profile.drawImage(
            bounds=bounds, scale=1.0, center=galsim.PositionD(scene.x[n], scene.y[n]), dtype=float
        )
        part = bounds & image.bounds
        if part.isDefined():
            image[part] += stamp[part]
    return image.array.astype(np.float32)


def object_profile(scene: Scene, n: int, first: np.ndarray, psfs: list[galsim.GSObject]) -> galsim.GSObject:
    """Return one object as GalSim's profile in pixels, convolved with the PSFs (pixels), one a node.

    Parameters
    ----------
    first : (n + 1,) number of the first component of each object
    """
    total = scene.photons[first[n] : first[n + 1]].sum()
    parts = []
    for c in range(first[n], first[n + 1]):
        if scene.photons[c].sum() <= LEAST_SHARE * total:
            continue
        psf = galsim.Sum([one * flux for one, flux in zip(psfs, scene.photons[c], strict=True)])
        source = component_profile(scene, n, c)
        parts.append(psf if source is None else galsim.Convolve(source, psf))
    return galsim.Sum(parts)


def component_profile(scene: Scene, n: int, c: int) -> galsim.GSObject | None:
    """Return the profile of one component, of unit flux, in pixels; None for a point."""
    matrix = scene.matrix[c]
    if scene.kind[c] == EXPONENTIAL:
        return _transformed(galsim.Exponential(half_light_radius=1.0), matrix)
    if scene.kind[c] == DEVAUCOULEURS:
        return _transformed(galsim.DeVaucouleurs(half_light_radius=1.0), matrix)
    if scene.kind[c] == KNOTS:
        count = int(scene.knots[c])
        smooth = scene.smoothing[c].any()
        spot = _transformed(galsim.Gaussian(sigma=1.0), scene.smoothing[c]) if smooth else galsim.DeltaFunction()
        offsets = [matrix @ np.array(knot_offset(scene.key[n], k)) for k in range(count)]
        return galsim.Sum([spot.shift(*offset) / count for offset in offsets])
    return None


def _transformed(profile: galsim.GSObject, matrix: np.ndarray) -> galsim.GSObject:
    return profile.transform(*matrix.ravel()).withFlux(1.0)
