"""Light outside the stamps of objects: wings of PSFs and of galaxies, on grids whose cells grow with the distance.

What a stamp does not contain is fainter than the noise and smooth. It is added to a pyramid of grids, the first of
cells of 2 pixels, each with cells of twice the side of the one before. At the end each grid is interpolated to the next
finer one, and the finest to the image. The light of every object is complete, and its wings cost far less than a stamp
that contains them.
"""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from romandask.kernels.rendering.profiles import profile_tables, surface_brightness
from romandask.kernels.rendering.rings import FIRST_CELL, FIRST_SIDE, PHASES, REACH, Rings, power_law_cells

LEVELS = 10
"""Number of grids; the last one holds the light from 8192 to 16384 pixels around an object."""
_MARGIN = 2
"""Cells of each grid beyond each edge of the image."""
_LARGE = 128
"""Side of the stamps, pixels, of galaxies whose wings are in finer cells."""
_FINER = 2
"""Grids between that of the ring and that of the finer cells."""
_GAUSS = 0.5 / np.sqrt(3.0)
"""Distance of the points of a two-point quadrature from the middle of a cell, in cells."""


@dataclass(frozen=True)
class Pyramid:
    """Grids of surface brightness over an image, electrons/pixel, in one flat array."""

    values: np.ndarray
    """Values of all grids, one after another, row by row, float32."""
    starts: np.ndarray
    """Index of the first value of each grid, shape (LEVELS + 1,)."""
    shapes: np.ndarray
    """Rows and columns of each grid, shape (LEVELS, 2)."""
    image_shape: tuple[int, int]
    """Shape of the image (ny, nx)."""

    def add_points(self, x: np.ndarray, y: np.ndarray, light: np.ndarray, rings: Rings) -> None:
        """Add the light of n point sources in the rings of a PSF.

        Parameters
        ----------
        x, y : array, shape (n,), pixels
            Positions.
        light : array, shape (n, rings), electrons
            Light in each ring.
        rings : Rings
            Rings of the PSF.
        """
        if len(rings.shares):
            _add_points(self.values, self.starts, self.shapes, x, y, light, rings.cells)

    def add_power_laws(self, x: np.ndarray, y: np.ndarray, light: np.ndarray, side: np.ndarray, end: np.ndarray):
        """Add light that falls as r^-3 from squares of sides `side` to squares of sides `end`.

        Parameters
        ----------
        x, y : array, shape (n,), pixels
            Positions.
        light : array, shape (n,), electrons
            Light between the squares.
        side, end : int array, shape (n,), pixels
            Sides of the squares, powers of two.
        """
        inner = FIRST_SIDE << np.arange(LEVELS)
        used = (inner >= side[:, None]) & (inner < end[:, None])
        weight = used / inner
        share = weight / np.maximum(weight.sum(axis=1, keepdims=True), 1e-30)
        cells = np.repeat(power_law_cells()[None], LEVELS, axis=0)
        _add_points(self.values, self.starts, self.shapes, x, y, light[:, None] * share, cells)

    def add_galaxies(
        self,
        x: np.ndarray,
        y: np.ndarray,
        kind: np.ndarray,
        matrix: np.ndarray,
        light: np.ndarray,
        side: np.ndarray,
        extent: np.ndarray,
    ) -> None:
        """Add the light of n galaxy components outside squares around them.

        Parameters
        ----------
        x, y : array, shape (n,), pixels
            Positions.
        kind : int array, shape (n,)
            EXPONENTIAL or DEVAUCOULEURS.
        matrix : array, shape (n, 2, 2)
            Linear map from a round profile of half-light radius 1 to pixels.
        light : array, shape (n,), electrons
            Light of the whole components.
        side : int array, shape (n,), pixels
            Sides of the squares, powers of two. Their first pixels are floor(x) - side / 2, floor(y) - side / 2.
        extent : array, shape (n,), pixels
            Radii beyond which light is not drawn.
        """
        _add_galaxies(self.values, self.starts, self.shapes, x, y, kind, matrix, light, side, extent, profile_tables())

    def add_to(self, image: np.ndarray) -> None:
        """Interpolate the grids, whose values are used up, and add them to an image."""
        grids = [
            part.reshape(shape)
            for part, shape in zip(np.split(self.values, self.starts[1:-1]), self.shapes, strict=True)
        ]
        for coarse, fine in zip(grids[:0:-1], grids[-2::-1], strict=True):
            _refine(coarse, fine, _MARGIN)
        _refine(grids[0], image, 0)


