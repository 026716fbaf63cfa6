"""Maps between the pixels of an exposure and of a tile: exact on a coarse grid, cubic splines in between."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from astropy.wcs import WCS
from scipy.interpolate import CubicSpline, PPoly

GRID_STEP = 64
"""Distance between the grid points at which the map between two WCSs is computed exactly, pixels."""
STRIP_ROWS = 512
"""Number of rows of a strip. Strips begin at multiples of it, wherever the part of the source begins."""
MARGIN = 4
"""Margin around a window of a target, target pixels; it covers the curvature of the map between two knots."""


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

    def part(self, rows: slice, columns: slice) -> PixelMap:
        """Return the same map for a part of its pixels: the same positions, to the last bit."""
        part = replace(self, rows=rows, columns=columns)
        # the splines are those of the whole map
        part.__dict__["_splines"] = self._splines
        return part

    @cached_property
    def _splines(self) -> CubicSpline:
        """Splines along y of the coefficients of splines along x, of shape (powers, pieces, 2)."""
        return CubicSpline(self.y, np.moveaxis(CubicSpline(self.x, self.positions, axis=2).c, 3, 0), axis=0)

    @property
    def pieces(self) -> slice:
        """Intervals between two knots that the columns of the part lie in."""
        first = int(np.searchsorted(self.x, self.columns.start, "right")) - 1
        last = int(np.searchsorted(self.x, self.columns.stop - 1, "right"))
        return slice(max(first, 0), max(min(last, len(self.x) - 1), first + 1, 1))

    def curves(self, rows: np.ndarray) -> np.ndarray:
        """Return cubic polynomials, along some source rows, of the positions on the target.

        The polynomials of a row do not depend on which other rows and columns are requested.

        Parameters
        ----------
        rows : ndarray, shape (k,)
            Source rows; they need not be whole numbers.

        Returns
        -------
        ndarray, shape (k, 2, pieces, 4)
            Coefficients for each row, for x and y, and for each interval of `pieces`. The highest power comes first;
            the variable is the distance from the first knot of the interval, in columns.
        """
        splines = PPoly.construct_fast(self._splines.c[:, :, :, self.pieces], self.y)
        return np.ascontiguousarray(np.transpose(splines(rows), (0, 3, 2, 1)))

    def at(self, rows: np.ndarray, columns: np.ndarray) -> np.ndarray:
        """Return the positions on the target, (k, 2), of the source pixels at some rows and columns, (k,)."""
        unique, row = np.unique(rows, return_inverse=True)
        first, stop = self.pieces.start, self.pieces.stop
        piece = np.clip(np.searchsorted(self.x, columns, "right") - 1, first, stop - 1)
        curve = self.curves(unique)[row, :, piece - first]
        step = (columns - self.x[piece])[:, None]
        return ((curve[..., 0] * step + curve[..., 1]) * step + curve[..., 2]) * step + curve[..., 3]

    def dense(self) -> np.ndarray:
        """Return the positions on the target, (ny, nx, 2), of all pixels of the part."""
        columns = np.arange(self.columns.start, self.columns.stop)
        along = CubicSpline(self.y, self.positions, axis=1)(np.arange(self.rows.start, self.rows.stop))
        return np.moveaxis(CubicSpline(self.x, along, axis=2)(columns), 0, -1)


def strips(onto: PixelMap, window: tuple[slice, slice]) -> list[Strip]:
    """Return the part of a source image that may fall on a window of a target image, divided into strips of rows.

    Strips limit the memory of what is computed for each pixel. They begin at multiples of STRIP_ROWS, so that pixels
    are visited in the same order whatever the window is, and each has the columns that may fall on the window.

    Parameters
    ----------
    onto : PixelMap
        Map of the source onto the target.
    window : (slice, slice)
        Rows and columns of the target.

    Returns
    -------
    list of Strip
        Empty if no pixel of the source falls on the window.
    """
    m, n = onto.positions.shape[1:]
    corners = np.stack([onto.positions[:, i : m - 1 + i, k : n - 1 + k] for i in (0, 1) for k in (0, 1)])
    low, high = corners.min(axis=0) - MARGIN, corners.max(axis=0) + MARGIN
    rows, columns = window
    on = (high[0] > columns.start) & (low[0] < columns.stop) & (high[1] > rows.start) & (low[1] < rows.stop)
    found = []
    for first in range(onto.rows.start // STRIP_ROWS * STRIP_ROWS, onto.rows.stop, STRIP_ROWS):
        own = on & (onto.y[1:, None] >= first) & (onto.y[:-1, None] <= first + STRIP_ROWS)
        across, along = np.flatnonzero(own.any(axis=1)), np.flatnonzero(own.any(axis=0))
        if len(across):
            inside = _between(onto.y, across, max(first, onto.rows.start), min(first + STRIP_ROWS, onto.rows.stop))
            part = _between(onto.x, along, onto.columns.start, onto.columns.stop)
            if inside.start < inside.stop and part.start < part.stop:
                found.append(Strip(inside, part))
    return found


def bounds(parts: Sequence[Strip]) -> tuple[slice, slice]:
    """Return the rows and columns that some strips lie in."""
    return (
        slice(parts[0].rows.start, parts[-1].rows.stop),
        slice(min(part.columns.start for part in parts), max(part.columns.stop for part in parts)),
    )


def _between(knots: np.ndarray, pieces: np.ndarray, start: int, stop: int) -> slice:
    """Return the pixels from `start` to `stop` that lie in some intervals between knots, and those next to them."""
    return slice(max(int(np.floor(knots[pieces[0]])) - 1, start), min(int(np.ceil(knots[pieces[-1] + 1])) + 2, stop))


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


def _knots(pixels: slice) -> np.ndarray:
    """Return evenly spaced knots over some rows or columns.

    There are at least four, as a cubic needs; they extend beyond the last pixel if there are fewer than four pixels.
    """
    count = max(4, (pixels.stop - pixels.start) // GRID_STEP + 2)
    return np.linspace(pixels.start, max(pixels.stop - 1, pixels.start + 3), count)
