"""Compiled sums of the renderer: transforms of objects at the frequencies of their stamps, folded to the pixel grid.

The frequencies of a stamp that the PSF reaches lie one after another in flat arrays, row by row, so that the loops
over them are vectorised: amplitudes of the PSF's modes, then the profile's transform, then phases and folding.

Nothing here is compiled with fastmath: a loop has a vectorised and a plain form, of which the places of its arrays in
memory choose one, and with fused operations the two differ in the last bit, so that pixels would with the memory.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import lru_cache

import galsim
import numba
import numpy as np

POINT, EXPONENTIAL, DEVAUCOULEURS, KNOTS = 0, 1, 2, 3
EXPONENTIAL_RADIUS = 1 / 1.6783469900166605
"""Scale length of an exponential disk over its half-light radius."""
KNOT_SIGMA = 1 / np.sqrt(2 * np.log(2))
"""Gaussian sigma over half-light radius."""
_DISK = np.float32(EXPONENTIAL_RADIUS**2)
_DECAY = 1.6783469900166605
"""Of an exponential disk: exp(-1.678 r) at r half-light radii."""
_WINGS = 7.669249442500805
"""Of a de Vaucouleurs profile: exp(-7.669 r^(1/4))."""
_PEAK = 5040 * 4 * 2 * np.pi / _WINGS**8
"""Light of a de Vaucouleurs profile that is 1 in its centre, half-light radius 1: 8 pi Gamma(8) / b^8."""
_FAR_DISK, _FAR_BULGE = 6.5, 70.0
"""Half-light radii beyond which less than 2e-4 of the light lies."""
_KNOTS_A_SIDE = 9
_LEAST = np.float32(2.0**-20)
_CELL_BITS, _OCTAVES = 7, 52
"""The de Vaucouleurs table has 128 cells in each octave of k^2, found from the bits of a float32, from 2^-20 on."""
_SHIFT = 23 - _CELL_BITS
_FIRST_CELL = (127 - 20) << _CELL_BITS
_CELLS = _OCTAVES << _CELL_BITS


@dataclass(frozen=True)
class Frequencies:
    """Where a PSF has power, among the frequencies of one stamp size (column >= 0)."""

    starts: np.ndarray
    """(rows + 1,) where each row begins in the flat arrays; rows are j_y = -reach ..., columns j_x = 0 ..."""
    x: np.ndarray
    """(points,) float32, radians a pixel."""
    y: np.ndarray
    """(points,) float32"""
    real: np.ndarray
    """(modes, points) float32: the PSF's modes."""
    imaginary: np.ndarray
    """(modes, points) float32"""

    @property
    def totals(self) -> np.ndarray:
        """(modes,) their values at zero frequency: the light on the stamp."""
        return self.real[:, self.starts[(len(self.starts) - 1) // 2]]


def frequencies(transforms: np.ndarray, seen: np.ndarray, stamp: int) -> Frequencies:
    """Return the frequencies of a stamp of `stamp` pixels at which PSFs have power.

    Parameters
    ----------
    transforms : (modes, rows, columns) complex, rows j_y = -rows / 2 ..., columns j_x = 0 ..., of 2 pi j / stamp
    seen : (rows, columns) True where there is any power
    """
    # a row is kept to its last frequency with power; the negative Nyquist row has no partner
    last = np.where(seen.any(axis=1), seen.shape[1] - np.argmax(seen[:, ::-1], axis=1), 0)
    last[0] = 0
    starts = np.concatenate([[0], np.cumsum(last)])
    shape = (len(transforms), starts[-1])
    x, y = np.empty(starts[-1], np.float32), np.empty(starts[-1], np.float32)
    real, imaginary = np.empty(shape, np.float32), np.empty(shape, np.float32)
    step = 2 * np.pi / stamp
    columns = (np.arange(seen.shape[1]) * step).astype(np.float32)
    # row by row, for the largest stamps have tens of millions of frequencies
    for row, count in enumerate(last):
        part = slice(starts[row], starts[row + 1])
        x[part] = columns[:count]
        y[part] = (row - len(last) // 2) * step
        real[:, part] = transforms[:, row, :count].real
        imaginary[:, part] = transforms[:, row, :count].imag
    return Frequencies(starts, x, y, real, imaginary)


@lru_cache(maxsize=1)
def devaucouleurs_table() -> np.ndarray:
    """Return the transform of a de Vaucouleurs profile, half-light radius 1, at the first k^2 of each cell, float32."""
    profile = galsim.DeVaucouleurs(half_light_radius=1.0)
    cell = np.arange(_CELLS + 1)
    squares = 2.0 ** (cell // (1 << _CELL_BITS) - 20) * (1 + (cell % (1 << _CELL_BITS)) / (1 << _CELL_BITS))
    return np.array([profile.kValue(k, 0.0).real for k in np.sqrt(squares)], np.float32)


@numba.njit(nogil=True, cache=True)
def _hash(key, counter):
    """splitmix64 of an identity and a counter, to (0, 1)."""
    value = np.uint64(key) + np.uint64(counter) * np.uint64(0x9E3779B97F4A7C15)
    value = (value ^ (value >> np.uint64(30))) * np.uint64(0xBF58476D1CE4E5B9)
    value = (value ^ (value >> np.uint64(27))) * np.uint64(0x94D049BB133111EB)
    value = value ^ (value >> np.uint64(31))
    return (np.float64(value >> np.uint64(11)) + 0.5) / 9007199254740992.0


@numba.njit(nogil=True, cache=True)
def knot_offset(key, knot):
    """Return the position of a knot in units of the half-light radius of a round Gaussian: the same in every image."""
    first = _hash(key, 2 * knot + 1)
    second = _hash(key, 2 * knot + 2)
    radius = 0.8493218002880191 * np.sqrt(-2.0 * np.log(first))
    return radius * np.cos(2 * np.pi * second), radius * np.sin(2 * np.pi * second)


@numba.njit(nogil=True, cache=True)
def _phases(angle, lowest, out):
    """Write exp(-i angle j) for j = lowest, lowest + 1, ..."""
    turn = np.cos(angle) - 1j * np.sin(angle)
    value = np.cos(angle * lowest) - 1j * np.sin(angle * lowest)
    for j in range(out.shape[0]):
        out[j] = value
        value *= turn


@numba.njit(nogil=True, cache=True)
def _squares(matrix, kx, ky, out):
    """Write |M^T k|^2: the squared frequency in the frame in which the profile is round."""
    xx = np.float32(matrix[0, 0] ** 2 + matrix[0, 1] ** 2)
    yy = np.float32(matrix[1, 0] ** 2 + matrix[1, 1] ** 2)
    xy = np.float32(2 * (matrix[0, 0] * matrix[1, 0] + matrix[0, 1] * matrix[1, 1]))
    for i in range(out.shape[0]):
        out[i] = xx * kx[i] * kx[i] + xy * kx[i] * ky[i] + yy * ky[i] * ky[i]


@numba.njit(nogil=True, cache=True)
def _exponential(squares, re, im, total_re, total_im):
    for i in range(squares.shape[0]):
        t = np.float32(1) + _DISK * squares[i]
        value = np.float32(1) / (t * np.sqrt(t))
        total_re[i] += value * re[i]
        total_im[i] += value * im[i]


@numba.njit(nogil=True, cache=True)
def _devaucouleurs(squares, table, re, im, total_re, total_im):
    bits = squares.view(np.int32)
    part = np.float32(1.0 / (1 << _SHIFT))
    for i in range(squares.shape[0]):
        squares[i] = max(squares[i], _LEAST)
    for i in range(squares.shape[0]):
        cell = min((bits[i] >> _SHIFT) - _FIRST_CELL, _CELLS - 1)
        share = np.float32(bits[i] & ((1 << _SHIFT) - 1)) * part
        value = table[cell] + share * (table[cell + 1] - table[cell])
        total_re[i] += value * re[i]
        total_im[i] += value * im[i]


@numba.njit(nogil=True, cache=True)
def _within(xx, xy, yy, y, step):
    """Return how many frequencies 0, step, ... of a row at `y` a Gaussian leaves above 6e-6."""
    if xx <= 0:
        return 1 << 30
    square = xy * xy * y * y - xx * (yy * y * y - 24.0)
    if square < 0:
        return 0
    return max(0, int((np.sqrt(square) - xy * y) / (xx * step)) + 1)


@numba.njit(nogil=True, cache=True)
def _knots(key, count, matrix, smoothing, starts, kx, ky, step, reach, re, im, total_re, total_im):
    """Add points at the places that an identity gives, each smoothed by a Gaussian, of equal light."""
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
        n = min(n, _within(xx, xy, yy, step * (j - reach), step))
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
    """Add phases and fold frequencies to those of the pixel grid: (size, size / 2 + 1), zeros at first."""
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
            # of each half of a period the one is copied, the other is its mirror image; their ends belong to both
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
def fill(out, chosen, x, y, keys, first, kind, matrix, smoothing, knots, begin, real, imaginary, starts, kx, ky, table):
    """Write the folded transforms of objects to `out` (stamps, size, size / 2 + 1); they begin at floor(x) - size / 2.

    Parameters
    ----------
    chosen : (stamps,) numbers of the objects
    first : (objects + 1,) number of the first component of each
    begin : (stamps,) row of the PSF of the first component of each
    real, imaginary : (components of these objects, points) float32: the PSF of each, times its light
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


@numba.njit(nogil=True, cache=True)
def _wing(kind, xx, xy, yy, dx, dy):
    """Return a profile of light 1, |det M| = 1, at an offset of its centre; M M^T inverted is [[xx, xy], [xy, yy]]."""
    radius = np.sqrt(max(xx * dx * dx + 2 * xy * dx * dy + yy * dy * dy, 0.0))
    if kind == EXPONENTIAL:
        return _DECAY * _DECAY / (2 * np.pi) * np.exp(-_DECAY * radius)
    return np.exp(-_WINGS * np.sqrt(np.sqrt(radius))) / _PEAK


@numba.njit(nogil=True, cache=True)
def unfold(stamps, chosen, x, y, first, kind, matrix, light):
    """Subtract from stamps (n, size, size) the light of galaxies from beyond their edges.

    A transform sampled at a stamp's frequencies is that of a profile repeated with the stamp's period. The light of the
    repetitions is smooth there, far in their wings: it is found on a coarse grid and interpolated linearly.

    Parameters
    ----------
    light : (components,) as their PSF has it on the stamp
    """
    size = stamps.shape[1]
    n = _KNOTS_A_SIDE
    step = (size - 1) / (n - 1)
    coarse = np.empty((n, n))
    for s in range(chosen.shape[0]):
        o = chosen[s]
        x0, y0 = x[o] - np.floor(x[o]) + size // 2, y[o] - np.floor(y[o]) + size // 2
        coarse[:] = 0
        any_light = False
        for c in range(first[o], first[o + 1]):
            if kind[c] != EXPONENTIAL and kind[c] != DEVAUCOULEURS:
                continue
            m = matrix[c]
            xx, yy = m[0, 0] ** 2 + m[0, 1] ** 2, m[1, 0] ** 2 + m[1, 1] ** 2
            xy = m[0, 0] * m[1, 0] + m[0, 1] * m[1, 1]
            area = np.sqrt(max(xx * yy - xy * xy, 1e-30))
            largest = np.sqrt((xx + yy + np.sqrt((xx - yy) ** 2 + 4 * xy * xy)) / 2)
            far = _FAR_DISK if kind[c] == EXPONENTIAL else _FAR_BULGE
            if size / 2 > far * largest or light[c] == 0:
                continue
            any_light = True
            ixx, ixy, iyy = yy / area**2, -xy / area**2, xx / area**2
            scale = light[c] / area
            outer = 0.0
            for j in range(-2, 3):
                for i in range(-2, 3):
                    if abs(i) == 2 or abs(j) == 2:
                        outer += _wing(kind[c], ixx, ixy, iyy, i * size, j * size)
            for b in range(n):
                for a in range(n):
                    total = outer
                    for j in range(-1, 2):
                        for i in range(-1, 2):
                            if i != 0 or j != 0:
                                dx, dy = a * step - x0 + i * size, b * step - y0 + j * size
                                total += _wing(kind[c], ixx, ixy, iyy, dx, dy)
                    coarse[b, a] += scale * total
        if any_light:
            _subtract(stamps[s], coarse, step)


@numba.njit(nogil=True, cache=True)
def _subtract(stamp, coarse, step):
    """Subtract what a coarse grid with a step has between its points, linearly."""
    size, n = stamp.shape[0], coarse.shape[0]
    for j in range(size):
        b = min(int(j / step), n - 2)
        up = j / step - b
        for i in range(size):
            a = min(int(i / step), n - 2)
            across = i / step - a
            low = coarse[b, a] + across * (coarse[b, a + 1] - coarse[b, a])
            high = coarse[b + 1, a] + across * (coarse[b + 1, a + 1] - coarse[b + 1, a])
            stamp[j, i] -= low + up * (high - low)


@numba.njit(nogil=True, cache=True)
def add(image, stamps, chosen, x, y):
    """Add stamps (n, size, size) of objects to the image where they fall on it."""
    ny, nx = image.shape
    size = stamps.shape[1]
    for s in range(chosen.shape[0]):
        x0 = int(np.floor(x[chosen[s]])) - size // 2
        y0 = int(np.floor(y[chosen[s]])) - size // 2
        for j in range(max(0, -y0), min(size, ny - y0)):
            for i in range(max(0, -x0), min(size, nx - x0)):
                image[y0 + j, x0 + i] += stamps[s, j, i]
