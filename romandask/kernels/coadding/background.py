"""Estimation and subtraction of the smooth background of an exposure."""

from __future__ import annotations

import numpy as np
import sep

BACKGROUND_MESH = 256
"""Side of a cell of the mesh on which the background of an exposure is estimated, pixels."""


def as_float(image: np.ndarray) -> np.ndarray:
    """Convert an image to float32, in place where its pixels have four bytes.

    Parameters
    ----------
    image : ndarray, shape (ny, nx)
        Overwritten if its pixels have four bytes and it is writeable: the caller must not use it afterwards.

    Returns
    -------
    ndarray, shape (ny, nx), float32
        A view of the memory of `image` if the conversion was made in place, else a new array.
    """
    if image.dtype.itemsize != 4 or not image.flags.writeable:
        return image.astype(np.float32)
    light = image.view(np.float32)
    # a few rows at a time, because the conversion makes a temporary copy
    for first in range(0, len(image), 256):
        light[first : first + 256] = image[first : first + 256].astype(np.float32)
    return light


def subtract_background(light: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Subtract from an exposure, in place, the background estimated from it on a coarse mesh.

    Parameters
    ----------
    light : ndarray, shape (ny, nx), float32, electrons
        The exposure. It is overwritten.
    mask : ndarray, shape (ny, nx), bool
        True for pixels that the estimate leaves out.

    Returns
    -------
    ndarray, shape (ny, nx), float32, electrons
        `light` itself.
    """
    background = sep.Background(light, mask=mask, bw=BACKGROUND_MESH, bh=BACKGROUND_MESH)
    background.subfrom(light)
    return light
