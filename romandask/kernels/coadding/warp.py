"""Images resampled onto a tile by Lanczos interpolation, and the weighted mean of many of them."""

from __future__ import annotations

import numba
import numpy as np

from romandask.kernels.coadding.pixel_map import PixelMap

REACH = 3
"""Half the width of the interpolation, pixels."""
ROWS = 64
"""Rows of the tile that are made at a time."""
_TABLE = 4096
"""Places between two pixels for which weights are tabulated; between them they are interpolated linearly."""


def lanczos_weights(place: np.ndarray) -> np.ndarray:
    """Return weights (n, 2 REACH), of sum 1, of the pixels around places (n,), 0 to 1 between the two in the middle."""
    t = place[:, None] - np.arange(1 - REACH, REACH + 1)
    found = np.sinc(t) * np.sinc(t / REACH)
    return found / found.sum(axis=1, keepdims=True)


_WEIGHTS = lanczos_weights(np.arange(_TABLE + 1) / _TABLE).astype(np.float32)


class Means:
    """Weighted means of images that are warped onto one tile."""

    def __init__(self, shape: tuple[int, int], planes: int):
        self.sums = np.zeros((planes, *shape), np.float32)
        self.weight = np.zeros(shape, np.float32)
        self.count = np.zeros(shape, np.uint16)
        self.marks = np.zeros(shape, bool)

    def add(
        self, planes: np.ndarray, bad: np.ndarray, marked: np.ndarray, weight: float, onto: PixelMap, corner: tuple
    ) -> int:
        """Add a part of an exposure; return how many pixels of the tile it is added to.

        A pixel of the tile is made of 6 x 6 of the exposure: of bad ones, or beyond the part, none is made.

        Parameters
        ----------
        planes : (planes, ny, nx) float32, flux density on the sky
        bad : (ny, nx) True for pixels that are not to be used
        marked : (ny, nx) True for pixels whose neighbourhood on the tile is to be marked
        weight : of the exposure
        onto : the map from the tile, its source, to the exposure, its target
        corner : row and column of the part's first pixel on the exposure
        """
        covered = 0
        for first in range(onto.rows.start, onto.rows.stop, ROWS):
            rows = np.arange(first, min(first + ROWS, onto.rows.stop))
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
                *corner,
                _WEIGHTS,
            )
        return covered

    def means(self) -> np.ndarray:
        """Turn the sums to means, 0 where there is no weight; return them (planes, ny, nx)."""
        for plane in self.sums:
            np.divide(plane, self.weight, out=plane, where=self.weight > 0)
        return self.sums


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _add(sums, total, count, marks, rows, left, right, knots, curves, planes, bad, marked, weight, top, side, table):
    ny, nx = bad.shape
    width = 2 * REACH
    wx, wy = np.empty(width, np.float32), np.empty(width, np.float32)
    covered = 0
    for r in range(len(rows)):
        piece = 0
        for column in range(left, right):
            while piece < len(knots) - 2 and column >= knots[piece + 1]:
                piece += 1
            step = column - knots[piece]
            a, b = curves[r, 0, piece], curves[r, 1, piece]
            x = ((a[0] * step + a[1]) * step + a[2]) * step + a[3] - side
            y = ((b[0] * step + b[1]) * step + b[2]) * step + b[3] - top
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
            _taps(x - i, table, wx)
            _taps(y - j, table, wy)
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
def _taps(place, table, out):
    at = place * _TABLE
    k = min(int(at), _TABLE - 1)
    rest = np.float32(at - k)
    for n in range(len(out)):
        out[n] = table[k, n] + rest * (table[k + 1, n] - table[k, n])
