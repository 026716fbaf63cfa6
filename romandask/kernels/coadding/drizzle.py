"""Drizzling of exposures onto a tile with the square kernel, all planes of an exposure in one pass.

A pixel of an exposure, shrunk by pixfrac (a drop), is a quadrilateral on the tile. It adds its light to each tile pixel
in proportion to the exact area of their overlap (Fruchter & Hook 2002). Areas are computed as in font rasterisers: each
edge of the quadrilateral adds to each cell that it crosses the signed area between the edge and the right side of the
cell, and to the next cell the rest of the height that it spans. The cumulative sum along a row of cells is then the
covered share of each cell.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence

import numba
import numpy as np

from romandask.kernels.coadding.pixel_map import PixelMap

MAX_SETS = 65_535
"""Largest number of different sets of exposures on one tile."""
_MIN_OVERLAP = 1e-9
"""Share of a tile pixel below which an overlap is rounding error."""


class Sums:
    """Running weighted sums over the exposures of a tile, and the set of exposures that contribute to each pixel.

    All planes of an exposure share one pixel map and one weight. Sets of exposures are numbered in the order in which
    they first appear; number 0 is the empty set.

    Parameters
    ----------
    shape : tuple of int
        Rows and columns of the tile.
    planes : int
        Number of planes of each exposure.
    pixfrac : float
        Side of a drop over the side of a native pixel.
    corner : (int, int)
        Row and column on the tile of the first pixel of the sums, if these are a window of the tile: a pixel has the
        same sums, to the last bit, whatever the window is.
    """

    def __init__(self, shape: tuple[int, int], planes: int, pixfrac: float, corner: tuple[int, int] = (0, 0)):
        self._sums = tuple(np.zeros(shape, np.float32) for _ in range(planes))
        self._pixfrac, self._corner = pixfrac, corner
        self._set_links: list[tuple[int, int]] = [(0, -1)]  # of each set: parent set, exposure added to it
        self._exposure_count = 0
        self.weight = np.zeros(shape, np.float32)
        """Sum of the weights, (ny, nx)."""
        self.set = np.zeros(shape, np.uint16)
        """Number of the set of exposures that contribute to each pixel, (ny, nx)."""

    def add(self, parts: Iterable[tuple[Sequence[np.ndarray], np.ndarray, PixelMap]]) -> None:
        """Add one exposure.

        Parameters
        ----------
        parts : iterable of (images, weight, map)
            One entry for each strip of the exposure: its planes, each (ny, nx), in light per native pixel; its weight
            (ny, nx), 0 for bad pixels; the map of its pixels onto the tile. The means are in light per tile pixel: the
            light of a native pixel is divided by its area on the tile.

        Raises
        ------
        ValueError
            If the tile would have more than MAX_SETS different sets of exposures.
        """
        old_sets = len(self._set_links)
        successor = np.full(old_sets, -1, np.int32)
        parents = np.zeros(MAX_SETS + 1 - old_sets, np.int32)
        new_sets = 0
        for images, weight, pixel_map in parts:
            rows = np.arange(pixel_map.rows.start, pixel_map.rows.stop, dtype=float)
            half = self._pixfrac / 2
            new_sets = _drizzle(
                tuple(np.ascontiguousarray(image, np.float32) for image in images),
                np.ascontiguousarray(weight, np.float32),
                pixel_map.curves(rows - half),
                pixel_map.curves(rows + half),
                pixel_map.x[pixel_map.pieces.start : pixel_map.pieces.stop + 1],
                pixel_map.columns.start,
                half,
                self._corner[0],
                self._corner[1],
                self._sums,
                self.weight,
                self.set,
                successor,
                parents,
                new_sets,
            )
            if new_sets < 0:
                raise ValueError(f"more than {MAX_SETS} different sets of exposures on one tile: make tiles smaller")
        self._set_links += [(int(parent), self._exposure_count) for parent in parents[:new_sets]]
        self._exposure_count += 1

    @property
    def sets(self) -> list[tuple[int, ...]]:
        """Exposures of each set, as numbers from 0 in the order in which they were added."""
        members: list[tuple[int, ...]] = [()]
        for parent, exposure in self._set_links[1:]:
            members.append((*members[parent], exposure))
        return members

    @property
    def count(self) -> np.ndarray:
        """Number of exposures that contribute to each pixel, (ny, nx) uint16."""
        return np.array([len(members) for members in self.sets], np.uint16)[self.set]

    def means(self) -> list[np.ndarray]:
        """Return the weighted means of the planes, each (ny, nx), 0 where the weight is 0.

        The means overwrite the sums: no exposure can be added afterwards.
        """
        for plane in self._sums:
            np.divide(plane, self.weight, out=plane, where=self.weight > 0)
        return list(self._sums)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _drizzle(
    images,
    weight,
    lower,
    upper,
    knots,
    first_column,
    half,
    first_y,
    first_x,
    sums,
    total,
    sets,
    successor,
    parents,
    new_sets,
):
    """Add a strip of an exposure to the sums; return the number of new sets, -1 if there are too many.

    Parameters
    ----------
    images, weight : tuple of (ny, nx), and (ny, nx)
        Planes and weight of the strip.
    lower, upper : (ny, 2, pieces, 4)
        Cubics (`PixelMap.curves`) of the lower and the upper edges of the drops of each row.
    knots, first_column : (pieces + 1,), int
        Columns of the exposure at which the cubics join, and the first column of the strip.
    half : float
        Half the side of a drop, native pixels.
    first_y, first_x : int
        Row and column on the tile of the first pixel of the sums.
    sums, total, sets : tuple of (height, width), and (height, width)
        Sums of the planes, sum of the weights and number of the set of each tile pixel. They are updated.
    successor : (old sets,)
        Number of the set that each old set becomes with this exposure, -1 for none yet. It is updated.
    parents, new_sets : (room,), int
        Old set from which each new set was made, and the number of new sets so far.
    """
    ny, nx = weight.shape
    height, width = total.shape
    step = knots[1] - knots[0]
    extent = _max_extent(lower, upper, step)
    cells = np.zeros((extent, extent + 2))
    values = np.empty(len(images), np.float32)
    top_limit, right_limit = first_y + height, first_x + width
    # pieces of rows in the outer loop: neighbouring rows then fall on the same tile pixels while these are in cache
    for piece in range(len(knots) - 1):
        begin = max(int(np.ceil(knots[piece])) - first_column, 0)
        end = nx if piece == len(knots) - 2 else min(int(np.ceil(knots[piece + 1])) - first_column, nx)
        for row in range(ny):
            low, high = lower[row, :, piece], upper[row, :, piece]
            if _is_outside(low, step, extent, first_y, first_x, height, width):
                continue
            for column in range(begin, end):
                w = weight[row, column]
                if w <= 0:
                    continue
                near, far = column + first_column - knots[piece] - half, column + first_column - knots[piece] + half
                # shifted by half a pixel: tile pixel k spans k to k + 1
                ax, ay = _cubic(low[0], near) + 0.5, _cubic(low[1], near) + 0.5
                bx, by = _cubic(low[0], far) + 0.5, _cubic(low[1], far) + 0.5
                cx, cy = _cubic(high[0], far) + 0.5, _cubic(high[1], far) + 0.5
                dx, dy = _cubic(high[0], near) + 0.5, _cubic(high[1], near) + 0.5
                left, right = np.floor(min(ax, bx, cx, dx)), np.floor(max(ax, bx, cx, dx))
                bottom, top = np.floor(min(ay, by, cy, dy)), np.floor(max(ay, by, cy, dy))
                if right < first_x or left >= right_limit or top < first_y or bottom >= top_limit:
                    continue
                area = abs(0.5 * ((cx - ax) * (dy - by) - (dx - bx) * (cy - ay)))
                weight_per_area = np.float32(w / area)
                # a drop has the shape of its pixel, 2 * half as wide
                per_area = np.float32(4 * half * half / area)
                for plane in range(len(images)):
                    values[plane] = images[plane][row, column] * per_area
                _add_edge(cells, ax - left, ay - bottom, bx - left, by - bottom)
                _add_edge(cells, bx - left, by - bottom, cx - left, cy - bottom)
                _add_edge(cells, cx - left, cy - bottom, dx - left, dy - bottom)
                _add_edge(cells, dx - left, dy - bottom, ax - left, ay - bottom)
                x0, y0, columns = int(left) - first_x, int(bottom) - first_y, int(right - left) + 1
                for j in range(int(top - bottom) + 1):
                    covered = 0.0
                    y = y0 + j
                    for i in range(columns):
                        covered += cells[j, i]
                        cells[j, i] = 0
                        share = abs(covered)
                        x = x0 + i
                        if share < _MIN_OVERLAP or y < 0 or y >= height or x < 0 or x >= width:
                            continue
                        pixel_weight = weight_per_area * np.float32(share)
                        total[y, x] += pixel_weight
                        for plane in range(len(images)):
                            sums[plane][y, x] += pixel_weight * values[plane]
                        old = sets[y, x]
                        if old < len(successor):
                            if successor[old] < 0:
                                if new_sets >= len(parents):
                                    return -1
                                successor[old] = len(successor) + new_sets
                                parents[new_sets] = old
                                new_sets += 1
                            sets[y, x] = successor[old]
                    cells[j, columns] = 0
                    cells[j, columns + 1] = 0
    return new_sets


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _cubic(c, t):
    return ((c[0] * t + c[1]) * t + c[2]) * t + c[3]


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _max_extent(lower, upper, step):
    """Return an upper limit, with a margin, of the tile pixels that a drop touches along one axis."""
    largest = 0.0
    for row in range(len(lower)):
        for axis in range(2):
            for piece in range(lower.shape[2]):
                c = lower[row, axis, piece]
                along = abs(_cubic(c, step) - _cubic(c, 0.0)) / step
                largest = max(largest, along + abs(upper[row, axis, piece, 3] - c[3]))
    return int(1.1 * largest) + 3


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _is_outside(low, step, margin, first_y, first_x, height, width):
    """Return whether a piece of a row lies outside the sums; the piece is nearly straight."""
    for axis in range(2):
        start, length = (first_x, width) if axis == 0 else (first_y, height)
        a, b = _cubic(low[axis], 0.0) - start, _cubic(low[axis], step) - start
        if max(a, b) < -margin or min(a, b) > length + margin:
            return True
    return False


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _add_edge(cells, x0, y0, x1, y1):
    """Add the signed areas of an edge of a quadrilateral to the cells; see the module docstring."""
    if y0 == y1:
        return
    sign = 1.0
    if y0 > y1:
        x0, y0, x1, y1, sign = x1, y1, x0, y0, -1.0
    slope = (x1 - x0) / (y1 - y0)
    x, y, j = x0, y0, int(y0)
    while y < y1:
        top = min(j + 1.0, y1)
        x_top = x1 if top == y1 else x + slope * (top - y)
        a, b = min(x, x_top), max(x, x_top)
        signed_height = sign * (top - y)
        first, last = int(a), int(b)
        if first == last:
            middle = 0.5 * (a + b) - first
            cells[j, first] += signed_height * (1 - middle)
            cells[j, first + 1] += signed_height * middle
        else:
            inverse_width = 1 / (b - a)
            start, stop = 1 - (a - first), b - last
            head, tail = 0.5 * inverse_width * start * start, 0.5 * inverse_width * stop * stop
            cells[j, first] += signed_height * head
            if last == first + 1:
                cells[j, last] += signed_height * (1 - head - tail)
            else:
                so_far = inverse_width * (start + 0.5)
                cells[j, first + 1] += signed_height * (so_far - head)
                for k in range(first + 2, last):
                    cells[j, k] += signed_height * inverse_width
                cells[j, last] += signed_height * (1 - so_far - (last - first - 2) * inverse_width - tail)
            cells[j, last + 1] += signed_height * tail
        x, y, j = x_top, top, j + 1
