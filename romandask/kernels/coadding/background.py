"""Estimation of the smooth background of an exposure on a mesh, and its evaluation for any window."""

from __future__ import annotations

import numba
import numpy as np
import sep
from scipy.interpolate import CubicSpline

BACKGROUND_MESH = 256
"""Side of a cell in which the background of an exposure is estimated, pixels."""
_SAMPLE_STEP = 64
"""Distance between the samples of the estimate that are stored, pixels: four for a cell, whose splines have knots."""


def mesh_shape(shape: tuple[int, int]) -> tuple[int, int]:
    """Return the shape of the background mesh of an image of a given shape."""
    ny, nx = (max(4, -(-(length - 1) // _SAMPLE_STEP) + 1) for length in shape)
    return ny, nx


def background_mesh(image: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return samples of the background that is estimated from an exposure.

    Parameters
    ----------
    image : ndarray, shape (ny, nx), electrons
        The exposure.
    mask : ndarray, shape (ny, nx), bool
        True for pixels that the estimate leaves out.

    Returns
    -------
    ndarray, shape of `mesh_shape`, float32, electrons
        The background at evenly spaced positions from the first to the last pixel of each axis.
    """
    estimate = sep.Background(image.astype(np.float32), mask=mask, bw=BACKGROUND_MESH, bh=BACKGROUND_MESH)
    y, x = (
        np.linspace(0, length - 1, count) for length, count in zip(image.shape, mesh_shape(image.shape), strict=True)
    )
    rows, columns = np.floor(y).astype(int), np.floor(x).astype(int)
    back = estimate.back(dtype=np.float32)
    # linear between the two nearest pixels: the background is smooth on the scale of a pixel
    fy, fx = (y - rows)[:, None], x - columns
    below, above = (
        back[np.ix_(r, columns)] * (1 - fx) + back[np.ix_(r, np.minimum(columns + 1, image.shape[1] - 1))] * fx
        for r in (rows, np.minimum(rows + 1, image.shape[0] - 1))
    )
    return (below * (1 - fy) + above * fy).astype(np.float32)


def background_at(mesh: np.ndarray, shape: tuple[int, int], rows: slice, columns: slice) -> np.ndarray:
    """Return a window of the background of an exposure; a pixel has the same value whatever the window is.

    Parameters
    ----------
    mesh : ndarray
        Samples, as `background_mesh` returns them.
    shape : (int, int)
        Rows and columns of the exposure.
    rows, columns : slice
        The window, with limits.

    Returns
    -------
    ndarray, shape (rows, columns), float32, electrons
    """
    y, x = (np.linspace(0, length - 1, count) for length, count in zip(shape, mesh.shape, strict=True))
    along_x = CubicSpline(x, mesh.astype(float), axis=1).c
    # splines along y of the coefficients along x, so that rows are evaluated one by one: (rows, pieces, powers)
    curves = np.transpose(CubicSpline(y, along_x, axis=2)(np.arange(rows.start, rows.stop)), (2, 1, 0))
    return _evaluated(np.ascontiguousarray(curves), x, columns.start, columns.stop)


@numba.njit(nogil=True, cache=True, error_model="numpy")
def _evaluated(curves, knots, start, stop):
    """Return cubics of each row, (rows, pieces, 4), at the columns from `start` to `stop`."""
    out = np.empty((len(curves), stop - start), np.float32)
    for row in range(len(curves)):
        piece = 0
        for column in range(start, stop):
            while piece < len(knots) - 2 and column >= knots[piece + 1]:
                piece += 1
            c, t = curves[row, piece], column - knots[piece]
            out[row, column - start] = ((c[0] * t + c[1]) * t + c[2]) * t + c[3]
    return out


def subtract_background(light: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Subtract from an image, in place, the background estimated from it on a coarse mesh.

    Parameters
    ----------
    light : ndarray, shape (ny, nx), float32
        The image. It is overwritten.
    mask : ndarray, shape (ny, nx), bool
        True for pixels that the estimate leaves out.

    Returns
    -------
    ndarray, shape (ny, nx), float32
        `light` itself.
    """
    background = sep.Background(light, mask=mask, bw=BACKGROUND_MESH, bh=BACKGROUND_MESH)
    background.subfrom(light)
    return light
