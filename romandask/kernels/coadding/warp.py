"""Lanczos interpolation of images onto a tile, and the weighted mean of the interpolated images."""

from __future__ import annotations

import numba
import numpy as np

from romandask.kernels.coadding.pixel_map import PixelMap

REACH = 3
"""Half the width of the interpolation kernel, pixels."""
ROWS_PER_BLOCK = 64
"""Rows of the tile that are interpolated at a time."""
_TABLE_STEPS = 4096
"""Steps of the weight table between two neighbouring pixels; between steps, weights are interpolated linearly."""


def lanczos_weights(fraction: np.ndarray) -> np.ndarray:
    """Return the Lanczos weights of the pixels around some positions, normalised to a sum of 1.

    Parameters
    ----------
    fraction : ndarray, shape (n,), pixels, 0 to 1
        Distance of each position from the left one of the two pixels in the middle of the kernel.

    Returns
    -------
    ndarray, shape (n, 2 * REACH)
    """
    t = fraction[:, None] - np.arange(1 - REACH, REACH + 1)
    weights = np.sinc(t) * np.sinc(t / REACH)
    return weights / weights.sum(axis=1, keepdims=True)


_WEIGHTS = lanczos_weights(np.arange(_TABLE_STEPS + 1) / _TABLE_STEPS).astype(np.float32)


class Means:
    """Running weighted sums of exposures interpolated onto one tile, and their means.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the tile.
    planes : int
        Number of planes of each exposure.
    """

    def __init__(self, shape: tuple[int, int], planes: int):
        self.sums = np.zeros((planes, *shape), np.float32)
        """Weighted sums of the planes, (planes, ny, nx)."""
        self.weight = np.zeros(shape, np.float32)
        """Sum of the weights, (ny, nx)."""
        self.count = np.zeros(shape, np.uint16)
        """Number of exposures that contribute to each pixel, (ny, nx)."""
        self.marks = np.zeros(shape, bool)
        """True where an exposure was left out because of a bad pixel that is also marked, (ny, nx)."""

    def add(
        self,
        planes: np.ndarray,
        bad: np.ndarray,
        marked: np.ndarray,
        weight: float,
        onto: PixelMap,
        corner: tuple[int, int],
    ) -> int:
        """Add a part of an exposure.

        A pixel of the tile is interpolated from 6 x 6 pixels of the exposure. The exposure does not contribute to it
        where one of these is bad or lies outside the part.

        Parameters
        ----------
        planes : ndarray, shape (planes, ny, nx), float32
            Flux per solid angle.
        bad : ndarray, shape (ny, nx), bool
            True for pixels that must not be used.
        marked : ndarray, shape (ny, nx), bool
            True for bad pixels whose neighbourhood on the tile is to be marked.
        weight : float
            Weight of the exposure.
        onto : PixelMap
            Map from the tile (its source) to the exposure (its target).
        corner : tuple of int
            Row and column, on the exposure, of the first pixel of the part.

        Returns
        -------
        int
            Number of tile pixels to which the part contributes.
        """
        covered = 0
        for first in range(onto.rows.start, onto.rows.stop, ROWS_PER_BLOCK):
            rows = np.arange(first, min(first + ROWS_PER_BLOCK, onto.rows.stop))
            covered += _add(
                self.sums,
                self.weight,
                self.count,
                self.marks,
                rows,
                onto.columns.start,
                onto.columns.stop,
                onto.x,
                onto.curves(rows),
                planes,
                bad,
                marked,
                np.float32(weight),
                corner[0],
                corner[1],
                _WEIGHTS,
            )
        return covered

    def means(self) -> np.ndarray:
        """Divide the sums by the weight, in place, and return them: (planes, ny, nx), 0 where the weight is 0."""
        for plane in self.sums:
            np.divide(plane, self.weight, out=plane, where=self.weight > 0)
        return self.sums


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _add(
    sums,
    total,
    count,
    marks,
    rows,
    first_column,
    stop_column,
    knots,
    curves,
    planes,
    bad,
    marked,
    weight,
    corner_row,
    corner_column,
    table,
):
    """Add a part of an exposure to some rows of the tile; return the number of tile pixels that it contributes to."""
    ny, nx = bad.shape
    width = 2 * REACH
    wx, wy = np.empty(width, np.float32), np.empty(width, np.float32)
    covered = 0
    for r in range(len(rows)):
        piece = 0
        for column in range(first_column, stop_column):
            while piece < len(knots) - 2 and column >= knots[piece + 1]:
                piece += 1
            step = column - knots[piece]
            a, b = curves[r, 0, piece], curves[r, 1, piece]
            x = ((a[0] * step + a[1]) * step + a[2]) * step + a[3] - corner_column
            y = ((b[0] * step + b[1]) * step + b[2]) * step + b[3] - corner_row
            i, j = int(np.floor(x)), int(np.floor(y))
            i0, j0 = i - REACH + 1, j - REACH + 1
            if i0 < 0 or j0 < 0 or i0 + width > nx or j0 + width > ny:
                continue
            good = True
            for v in range(j0, j0 + width):
                for u in range(i0, i0 + width):
                    if bad[v, u]:
                        good = False
                        if marked[v, u]:
                            marks[rows[r], column] = True
            if not good:
                continue
            _tabulated_weights(x - i, table, wx)
            _tabulated_weights(y - j, table, wy)
            for p in range(len(planes)):
                value = np.float32(0.0)
                for v in range(width):
                    line = np.float32(0.0)
                    for u in range(width):
                        line += wx[u] * planes[p, j0 + v, i0 + u]
                    value += wy[v] * line
                sums[p, rows[r], column] += weight * value
            total[rows[r], column] += weight
            count[rows[r], column] += 1
            covered += 1
    return covered


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _tabulated_weights(fraction, table, out):
    """Write the Lanczos weights of a position, interpolated linearly in the table."""
    steps = fraction * _TABLE_STEPS
    k = min(int(steps), _TABLE_STEPS - 1)
    rest = np.float32(steps - k)
    for n in range(len(out)):
        out[n] = table[k, n] + rest * (table[k + 1, n] - table[k, n])
