"""Where the pixels of an exposure fall on a tile: exact on a coarse grid, cubic splines between."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from astropy.wcs import WCS
from scipy.interpolate import CubicSpline

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


@dataclass(frozen=True)
class PixelMap:
    """Places on a target of a part of a source image, both 0 at the first pixel's centre.

    Through exact places at the knots go cubic splines: for Roman's fourth-order distortion the largest error over an
    SCA is below 1e-5 tile pixels.
    """

    rows: slice
    columns: slice
    y: np.ndarray
    """(m,) knots, source rows."""
    x: np.ndarray
    """(n,) knots, source columns."""
    places: np.ndarray
    """(2, m, n) x and y on the target."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the part."""
        return self.rows.stop - self.rows.start, self.columns.stop - self.columns.start

    def curves(self, rows: np.ndarray) -> np.ndarray:
        """Return, for source rows (k,) or parts of them, cubic polynomials along them: (k, 2, n - 1, 4).

        Highest power first, of the columns beyond each knot.
        """
        along = CubicSpline(self.y, self.places, axis=1)(rows)
        return np.ascontiguousarray(np.moveaxis(CubicSpline(self.x, along, axis=2).c, (0, 1, 2, 3), (3, 2, 1, 0)))

    def at(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the places (k, 2) of some pixels (k,)."""
        unique, row = np.unique(rows, return_inverse=True)
        piece = np.clip(np.searchsorted(self.x, columns, "right") - 1, 0, len(self.x) - 2)
        curve = self.curves(unique)[row, :, piece]
        step = (columns - self.x[piece])[:, None]
        return ((curve[..., 0] * step + curve[..., 1]) * step + curve[..., 2]) * step + curve[..., 3]

    def dense(self) -> np.ndarray:
        """Return the places of all pixels, (ny, nx, 2)."""
        columns = np.arange(self.columns.start, self.columns.stop)
        along = CubicSpline(self.y, self.places, axis=1)(np.arange(self.rows.start, self.rows.stop))
        return np.moveaxis(CubicSpline(self.x, along, axis=2)(columns), 0, -1)


def strips(source: WCS, shape: tuple[int, int], target: WCS, target_shape: tuple[int, int]) -> list[Strip]:
    """Return the part of a source image that may fall on a target image, in strips of rows; empty where none does.

    Strips bound the memory of what is worked out for each pixel.
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
    edges = np.linspace(rows.start, rows.stop, max(1, round((rows.stop - rows.start) / STRIP)) + 1).astype(int).tolist()
    return [Strip(slice(low, high), columns) for low, high in itertools.pairwise(edges)]


def pixel_map(source: WCS, target: WCS, rows: slice, columns: slice) -> PixelMap:
    """Return the map of a part of the source onto the target, computed through both WCSs every 64 pixels."""
    y, x = (_knots(part) for part in (rows, columns))
    return PixelMap(rows, columns, y, x, np.stack(_through(source, target, *np.meshgrid(x, y))))


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
