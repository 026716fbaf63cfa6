"""The smooth background of an exposure."""

from __future__ import annotations

import numpy as np
import sep

BACKGROUND_MESH = 256
"""Pixels of the mesh on which an exposure's background is estimated."""


def as_float(image: np.ndarray) -> np.ndarray:
    """Return an image as float32, in its own place where its pixels have four bytes: it is of no use any more."""
    if image.dtype.itemsize != 4 or not image.flags.writeable:
        return image.astype(np.float32)
    light = image.view(np.float32)
    # some rows at a time, for a copy of each is made on the way
    for first in range(0, len(image), 256):
        light[first : first + 256] = image[first : first + 256].astype(np.float32)
    return light


def subtract_background(light: np.ndarray, mask: np.ndarray) -> np.ndarray:
    """Return an exposure (float32, electrons), changed, less its background, estimated from it on a coarse mesh."""
    background = sep.Background(light, mask=mask, bw=BACKGROUND_MESH, bh=BACKGROUND_MESH)
    background.subfrom(light)
    return light
