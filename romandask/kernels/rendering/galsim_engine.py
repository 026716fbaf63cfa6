"""Reference renderer: GalSim draws one object at a time by FFT; slow, but independent of the Fourier renderer."""

from __future__ import annotations

from collections.abc import Callable

import galsim
import numpy as np

from romandask.kernels.rendering.fourier import DEVAUCOULEURS, EXPONENTIAL, KNOTS, knot_offset
from romandask.kernels.rendering.stamps import Scene, Stamps

Cell = tuple[int, int]
"""Column and row of a cell of the detector; all objects in a cell are drawn with the same PSFs."""
_BORDER = 96
"""Pixels that are drawn around a stamp, at least, and cut off."""
MIN_FLUX_FRACTION = 1e-9
"""Components with a smaller fraction of the flux of an object are not drawn."""


def draw_objects(
    scene: Scene,
    psfs: Callable[[float, float], tuple[Cell, list[galsim.GSObject]]],
    shape: tuple[int, int],
    stamps: Stamps,
    pixel_scale: float,
) -> np.ndarray:
    """Return the image of a scene.

    Parameters
    ----------
    scene : Scene
        Objects.
    psfs : callable
        Function of a pixel position x, y that returns the cell of the position and the PSFs of the cell, in arcsec, one
        per node.
    shape : (int, int)
        Shape of the image (ny, nx).
    stamps : Stamps
        Sizes of the stamps; objects of size 0 are not drawn. Light outside the stamps is added by `add_wings`.
    pixel_scale : float, arcsec
        Pixel scale.

    Returns
    -------
    float32 array, shape (ny, nx), electrons
        Image.
    """
    image = galsim.ImageD(shape[1], shape[0], xmin=0, ymin=0, scale=1.0)
    cells = [psfs(x, y)[0] if size else None for x, y, size in zip(scene.x, scene.y, stamps.size, strict=True)]
    first = np.searchsorted(scene.owner, np.arange(len(scene.x) + 1))
    # sorted by cell, because the PSFs of a cell are expensive
    for n in sorted(np.flatnonzero(stamps.size).tolist(), key=lambda n: (cells[n], n)):
        _, nodes = psfs(scene.x[n], scene.y[n])
        profile = object_profile(scene, n, first, [psf.dilate(1 / pixel_scale) for psf in nodes])
        size = int(stamps.size[n])
        x0, y0 = int(np.floor(scene.x[n])) - size // 2, int(np.floor(scene.y[n])) - size // 2
        bounds = galsim.BoundsI(x0, x0 + size - 1, y0, y0 + size - 1)
        # GalSim folds what lies beyond the edge of a drawn image into the image
        stamp = profile.drawImage(
            bounds=bounds.withBorder(max(size // 2, _BORDER)),
            scale=1.0,
            center=galsim.PositionD(scene.x[n], scene.y[n]),
            dtype=float,
        )
        part = bounds & image.bounds
        if part.isDefined():
            image[part] += stamp[part]
    return image.array.astype(np.float32)


def object_profile(scene: Scene, n: int, first: np.ndarray, psfs: list[galsim.GSObject]) -> galsim.GSObject:
    """Return the GalSim profile of an object in pixels, convolved with the PSF.

    Parameters
    ----------
    scene : Scene
        Objects.
    n : int
        Index of the object.
    first : int array, shape (objects + 1,)
        Index of the first component of each object.
    psfs : list of galsim.GSObject
        PSF at each node, in pixels.
    """
    total = scene.photons[first[n] : first[n + 1]].sum()
    parts = []
    for c in range(first[n], first[n + 1]):
        if scene.photons[c].sum() <= MIN_FLUX_FRACTION * total:
            continue
        psf = galsim.Sum([node_psf * flux for node_psf, flux in zip(psfs, scene.photons[c], strict=True)])
        source = component_profile(scene, n, c)
        parts.append(psf if source is None else galsim.Convolve(source, psf))
    return galsim.Sum(parts)


def component_profile(scene: Scene, n: int, c: int) -> galsim.GSObject | None:
    """Return the profile of component `c` of object `n`, of flux 1, in pixels; None for a point."""
    matrix = scene.matrix[c]
    if scene.kind[c] == EXPONENTIAL:
        return _transformed(galsim.Exponential(half_light_radius=1.0), matrix)
    if scene.kind[c] == DEVAUCOULEURS:
        return _transformed(galsim.DeVaucouleurs(half_light_radius=1.0), matrix)
    if scene.kind[c] == KNOTS:
        count = int(scene.knots[c])
        smooth = scene.smoothing[c].any()
        knot = _transformed(galsim.Gaussian(sigma=1.0), scene.smoothing[c]) if smooth else galsim.DeltaFunction()
        offsets = [matrix @ np.array(knot_offset(scene.key[n], k)) for k in range(count)]
        return galsim.Sum([knot.shift(*offset) / count for offset in offsets])
    return None


def _transformed(profile: galsim.GSObject, matrix: np.ndarray) -> galsim.GSObject:
    """Return a profile after a linear map, with flux 1."""
    return profile.transform(*matrix.ravel()).withFlux(1.0)
