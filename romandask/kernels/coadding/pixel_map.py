"""Maps between the pixels of an exposure and of a tile: exact on a coarse grid, cubic splines in between."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from astropy.wcs import WCS
from scipy.interpolate import CubicSpline

GRID_STEP = 64
"""Distance between the grid points at which the map between two WCSs is computed exactly, pixels."""
STRIP_ROWS = 512
"""Approximate number of rows of a strip."""
MARGIN = 4
"""Margin around the part of an exposure that falls on a tile, pixels."""


@dataclass(frozen=True)
class Strip:
    """A strip of rows of the part of an exposure that falls on a tile."""

    rows: slice
    columns: slice


@dataclass(frozen=True)
class PixelMap:
    """Positions on a target image of the pixels of a part of a source image.

    Positions on both images are in pixels, 0 at the centre of the first pixel. They are exact at the knots and
    interpolated with cubic splines in between: for Roman's fourth-order distortion, the largest error over an SCA is
    below 1e-5 tile pixels.
    """

    rows: slice
    """Rows of the part of the source."""
    columns: slice
    """Columns of the part of the source."""
    y: np.ndarray
    """Source rows of the knots, (m,)."""
    x: np.ndarray
    """Source columns of the knots, (n,)."""
    positions: np.ndarray
    """x and y of the knots on the target, (2, m, n)."""

    @property
    def shape(self) -> tuple[int, int]:
        """Rows and columns of the part."""
        return self.rows.stop - self.rows.start, self.columns.stop - self.columns.start

    def curves(self, rows: np.ndarray) -> np.ndarray:
        """Return cubic polynomials, along some source rows, of the positions on the target.

        Parameters
        ----------
        rows : ndarray, shape (k,)
            Source rows; they need not be whole numbers.

        Returns
        -------
        ndarray, shape (k, 2, n - 1, 4)
            Coefficients for each row, for x and y, and for each interval between two knots. The highest power comes
            first; the variable is the distance from the first knot of the interval, in columns.
        """
        along = CubicSpline(self.y, self.positions, axis=1)(rows)
        return np.ascontiguousarray(np.moveaxis(CubicSpline(self.x, along, axis=2).c, (0, 1, 2, 3), (3, 2, 1, 0)))

    def at(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the positions on the target, (k, 2), of the source pixels at some rows and columns, (k,)."""
        unique, row = np.unique(rows, return_inverse=True)
        piece = np.clip(np.searchsorted(self.x, columns, "right") - 1, 0, len(self.x) - 2)
        curve = self.curves(unique)[row, :, piece]
        step = (columns - self.x[piece])[:, None]
        return ((curve[..., 0] * step + curve[..., 1]) * step + curve[..., 2]) * step + curve[..., 3]

    def dense(self) -> np.ndarray:
        """Return the positions on the target, (ny, nx, 2), of all pixels of the part."""
        columns = np.arange(self.columns.start, self.columns.stop)
        along = CubicSpline(self.y, self.positions, axis=1)(np.arange(self.rows.start, self.rows.stop))
        return np.moveaxis(CubicSpline(self.x, along, axis=2)(columns), 0, -1)


def strips(source: WCS, shape: tuple[int, int], target: WCS, target_shape: tuple[int, int]) -> list[Strip]:
    """Return the part of a source image that may fall on a target image, divided into strips of rows.

    Strips limit the memory of what is computed for each pixel.

    Parameters
    ----------
    source, target : WCS
    shape, target_shape : tuple of int
        Rows and columns of the source and of the target.

    Returns
    -------
    list of Strip
        Empty if no pixel of the source falls on the target.
    """
    ys, xs = (np.unique(np.r_[np.arange(0, n - 1, GRID_STEP), n - 1]) for n in shape)
    x, y = _transform(source, target, *np.meshgrid(xs, ys))
    ny, nx = target_shape
    on = (x > -MARGIN) & (x < nx + MARGIN) & (y > -MARGIN) & (y < ny + MARGIN)
    # a target smaller than the grid step may lie between grid points: map its own area back onto the source too
    edge = np.linspace(-0.5, 1, 9)
    back = _transform(target, source, *(axis.ravel() for axis in np.meshgrid(edge * nx, edge * ny)))
    inside = (back[0] > -0.5) & (back[0] < shape[1] - 0.5) & (back[1] > -0.5) & (back[1] < shape[0] - 0.5)
    if not on.any() and not inside.any():
        return []
    u = np.concatenate([np.broadcast_to(xs, on.shape)[on], back[0][inside]])
    v = np.concatenate([np.broadcast_to(ys[:, None], on.shape)[on], back[1][inside]])
    columns, rows = _bounds(u, shape[1]), _bounds(v, shape[0])
    edges = (
        np.linspace(rows.start, rows.stop, max(1, round((rows.stop - rows.start) / STRIP_ROWS)) + 1)
        .astype(int)
        .tolist()
    )
    return [Strip(slice(low, high), columns) for low, high in itertools.pairwise(edges)]


def pixel_map(source: WCS, target: WCS, rows: slice, columns: slice) -> PixelMap:
    """Return the map of a part of the source onto the target, computed through both WCSs about every 64 pixels."""
    y, x = (_knots(pixels) for pixels in (rows, columns))
    return PixelMap(rows, columns, y, x, np.stack(_transform(source, target, *np.meshgrid(x, y))))


def _transform(source: WCS, target: WCS, x: np.ndarray, y: np.ndarray) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y on the target of positions on the source."""
    shape = x.shape
    ra, dec = source.all_pix2world(x.ravel(), y.ravel(), 0)
    tx, ty = target.all_world2pix(ra, dec, 0, quiet=True)
    return tx.reshape(shape), ty.reshape(shape)


def _bounds(values: np.ndarray, length: int) -> slice:
    """Return the range of some pixel positions, widened by a grid step and the margin, within 0 to `length`."""
    low, high = np.nanmin(values), np.nanmax(values)
    return slice(max(0, int(low) - GRID_STEP - MARGIN), min(length, int(high) + GRID_STEP + MARGIN + 1))


def _knots(pixels: slice) -> np.ndarray:
    """Return evenly spaced knots over some rows or columns.

    There are at least four, as a cubic needs; they extend beyond the last pixel if there are fewer than four pixels.
    """
    count = max(4, (pixels.stop - pixels.start) // GRID_STEP + 2)
    return np.linspace(pixels.start, max(pixels.stop - 1, pixels.start + 3), count)
