"""Drizzling one exposure at a time onto a tile: the square kernel of the `drizzle` package, exposures streamed."""

from __future__ import annotations

import itertools
from collections.abc import Iterable
from dataclasses import dataclass

import numpy as np
from astropy.wcs import WCS
from drizzle.resample import Drizzle
from scipy.interpolate import RectBivariateSpline

GRID = 64
"""Pixels between the points at which the map between two WCSs is computed exactly."""
STRIP = 512
"""Rows of a strip, about."""
MARGIN = 4
"""Pixels around the part of an exposure that falls on a tile."""


@dataclass(frozen=True)
class Strip:
    """Some rows of the part of an exposure that falls on a tile."""

    rows: slice
    columns: slice


def strips(source: WCS, shape: tuple[int, int], target: WCS, target_shape: tuple[int, int]) -> list[Strip]:
    """Return the part of a source image that may fall on a target image, in strips of rows; empty where none does.

    Strips bound the memory of the map between the two images, 16 bytes a pixel.
    """
    ys, xs = (np.unique(np.r_[np.arange(0, n - 1, GRID), n - 1]) for n in shape)
    x, y = _through(source, target, *np.meshgrid(xs, ys))
    ny, nx = target_shape
    on = (x > -MARGIN) & (x < nx + MARGIN) & (y > -MARGIN) & (y < ny + MARGIN)
    # a target smaller than the grid's step may lie between its points: find it from its own side too
    edge = np.linspace(-0.5, 1, 9)
    back = _through(target, source, *(axis.ravel() for axis in np.meshgrid(edge * nx, edge * ny)))
    inside = (back[0] > -0.5) & (back[0] < shape[1] - 0.5) & (back[1] > -0.5) & (back[1] < shape[0] - 0.5)
    if not on.any() and not inside.any():
        return []
    u = np.concatenate([np.broadcast_to(xs, on.shape)[on], back[0][inside]])
    v = np.concatenate([np.broadcast_to(ys[:, None], on.shape)[on], back[1][inside]])
    columns, rows = _bounds(u, shape[1]), _bounds(v, shape[0])
    # of like height: the package refuses a map of a single row
    edges = np.linspace(rows.start, rows.stop, max(1, round((rows.stop - rows.start) / STRIP)) + 1).astype(int).tolist()
    return [Strip(slice(low, high), columns) for low, high in itertools.pairwise(edges)]


def pixel_map(source: WCS, target: WCS, rows: slice, columns: slice) -> np.ndarray:
    """Return where the pixels of a part of the source fall on the target, (ny, nx, 2), 0 at the first pixel's centre.

    The map is computed through both WCSs on a grid of every 64th pixel and interpolated by cubic splines: for Roman's
    fourth-order distortion the largest error over an SCA is below 1e-5 tile pixels.
    """
    ys, xs = (_knots(part) for part in (rows, columns))
    x, y = _through(source, target, *np.meshgrid(xs, ys))
    pixmap = np.empty((rows.stop - rows.start, columns.stop - columns.start, 2))
    order = [min(3, len(axis) - 1) for axis in (ys, xs)]
    at = np.arange(rows.start, rows.stop), np.arange(columns.start, columns.stop)
    for plane, values in enumerate((x, y)):
        pixmap[..., plane] = RectBivariateSpline(ys, xs, values, kx=order[0], ky=order[1], s=0)(*at)
    return pixmap


class Sums:
    """The running weighted sums of images drizzled onto one grid; all images of an exposure share map and weight."""

    def __init__(self, shape: tuple[int, int], planes: int, pixfrac: float):
        self._drizzles = [
            Drizzle(kernel="square", fillval="0", out_shape=shape, disable_ctx=True) for _ in range(planes)
        ]
        self._pixfrac = pixfrac
        self.count = np.zeros(shape, np.uint8)
        """Number of exposures that contribute to each pixel."""

    def add(self, parts: Iterable[tuple[list[np.ndarray], np.ndarray, np.ndarray]]) -> None:
        """Add one exposure in strips of (images in surface brightness, weight, map); weight 0 where a pixel is bad."""
        before = self.weight.copy()
        for images, weight, pixmap in parts:
            for drizzle, image in zip(self._drizzles, images, strict=True):
                drizzle.add_image(
                    image, exptime=1.0, pixmap=pixmap, weight_map=weight, pixfrac=self._pixfrac, in_units="cps"
                )
        self.count += self.weight > before

    @property
    def weight(self) -> np.ndarray:
        """Sum of weights, (ny, nx) float32."""
        return self._drizzles[0].out_wht

    def image(self, plane: int) -> np.ndarray:
        """Weighted mean of a plane; 0 where nothing falls."""
        return np.where(self.weight > 0, self._drizzles[plane].out_img, 0).astype(np.float32)


def _through(source: WCS, target: WCS, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    shape = x.shape
    ra, dec = source.all_pix2world(x.ravel(), y.ravel(), 0)
    tx, ty = target.all_world2pix(ra, dec, 0, quiet=True)
    return tx.reshape(shape), ty.reshape(shape)


def _bounds(values: np.ndarray, length: int) -> slice:
    low, high = np.nanmin(values), np.nanmax(values)
    return slice(max(0, int(low) - GRID - MARGIN), min(length, int(high) + GRID + MARGIN + 1))


def _knots(part: slice) -> np.ndarray:
    """Return at least four points, the least of a cubic, over some rows or columns; beyond them where they are few."""
    count = max(4, (part.stop - part.start) // GRID + 2)
    return np.linspace(part.start, max(part.stop - 1, part.start + 3), count)
