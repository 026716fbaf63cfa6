"""Drizzling exposures, one at a time, onto a tile: the square kernel, all planes of an exposure in one pass.

Every pixel of an exposure, shrunk by pixfrac, is a quadrilateral on the tile and gives each tile pixel its light in
proportion to the exact area of their overlap (Fruchter & Hook 2002). Areas are those that font rasterisers find: each
side adds to the cells that it crosses the signed area between itself and their right edges, and to the next cell the
rest of its height; sums along a row are then the covered shares.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numba
import numpy as np

from romandask.kernels.coadding.pixel_map import PixelMap

MOST_SETS = 65_535
"""Different sets of exposures on one tile."""
_LEAST = 1e-9
"""Share of a tile pixel below which an overlap is rounding."""


class Sums:
    """The running weighted sums of the exposures of a tile, and which exposures each of its pixels has.

    All planes of an exposure share map and weight. Sets are numbered in the order in which they first appear, from 0,
    that of no exposure.
    """

    def __init__(self, shape: tuple[int, int], planes: int, pixfrac: float):
        self._sums = tuple(np.zeros(shape, np.float32) for _ in range(planes))
        self._pixfrac = pixfrac
        self._links: list[tuple[int, int]] = [(0, -1)]
        self._exposures = 0
        self.weight = np.zeros(shape, np.float32)
        """Sum of weights, (ny, nx)."""
        self.set = np.zeros(shape, np.uint16)
        """Number of the set of exposures that contribute to each pixel."""

    def add(self, parts: Iterable[tuple[Sequence[np.ndarray], np.ndarray, PixelMap]]) -> None:
        """Add one exposure in parts of (images in surface brightness, weight, map); weight 0 where a pixel is bad."""
        first = len(self._links)
        follow = np.full(first, -1, np.int32)
        parents = np.zeros(MOST_SETS + 1 - first, np.int32)
        count = 0
        for images, weight, pixel_map in parts:
            rows = np.arange(pixel_map.rows.start, pixel_map.rows.stop, dtype=float)
            half = self._pixfrac / 2
            count = _drizzle(
                tuple(np.ascontiguousarray(image, np.float32) for image in images),
                np.ascontiguousarray(weight, np.float32),
                pixel_map.curves(rows - half),
                pixel_map.curves(rows + half),
                pixel_map.x,
                pixel_map.columns.start,
                half,
                self._sums,
                self.weight,
                self.set,
                follow,
                parents,
                count,
            )
            if count < 0:
                raise ValueError(f"more than {MOST_SETS} different sets of exposures on one tile: make tiles smaller")
        self._links += [(int(parent), self._exposures) for parent in parents[:count]]
        self._exposures += 1

    @property
    def sets(self) -> list[tuple[int, ...]]:
        """The exposures of each set, as numbers in the order in which they were added."""
        found: list[tuple[int, ...]] = [()]
        for parent, exposure in self._links[1:]:
            found.append((*found[parent], exposure))
        return found

    @property
    def count(self) -> np.ndarray:
        """Number of exposures that contribute to each pixel, (ny, nx) uint16."""
        return np.array([len(members) for members in self.sets], np.uint16)[self.set]

    def means(self) -> list[np.ndarray]:
        """Return the weighted means of the planes, 0 where nothing falls.

        They are in the place of the sums: nothing can be added any more.
        """
        for plane in self._sums:
            np.divide(plane, self.weight, out=plane, where=self.weight > 0)
        return list(self._sums)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _drizzle(images, weight, lower, upper, knots, first, half, sums, total, sets, follow, parents, count):
    """Add the pixels of a part of an exposure; return how many sets are new by now, -1 where they are too many.

    `lower` and `upper` are the curves of the lower and upper sides of each row's pixels.
    """
    ny, nx = weight.shape
    height, width = total.shape
    step = knots[1] - knots[0]
    most = _window(lower, upper, step)
    cells = np.zeros((most, most + 2))
    # column after column of pieces of rows: what one falls on the next falls on too, and it is still in cache
    for piece in range(len(knots) - 1):
        begin = max(int(np.ceil(knots[piece])) - first, 0)
        end = nx if piece == len(knots) - 2 else min(int(np.ceil(knots[piece + 1])) - first, nx)
        for row in range(ny):
            low, high = lower[row, :, piece], upper[row, :, piece]
            if _beyond(low, high, step, most, height, width):
                continue
            for column in range(begin, end):
                w = weight[row, column]
                if w <= 0:
                    continue
                near, far = column + first - knots[piece] - half, column + first - knots[piece] + half
                # pixel k of the tile is from k to k + 1 here
                ax, ay = _cubic(low[0], near) + 0.5, _cubic(low[1], near) + 0.5
                bx, by = _cubic(low[0], far) + 0.5, _cubic(low[1], far) + 0.5
                cx, cy = _cubic(high[0], far) + 0.5, _cubic(high[1], far) + 0.5
                dx, dy = _cubic(high[0], near) + 0.5, _cubic(high[1], near) + 0.5
                left, right = np.floor(min(ax, bx, cx, dx)), np.floor(max(ax, bx, cx, dx))
                bottom, top = np.floor(min(ay, by, cy, dy)), np.floor(max(ay, by, cy, dy))
                if right < 0 or left >= width or top < 0 or bottom >= height:
                    continue
                given = np.float32(w / abs(0.5 * ((cx - ax) * (dy - by) - (dx - bx) * (cy - ay))))
                _side(cells, ax - left, ay - bottom, bx - left, by - bottom)
                _side(cells, bx - left, by - bottom, cx - left, cy - bottom)
                _side(cells, cx - left, cy - bottom, dx - left, dy - bottom)
                _side(cells, dx - left, dy - bottom, ax - left, ay - bottom)
                x0, y0, columns = int(left), int(bottom), int(right - left) + 1
                for j in range(int(top - bottom) + 1):
                    covered = 0.0
                    y = y0 + j
                    for i in range(columns):
                        covered += cells[j, i]
                        cells[j, i] = 0
                        share = abs(covered)
                        x = x0 + i
                        if share < _LEAST or y < 0 or y >= height or x < 0 or x >= width:
                            continue
                        part = given * np.float32(share)
                        total[y, x] += part
                        for plane in range(len(images)):
                            sums[plane][y, x] += part * images[plane][row, column]
                        old = sets[y, x]
                        if old < len(follow):
                            if follow[old] < 0:
                                if count >= len(parents):
                                    return -1
                                follow[old] = len(follow) + count
                                parents[count] = old
                                count += 1
                            sets[y, x] = follow[old]
                    cells[j, columns] = 0
                    cells[j, columns + 1] = 0
    return count


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _cubic(c, t):
    return ((c[0] * t + c[1]) * t + c[2]) * t + c[3]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _window(lower, upper, step):
    """Return the most tile pixels along one axis that a source pixel may touch: its width and height, and a rest."""
    most = 0.0
    for row in range(len(lower)):
        for axis in range(2):
            for piece in range(lower.shape[2]):
                c = lower[row, axis, piece]
                along = abs(_cubic(c, step) - _cubic(c, 0.0)) / step
                most = max(most, along + abs(upper[row, axis, piece, 3] - c[3]))
    return int(1.1 * most) + 3


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _beyond(low, high, step, margin, height, width):
    """Return whether a piece of a row, as good as straight, lies outside the tile."""
    for axis in range(2):
        length = width if axis == 0 else height
        a, b = _cubic(low[axis], 0.0), _cubic(low[axis], step)
        if max(a, b) < -margin or min(a, b) > length + margin:
            return True
    return False


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _side(cells, x0, y0, x1, y1):
    """Add a side of a quadrilateral to the cells: signed areas, of which sums along a row are covered shares."""
    if y0 == y1:
        return
    sign = 1.0
    if y0 > y1:
        x0, y0, x1, y1, sign = x1, y1, x0, y0, -1.0
    slope = (x1 - x0) / (y1 - y0)
    x, y, j = x0, y0, int(y0)
    while y < y1:
        top = min(j + 1.0, y1)
        beyond = x1 if top == y1 else x + slope * (top - y)
        a, b = min(x, beyond), max(x, beyond)
        tall = sign * (top - y)
        first, last = int(a), int(b)
        if first == last:
            middle = 0.5 * (a + b) - first
            cells[j, first] += tall * (1 - middle)
            cells[j, first + 1] += tall * middle
        else:
            per = 1 / (b - a)
            start, stop = 1 - (a - first), b - last
            head, tail = 0.5 * per * start * start, 0.5 * per * stop * stop
            cells[j, first] += tall * head
            if last == first + 1:
                cells[j, last] += tall * (1 - head - tail)
            else:
                so_far = per * (start + 0.5)
                cells[j, first + 1] += tall * (so_far - head)
                for k in range(first + 2, last):
                    cells[j, k] += tall * per
                cells[j, last] += tall * (1 - so_far - (last - first - 2) * per - tail)
            cells[j, last + 1] += tall * tail
        x, y, j = beyond, top, j + 1
