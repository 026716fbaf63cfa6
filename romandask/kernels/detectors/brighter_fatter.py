"""Brighter-fatter effect: the charge in pixels shifts the boundaries between pixels, which moves charge.

The measured kernel is the relative change of a pixel's area for one electron in each of the pixels around it. Symmetry
determines how the change is divided among the four boundaries: the shifts are differences of a potential, because they
follow from a curl-free field. The area kernel is then the discrete Laplacian of the potential, and the division is
unique.
"""

from __future__ import annotations

import numba
import numpy as np

REACH = 2
"""Half the width of the kernels, pixels: a kernel has (2 REACH + 1)^2 = 5 x 5 pixels."""
_KERNEL_PIXELS = 2 * REACH + 1


def potentials(areas: np.ndarray) -> np.ndarray:
    """Return the potentials of area kernels.

    Parameters
    ----------
    areas : ndarray, shape (..., 5, 5), 1/electron
        Relative change of a pixel's area for one electron at (dy, dx); the pixel itself is in the middle.

    Returns
    -------
    ndarray, shape (..., 7, 7), 1/electron
        Potentials, zero on the outer ring. Their Laplacian is minus the kernel in all of its 5 x 5 cells.

    Notes
    -----
    The area that a pixel loses is gained by its neighbour. A kernel whose sum is not zero therefore moves area to the
    pixels just beyond the kernel.
    """
    n = _KERNEL_PIXELS * _KERNEL_PIXELS
    operator = np.zeros((n, n))
    for j in range(_KERNEL_PIXELS):
        for i in range(_KERNEL_PIXELS):
            cell = j * _KERNEL_PIXELS + i
            operator[cell, cell] = 4.0
            for b, a in ((j - 1, i), (j + 1, i), (j, i - 1), (j, i + 1)):
                if 0 <= b < _KERNEL_PIXELS and 0 <= a < _KERNEL_PIXELS:
                    operator[cell, b * _KERNEL_PIXELS + a] = -1.0
    flat = np.asarray(areas, float).reshape(-1, n)
    inner = np.linalg.solve(operator, flat.T).T.reshape(-1, _KERNEL_PIXELS, _KERNEL_PIXELS)
    padded = np.pad(inner, ((0, 0), (1, 1), (1, 1)))
    return padded.reshape(*np.shape(areas)[:-2], _KERNEL_PIXELS + 2, _KERNEL_PIXELS + 2)


def brighter_fatter(charge: np.ndarray, areas: np.ndarray, block: int, origin: tuple[int, int] = (0, 0)) -> np.ndarray:
    """Return the charge after the brighter-fatter effect; its total is conserved.

    Parameters
    ----------
    charge : ndarray, shape (ny, nx), float32, electrons
        Charge at the end of the exposure, without the effect.
    areas : ndarray, shape (5, 5, blocks y, blocks x), 1/electron
        Area kernels, axes (dy, dx), one for each block of pixels.
    block : int
        Pixels along a side of a block.
    origin : tuple of int
        Row and column, on the whole detector, of the first pixel.

    Returns
    -------
    ndarray, shape (ny, nx), float32, electrons

    Notes
    -----
    The charge that shifts a boundary is half of the final charge, the mean over the exposure. The charge that a shifted
    boundary moves is its shift times the mean charge of the two pixels on either side. Each boundary is shifted once,
    as the right or the top boundary of a pixel. Charge does not leave the image (Antilogus et al. 2014; Hirata & Choi
    2020).
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
        # potential, at the pixels of this row and the next, of the charge around them
        for row in range(2):
            if row == 0 and y > 0:
                field[0] = field[1]
                continue
            source_row = y + row
            if source_row >= ny:
                continue
            _potential(padded, potential, block, first_row + source_row, first_column, source_row, field[row])
        # the shift of a boundary is the difference of the potential across it, on average half of the final one
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
    """Write, for each pixel of a row, the potential of the charge around it; the outer ring of the kernels is zero."""
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
                line = padded[row + j]
                out[k] += p1 * line[k + 1] + p2 * line[k + 2] + p3 * line[k + 3] + p4 * line[k + 4] + p5 * line[k + 5]
        x = end
