"""Compiled functions of the Fourier renderer: transforms of objects at the frequencies of their stamps.

The frequencies of a stamp at which the PSF has power are stored in flat arrays, row by row, so that the compiler can
vectorise the loops over them. A transform is the sum over components of the PSF times the transform of the profile; it
is then multiplied by the phases of the position and folded to the frequencies of the pixel grid.

fastmath is not used. A compiled loop has a vectorised and a scalar form, and the alignment of its arrays decides which
one runs. With fused operations the two forms differ in the last bit, so pixel values would depend on memory addresses.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import galsim
import numba
import numpy as np

POINT, EXPONENTIAL, DEVAUCOULEURS, KNOTS = 0, 1, 2, 3
"""Kinds of components."""
EXPONENTIAL_RADIUS = 1 / 1.6783469900166605
"""Scale length of an exponential disk, in units of its half-light radius."""
KNOT_SIGMA = 1 / np.sqrt(2 * np.log(2))
"""Sigma of a round Gaussian, in units of its half-light radius."""
_EXPONENTIAL_RADIUS_SQUARED = np.float32(EXPONENTIAL_RADIUS**2)
_MIN_SQUARE = np.float32(2.0**-20)
"""Smallest k^2 in the de Vaucouleurs table."""
_CELL_BITS, _OCTAVES = 7, 52
"""The de Vaucouleurs table has 128 cells in each octave of k^2, from 2^-20 on. The cell of a float32 is read from its
bits."""
_SHIFT = 23 - _CELL_BITS
_FIRST_CELL = (127 - 20) << _CELL_BITS
_CELLS = _OCTAVES << _CELL_BITS


@dataclass(frozen=True)
class Frequencies:
    """The modes of a PSF at the frequencies of one stamp size at which the PSF has power.

    Frequencies are 2 pi (j_x, j_y) / size, with rows j_y = -reach, ..., reach - 1 and columns j_x = 0, 1, ... of each
    row, one row after the other in flat arrays.
    """

    starts: np.ndarray
    """Index of the first frequency of each row in the flat arrays, shape (rows + 1,)."""
    x: np.ndarray
    """Frequencies along x, shape (points,), float32, radians per pixel."""
    y: np.ndarray
    """Frequencies along y, shape (points,), float32, radians per pixel."""
    real: np.ndarray
    """Real part of the modes, shape (modes, points), float32."""
    imaginary: np.ndarray
    """Imaginary part of the modes, shape (modes, points), float32."""

    @property
    def totals(self) -> np.ndarray:
        """Values of the modes at zero frequency, that is their light on the stamp, shape (modes,)."""
        return self.real[:, self.starts[(len(self.starts) - 1) // 2]]


def pack_frequencies(transforms: np.ndarray, has_power: np.ndarray, stamp: int) -> Frequencies:
    """Return PSF modes at the frequencies of a stamp at which they have power.

    Parameters
    ----------
    transforms : complex array, shape (modes, rows, columns)
        Transforms of the modes at frequencies 2 pi j / stamp, with rows j_y = -rows / 2, ... and columns
        j_x = 0, 1, ...
    has_power : bool array, shape (rows, columns)
        True where any mode has power.
    stamp : int
        Side of the stamp, pixels.
    """
    # each row is kept up to its last frequency with power; the row of the negative Nyquist frequency has no partner
    counts = np.where(has_power.any(axis=1), has_power.shape[1] - np.argmax(has_power[:, ::-1], axis=1), 0)
    counts[0] = 0
    starts = np.concatenate([[0], np.cumsum(counts)])
    shape = (len(transforms), starts[-1])
    x, y = np.empty(starts[-1], np.float32), np.empty(starts[-1], np.float32)
    real, imaginary = np.empty(shape, np.float32), np.empty(shape, np.float32)
    step = 2 * np.pi / stamp
    columns = (np.arange(has_power.shape[1]) * step).astype(np.float32)
    # row by row to save memory: the largest stamps have tens of millions of frequencies
    for row, count in enumerate(counts):
        part = slice(starts[row], starts[row + 1])
        x[part] = columns[:count]
        y[part] = (row - len(counts) // 2) * step
        real[:, part] = transforms[:, row, :count].real
        imaginary[:, part] = transforms[:, row, :count].imag
    return Frequencies(starts, x, y, real, imaginary)


@lru_cache(maxsize=1)
def devaucouleurs_table() -> np.ndarray:
    """Return the transform of a de Vaucouleurs profile of flux 1 and half-light radius 1, float32.

    Entry j is the transform at the smallest k^2 of cell j; see _CELL_BITS.
    """
    profile = galsim.DeVaucouleurs(half_light_radius=1.0)
    cell = np.arange(_CELLS + 1)
    squares = 2.0 ** (cell // (1 << _CELL_BITS) - 20) * (1 + (cell % (1 << _CELL_BITS)) / (1 << _CELL_BITS))
    return np.array([profile.kValue(k, 0.0).real for k in np.sqrt(squares)], np.float32)


@numba.njit(nogil=True, cache=True)
def _hash(key, counter):
    """Return a random number in (0, 1) from an identity and a counter (splitmix64)."""
    value = np.uint64(key) + np.uint64(counter) * np.uint64(0x9E3779B97F4A7C15)
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    value = value ^ (value >> np.uint64(31))
    return (np.float64(value >> np.uint64(11)) + 0.5) / 9007199254740992.0


@numba.njit(nogil=True, cache=True)
def knot_offset(key, knot):
    """Return the position of a knot relative to the centre of its galaxy, the same in every image.

    Positions follow a round Gaussian and are in units of its half-light radius.

    Parameters
    ----------
    key : uint64
        Identity of the galaxy.
    knot : int
        Number of the knot.
    """
    first = _hash(key, 2 * knot + 1)
    second = _hash(key, 2 * knot + 2)
    radius = 0.8493218002880191 * np.sqrt(-2.0 * np.log(first))
    return radius * np.cos(2 * np.pi * second), radius * np.sin(2 * np.pi * second)


@numba.njit(nogil=True, cache=True)
def _phases(angle, lowest, out):
    """Write exp(-i angle j) for j = lowest, lowest + 1, ... to `out`."""
    turn = np.cos(angle) - 1j * np.sin(angle)
    value = np.cos(angle * lowest) - 1j * np.sin(angle * lowest)
    for j in range(out.shape[0]):
        out[j] = value
        value *= turn


@numba.njit(nogil=True, cache=True)
def _squares(matrix, kx, ky, out):
    """Write |M^T k|^2, the squared frequency in the frame in which the profile is round, to `out`."""
    xx = np.float32(matrix[0, 0] ** 2 + matrix[0, 1] ** 2)
    yy = np.float32(matrix[1, 0] ** 2 + matrix[1, 1] ** 2)
    xy = np.float32(2 * (matrix[0, 0] * matrix[1, 0] + matrix[0, 1] * matrix[1, 1]))
    for i in range(out.shape[0]):
        out[i] = xx * kx[i] * kx[i] + xy * kx[i] * ky[i] + yy * ky[i] * ky[i]


@numba.njit(nogil=True, cache=True)
def _exponential(squares, re, im, total_re, total_im):
    """Add the transform of an exponential disk times a PSF (re, im) to the totals."""
    for i in range(squares.shape[0]):
        t = np.float32(1) + _EXPONENTIAL_RADIUS_SQUARED * squares[i]
        value = np.float32(1) / (t * np.sqrt(t))
        total_re[i] += value * re[i]
        total_im[i] += value * im[i]


@numba.njit(nogil=True, cache=True)
def _devaucouleurs(squares, table, re, im, total_re, total_im):
    """Add the transform of a de Vaucouleurs profile times a PSF (re, im) to the totals; overwrites `squares`."""
    bits = squares.view(np.int32)
    unit = np.float32(1.0 / (1 << _SHIFT))
    for i in range(squares.shape[0]):
        squares[i] = max(squares[i], _MIN_SQUARE)
    for i in range(squares.shape[0]):
        cell = min((bits[i] >> _SHIFT) - _FIRST_CELL, _CELLS - 1)
        fraction = np.float32(bits[i] & ((1 << _SHIFT) - 1)) * unit
        value = table[cell] + fraction * (table[cell + 1] - table[cell])
        total_re[i] += value * re[i]
        total_im[i] += value * im[i]


@numba.njit(nogil=True, cache=True)
def _gaussian_count(xx, xy, yy, y, step):
    """Return the number of frequencies 0, step, ... of the row at `y` up to which a Gaussian is above 6e-6."""
    if xx <= 0:
        return 1 << 30
    discriminant = xy * xy * y * y - xx * (yy * y * y - 24.0)
    if discriminant < 0:
        return 0
    return max(0, int((np.sqrt(discriminant) - xy * y) / (xx * step)) + 1)


@numba.njit(nogil=True, cache=True)
def _knots(key, count, matrix, smoothing, starts, kx, ky, step, reach, re, im, total_re, total_im):
    """Add the transform of knots times a PSF (re, im) to the totals.

    Knots are points of equal flux at the positions of `knot_offset`, each smoothed by a Gaussian.
    """
    xx = smoothing[0, 0] ** 2 + smoothing[0, 1] ** 2
    yy = smoothing[1, 0] ** 2 + smoothing[1, 1] ** 2
    xy = smoothing[0, 0] * smoothing[1, 0] + smoothing[0, 1] * smoothing[1, 1]
    columns = np.empty((count, reach + 1), np.complex128)
    rows = np.empty((count, 2 * reach), np.complex128)
    for k in range(count):
        u, v = knot_offset(key, k)
        _phases(step * (matrix[0, 0] * u + matrix[0, 1] * v), 0, columns[k])
        _phases(step * (matrix[1, 0] * u + matrix[1, 1] * v), -reach, rows[k])
    across_re = np.ascontiguousarray(columns.real).astype(np.float32)
    across_im = np.ascontiguousarray(columns.imag).astype(np.float32)
    sum_re, sum_im = np.empty(reach + 1, np.float32), np.empty(reach + 1, np.float32)
    for j in range(2 * reach):
        first, n = starts[j], starts[j + 1] - starts[j]
        n = min(n, _gaussian_count(xx, xy, yy, step * (j - reach), step))
        sum_re[:n] = 0
        sum_im[:n] = 0
        for k in range(count):
            a, b = np.float32(rows[k, j].real / count), np.float32(rows[k, j].imag / count)
            for i in range(n):
                sum_re[i] += a * across_re[k, i] - b * across_im[k, i]
                sum_im[i] += a * across_im[k, i] + b * across_re[k, i]
        for i in range(n):
            x, y = kx[first + i], ky[first + i]
            value = np.float32(np.exp(-np.float32(0.5) * np.float32(xx * x * x + 2 * xy * x * y + yy * y * y)))
            s, t = value * sum_re[i], value * sum_im[i]
            total_re[first + i] += s * re[first + i] - t * im[first + i]
            total_im[first + i] += s * im[first + i] + t * re[first + i]


@numba.njit(nogil=True, cache=True)
def _fold(total_re, total_im, starts, columns, rows, reach, real, imaginary):
    """Multiply a transform by the phases of a position, and fold it to the frequencies of the pixel grid.

    The result is added to `real` and `imaginary`, shape (size, size / 2 + 1).
    """
    size = real.shape[0]
    half = size // 2
    across_re = np.ascontiguousarray(columns.real).astype(np.float32)
    across_im = np.ascontiguousarray(columns.imag).astype(np.float32)
    for j in range(2 * reach):
        first, n = starts[j], starts[j + 1] - starts[j]
        same = (j - reach) % size
        mirrored = (size - same) % size
        a, b = np.float32(rows[j].real), np.float32(rows[j].imag)
        for low in range(0, n, half):
            count = min(half + 1, n - low)
            # even half periods are added as they are, odd ones mirrored and complex-conjugated; the frequency between
            # two half periods belongs to both
            if (low // half) % 2 == 0:
                for i in range(count):
                    p, q = across_re[low + i], across_im[low + i]
                    c, d = p * a - q * b, p * b + q * a
                    r, t = total_re[first + low + i], total_im[first + low + i]
                    real[same, i] += r * c - t * d
                    imaginary[same, i] += r * d + t * c
            else:
                for i in range(count):
                    p, q = across_re[low + i], across_im[low + i]
                    c, d = p * a - q * b, p * b + q * a
                    r, t = total_re[first + low + i], total_im[first + low + i]
                    real[mirrored, half - i] += r * c - t * d
                    imaginary[mirrored, half - i] -= r * d + t * c


@numba.njit(nogil=True, cache=True)
def fill_transforms(
    out, chosen, x, y, keys, first, kind, matrix, smoothing, knots, begin, real, imaginary, starts, kx, ky, table
):
    """Write the transforms of objects on stamps, folded to the frequencies of the pixel grid.

    The first pixel of a stamp is the pixel floor(x) - size / 2, floor(y) - size / 2 of the image.

    Parameters
    ----------
    out : complex64 array, shape (stamps, size, size / 2 + 1)
        Output.
    chosen : int array, shape (stamps,)
        Indices of the objects.
    x, y, keys : array, shape (objects,)
        Fields of `Scene`.
    first : int array, shape (objects + 1,)
        Index of the first component of each object.
    kind, matrix, smoothing, knots : array, shape (components, ...)
        Fields of `Scene`.
    begin : int array, shape (stamps,)
        Row in `real` and `imaginary` of the first component of each chosen object.
    real, imaginary : float32 array, shape (components of the chosen objects, points)
        PSF of each component times its flux.
    starts, kx, ky : array
        Fields `starts`, `x` and `y` of `Frequencies`.
    table : float32 array
        Result of `devaucouleurs_table`.
    """
    size = out.shape[1]
    step = 2 * np.pi / size
    points, reach = kx.shape[0], (starts.shape[0] - 1) // 2
    squares = np.empty(points, np.float32)
    total_re, total_im = np.empty(points, np.float32), np.empty(points, np.float32)
    columns, rows = np.empty(reach + 1, np.complex128), np.empty(2 * reach, np.complex128)
    folded_re = np.empty((size, size // 2 + 1), np.float32)
    folded_im = np.empty((size, size // 2 + 1), np.float32)
    for s in range(chosen.shape[0]):
        n = chosen[s]
        total_re[:] = 0
        total_im[:] = 0
        for c in range(first[n], first[n + 1]):
            re, im = real[begin[s] + c - first[n]], imaginary[begin[s] + c - first[n]]
            if kind[c] == POINT:
                for i in range(points):
                    total_re[i] += re[i]
                    total_im[i] += im[i]
            elif kind[c] == KNOTS:
                _knots(
                    keys[n], knots[c], matrix[c], smoothing[c], starts, kx, ky, step, reach, re, im, total_re, total_im
                )
            else:
                _squares(matrix[c], kx, ky, squares)
                if kind[c] == EXPONENTIAL:
                    _exponential(squares, re, im, total_re, total_im)
                else:
                    _devaucouleurs(squares, table, re, im, total_re, total_im)
        _phases(step * (x[n] - np.floor(x[n]) + size // 2), 0, columns)
        _phases(step * (y[n] - np.floor(y[n]) + size // 2), -reach, rows)
        folded_re[:] = 0
        folded_im[:] = 0
        _fold(total_re, total_im, starts, columns, rows, reach, folded_re, folded_im)
        for j in range(size):
            for i in range(size // 2 + 1):
                out[s, j, i] = np.complex64(folded_re[j, i] + 1j * folded_im[j, i])
