"""Brighter-fatter effect: the boundaries of pixels move with the charge around them, and take charge along.

The measured kernel says by which share of its area a pixel changes for one electron in each pixel around it. How the
change is split among the four boundaries follows from symmetry: shifts are differences of a potential, as those of a
field without curl are, so that the area kernel is its discrete Laplacian and the split is unique.
"""

from __future__ import annotations

import numba
import numpy as np

REACH = 2
"""Kernels are (2 REACH + 1)^2: 5 x 5."""
_KERNEL_PIXELS = 2 * REACH + 1


def potentials(areas: np.ndarray) -> np.ndarray:
    """Return the potentials (..., 7, 7), 1/electron, of area kernels (..., 5, 5): zero on the outer ring.

    Parameters
    ----------
    areas : change of a pixel's area, share of it, for one electron at (dy, dx), the pixel itself in the middle

    The Laplacian of the result is minus the kernel in all of its 5 x 5 cells. A kernel whose sum is not zero moves area
    to the pixels just beyond it, for what one pixel loses its neighbour gains.
    """
    n = _KERNEL_PIXELS * _KERNEL_PIXELS
    operator = np.zeros((n, n))
    for j in range(_KERNEL_PIXELS):
        for i in range(_KERNEL_PIXELS):
            here = j * _KERNEL_PIXELS + i
            operator[here, here] = 4.0
            for b, a in ((j - 1, i), (j + 1, i), (j, i - 1), (j, i + 1)):
                if 0 <= b < _KERNEL_PIXELS and 0 <= a < _KERNEL_PIXELS:
                    operator[here, b * _KERNEL_PIXELS + a] = -1.0
    flat = np.asarray(areas, float).reshape(-1, n)
    inner = np.linalg.solve(operator, flat.T).T.reshape(-1, _KERNEL_PIXELS, _KERNEL_PIXELS)
    padded = np.pad(inner, ((0, 0), (1, 1), (1, 1)))
    return padded.reshape(*np.shape(areas)[:-2], _KERNEL_PIXELS + 2, _KERNEL_PIXELS + 2)


def brighter_fatter(charge: np.ndarray, areas: np.ndarray, block: int, origin: tuple[int, int] = (0, 0)) -> np.ndarray:
    """Return charge (ny, nx), electrons, after the boundaries of pixels have moved; the total is the same.

    Parameters
    ----------
    charge : (ny, nx) float32, electrons at the end of the exposure
    areas : (5, 5, blocks y, blocks x) area kernels, 1/electron, axes (dy, dx): a block's pixels share one
    block : pixels along a side of a block
    origin : row and column of the first pixel on the whole detector

    While the charge collects it is on average half of what it is in the end, and the charge that a boundary passes over
    is the mean of the two pixels that it parts. Each boundary is moved once: of every pixel the right and the top one.
    Charge does not leave the image. (Antilogus et al. 2014; Hirata & Choi 2020.)
    """
    potential = potentials(np.moveaxis(np.asarray(areas, float), (0, 1), (2, 3))).astype(np.float32)
    charge = np.ascontiguousarray(charge, np.float32)
    padded = np.pad(charge, REACH + 1)
    return _move(charge, padded, potential, block, origin[0], origin[1])


@numba.njit(nogil=True, cache=True)
def _move(charge, padded, potential, block, first_row, first_column):
    ny, nx = charge.shape
    field = np.empty((2, nx), np.float32)
    out = charge.copy()
    moved = np.empty(nx, np.float32)
    for y in range(ny):
        # the potential at the pixels of this row and of the next, each of the charge around it
        for row in range(2):
            if row == 0 and y > 0:
                field[0] = field[1]
                continue
            at = y + row
            if at >= ny:
                continue
            _potential(padded, potential, block, first_row + at, first_column, at, field[row])
        # a boundary moves by the step of the potential across it, half of the final one on average
        for x in range(nx - 1):
            shift = np.float32(0.5) * (field[0, x] - field[0, x + 1])
            moved[x] = shift * np.float32(0.5) * (charge[y, x] + charge[y, x + 1])
        for x in range(nx - 1):
            out[y, x] += moved[x]
        for x in range(nx - 1):
            out[y, x + 1] -= moved[x]
        if y + 1 < ny:
            for x in range(nx):
                shift = np.float32(0.5) * (field[0, x] - field[1, x])
                moved[x] = shift * np.float32(0.5) * (charge[y, x] + charge[y + 1, x])
            for x in range(nx):
                out[y, x] += moved[x]
                out[y + 1, x] -= moved[x]
    return out


@numba.njit(nogil=True, cache=True)
def _potential(padded, potential, block, detector_row, first_column, row, out):
    """Write the potential of the charge around each pixel of a row; the outer ring of the kernels is zero."""
    nx = out.shape[0]
    out[:] = 0
    b = detector_row // block
    x = 0
    while x < nx:
        a = (first_column + x) // block
        end = min(nx, (a + 1) * block - first_column)
        for j in range(1, 6):
            p1, p2, p3, p4, p5 = potential[b, a, j, 1:6]
            for k in range(x, end):
                here = padded[row + j]
                out[k] += p1 * here[k + 1] + p2 * here[k + 2] + p3 * here[k + 3] + p4 * here[k + 4] + p5 * here[k + 5]
        x = end