def pyramid(shape: tuple[int, int]) -> Pyramid:
    """Return an empty pyramid for images of shape (ny, nx)."""
    cells = FIRST_CELL << np.arange(LEVELS)
    shapes = -(-np.array(shape) // cells[:, None]) + 2 * _MARGIN
    starts = np.concatenate([[0], np.cumsum(shapes.prod(axis=1))])
    return Pyramid(np.zeros(starts[-1], np.float32), starts, shapes, shape)


@numba.njit(nogil=True, cache=True)
def _add_points(values, starts, shapes, x, y, light, cells):
    """Add the rings of point sources; see `Pyramid.add_points`."""
    for n in range(x.shape[0]):
        for k in range(cells.shape[0]):
            if light[n, k] == 0:
                continue
            side = FIRST_CELL << k
            u, v = (x[n] + 0.5) / side, (y[n] + 0.5) / side
            i, j = int(np.floor(u)), int(np.floor(v))
            star = cells[k, int((v - j) * PHASES), int((u - i) * PHASES)]
            # the first cell of the ring, in the grid
            left, low = i + _MARGIN - REACH, j + _MARGIN - REACH
            rows, columns = shapes[k, 0], shapes[k, 1]
            begin, end = max(0, -left), min(2 * REACH + 1, columns - left)
            if begin >= end:
                continue
            scale = np.float32(light[n, k] / side**2)
            for b in range(max(0, -low), min(2 * REACH + 1, rows - low)):
                first = starts[k] + (low + b) * columns + left
                target, source = values[first + begin : first + end], star[b, begin:end]
                for a in range(end - begin):
                    target[a] += scale * source[a]


@numba.njit(nogil=True, cache=True)
def _add_galaxies(values, starts, shapes, x, y, kind, matrix, light, side, extent, tables):
    """Add the light of galaxies outside squares; see `Pyramid.add_galaxies`."""
    most = 2 * (REACH << _FINER) + 4
    across, up = np.empty((most, 2)), np.empty((most, 2))
    column, row = np.empty(most, np.int64), np.empty(most, np.int64)
    for n in range(x.shape[0]):
        m = matrix[n]
        xx, yy = m[0, 0] ** 2 + m[0, 1] ** 2, m[1, 0] ** 2 + m[1, 1] ** 2
        xy = m[0, 0] * m[1, 0] + m[0, 1] * m[1, 1]
        area = np.sqrt(max(xx * yy - xy * xy, 1e-30))
        ixx, ixy, iyy = yy / area**2, -xy / area**2, xx / area**2
        for k in range(starts.shape[0] - 1):
            inner = FIRST_SIDE << k
            if inner < side[n]:
                continue
            if inner / 2 > extent[n]:
                break
            # the wings of large galaxies are far above those of others
            finer = _FINER if side[n] >= _LARGE else 0
            cell, grid, reach = FIRST_CELL << (k - finer), k - finer, REACH << finer
            # the first ring begins at the edges of the stamp, whose middle is not quite the object
            shift = 0.5 if inner == side[n] else 0.0
            left, low = -shift * (1 + 2 * (x[n] - np.floor(x[n]))), -shift * (1 + 2 * (y[n] - np.floor(y[n])))
            columns = _pieces(x[n] + 0.5, cell, reach, inner, left, shapes[grid, 1], column, across)
            rows = _pieces(y[n] + 0.5, cell, reach, inner, low, shapes[grid, 0], row, up)
            # the first ring has most of the light, and the steepest profile
            points = 4 if inner == side[n] else 1
            scale, step = light[n] / area / points / cell**2, _GAUSS if points > 1 else 0.0
            for b in range(rows):
                dy, height = up[b]
                within = abs(dy - low) < inner / 2
                first = starts[grid] + row[b] * shapes[grid, 1]
                for a in range(columns):
                    dx, width = across[a]
                    if within and abs(dx - left) < inner / 2:
                        continue
                    total = 0.0
                    for q in range(points):
                        u, v = dx + (2 * (q % 2) - 1) * step * width, dy + (2 * (q // 2) - 1) * step * height
                        square = ixx * u * u + 2 * ixy * u * v + iyy * v * v
                        total += surface_brightness(tables, kind[n], square)
                    values[first + column[a]] += np.float32(scale * width * height * total)


@numba.njit(nogil=True, cache=True)
def _pieces(position, cell, reach, inner, shift, count, number, piece):
    """Split the cells of a ring along one axis at the edges of the ring, and return the number of pieces in the grid.

    Parameters
    ----------
    position : float, pixels
        Position of the object, from the edge of the image.
    cell : int, pixels
        Side of the cells.
    reach : int
        Cells from the object to the outer edge of the ring.
    inner : int, pixels
        Inner side of the ring.
    shift : float, pixels
        Middle of the inner square, from the object.
    count : int
        Number of cells of the grid.
    number, piece : array, shape (n,) and (n, 2)
        Output: cell in the grid of each piece; middle, from the object, and width of each piece, pixels.
    """
    pieces = 0
    middle = int(np.floor(position / cell))
    for k in range(middle - reach, middle + reach + 1):
        if k + _MARGIN < 0 or k + _MARGIN >= count:
            continue
        start, stop = max(k * cell - position, -float(inner)), min((k + 1) * cell - position, float(inner))
        for edge in (shift - inner / 2, shift + inner / 2, stop):
            end = min(max(edge, start), stop)
            if end > start:
                number[pieces] = k + _MARGIN
                piece[pieces] = ((start + end) / 2, end - start)
                pieces += 1
                start = end
    return pieces


@numba.njit(nogil=True, cache=True)
def add_galaxy_pixels(image, x, y, kind, matrix, light, side, x0, y0, stamp, tables):
    """Add the light of one galaxy component to the pixels of a square outside its stamp.

    Parameters
    ----------
    image : float32 array, shape (ny, nx)
        Image; modified in place.
    x, y : float, pixels
        Position.
    kind : int
        EXPONENTIAL or DEVAUCOULEURS.
    matrix : array, shape (2, 2)
        Linear map from a round profile of half-light radius 1 to pixels.
    light : float, electrons
        Light of the whole component.
    side : int, pixels
        Side of the square.
    x0, y0, stamp : int, pixels
        First pixel and side of the stamp.
    tables : float32 array
        Result of `profile_tables`.
    """
    ny, nx = image.shape
    xx, yy = matrix[0, 0] ** 2 + matrix[0, 1] ** 2, matrix[1, 0] ** 2 + matrix[1, 1] ** 2
    xy = matrix[0, 0] * matrix[1, 0] + matrix[0, 1] * matrix[1, 1]
    area = np.sqrt(max(xx * yy - xy * xy, 1e-30))
    ixx, ixy, iyy = yy / area**2, -xy / area**2, xx / area**2
    for j in range(max(0, int(np.floor(y)) - side // 2), min(ny, int(np.floor(y)) + side // 2)):
        dy = j - y
        for i in range(max(0, int(np.floor(x)) - side // 2), min(nx, int(np.floor(x)) + side // 2)):
            if x0 <= i < x0 + stamp and y0 <= j < y0 + stamp:
                continue
            dx = i - x
            square = ixx * dx * dx + 2 * ixy * dx * dy + iyy * dy * dy
            image[j, i] += np.float32(light / area * surface_brightness(tables, kind, square))


@numba.njit(nogil=True, cache=True)
def _refine(coarse, fine, margin):
    """Add the linear interpolation of a grid to one of half the cells, which has `margin` cells beyond the image."""
    rows, columns = fine.shape
    line = np.empty(coarse.shape[1], np.float32)
    near, far = np.float32(0.75), np.float32(0.25)
    # index of the coarse cell below the first fine one, whose number from the edge of the image is -margin
    shift = _MARGIN - margin // 2
    last = coarse.shape[1] - 1
    for j in range(rows):
        b = j // 2 + shift
        other = min(max(b - 1 if j % 2 == 0 else b + 1, 0), coarse.shape[0] - 1)
        upper, lower = coarse[b], coarse[other]
        for a in range(line.shape[0]):
            line[a] = near * upper[a] + far * lower[a]
        target = fine[j]
        for i in range(columns):
            a = i // 2 + shift
            beside = min(max(a - 1 if i % 2 == 0 else a + 1, 0), last)
            target[i] += near * line[a] + far * line[beside]
