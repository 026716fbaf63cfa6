"""Light of a PSF outside small stamps, in square rings of cells that grow with the distance from the star.

Ring k reaches from the square of 16 * 2^k pixels to that of twice the side, and its cells have sides of 2 * 2^k pixels.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

FIRST_SIDE = 16
"""Inner side of the first ring, pixels."""
FIRST_CELL = 2
"""Side of the cells of the first ring, pixels."""
PHASES = 4
"""Number of positions in a cell, along each axis, for which the cells of a ring are known."""
REACH = FIRST_SIDE // FIRST_CELL
"""Cells from the cell of the star to the outermost cell of a ring."""


@dataclass(frozen=True)
class Rings:
    """Rings of the PSFs of a band's nodes in the middle of a detector; their cells are those of the mean PSF."""

    shares: np.ndarray
    """Fraction of the light of each node in each ring, shape (rings, nodes)."""
    cells: np.ndarray
    """Fractions of the light of each ring in its cells, shape (rings, PHASES, PHASES, 2 REACH + 1, 2 REACH + 1).

    The axes are the phase along y and along x, and the row and the column of the cell. A star of phase p is at
    (p + 1/2) / PHASES of the cell in the middle."""

    def outside(self, photons: np.ndarray, side: np.ndarray) -> np.ndarray:
        """Return the electrons of n point sources outside squares around them, by ring, shape (n, rings).

        Parameters
        ----------
        photons : array, shape (n, nodes)
            Electrons of each source at each node.
        side : int array, shape (n,), pixels
            Sides of the squares, powers of two.
        """
        inner = FIRST_SIDE << np.arange(len(self.shares))
        return (photons @ self.shares.T) * (inner >= np.asarray(side)[:, None])


def rings(images: Sequence[np.ndarray], folds: int, size: int) -> Rings:
    """Return the rings of PSFs up to the edge of their images.

    Parameters
    ----------
    images : sequence of array, shape (folds * size, folds * size)
        Images of unit stars, oversampled by `folds`, centred on the sample folds * size / 2; one per node.
    folds : int
        Oversampling.
    size : int
        Side of the images, pixels, a power of two.
    """
    count = max(int(np.log2(size // FIRST_SIDE)), 0)
    shares = np.zeros((count, len(images)))
    for node, image in enumerate(images):
        inside = [_middle(image, FIRST_SIDE * folds << k).sum(dtype=float) for k in range(count + 1)]
        shares[:, node] = np.maximum(np.diff(inside), 0) / folds**2
    mean = np.mean(images, axis=0) if count else np.zeros((0, 0))
    cells = np.empty((count, PHASES, PHASES, 2 * REACH + 1, 2 * REACH + 1), np.float32)
    for k in range(count):
        inner = FIRST_SIDE * folds << k
        # noise of the transform must not give cells of negative light
        ring = np.maximum(_middle(mean, 2 * inner), 0)
        _middle(ring, inner)[:] = 0
        cells[k] = _in_cells(ring)
    return Rings(shares, cells)


def power_law_cells() -> np.ndarray:
    """Return `Rings.cells` of a PSF that falls as r^-3, the mean of a diffraction pattern; it is the same in all rings.

    Returns
    -------
    float32 array, shape (PHASES, PHASES, 2 REACH + 1, 2 REACH + 1)
    """
    side = 2 * FIRST_SIDE * PHASES
    offset = np.arange(side) - side // 2 + 0.5
    ring = np.hypot(offset[:, None], offset[None, :]) ** -3
    _middle(ring, side // 2)[:] = 0
    return _in_cells(ring)


def _in_cells(ring: np.ndarray) -> np.ndarray:
    """Return the fractions of the light of a ring in its cells, for each phase; uniform if the ring has no light.

    `ring` is the oversampled image of the ring, whose side is 2 REACH cells.
    """
    samples = (np.arange(len(ring)) - len(ring) // 2) / (len(ring) / (2 * REACH))
    if not ring.sum() > 0:
        ring = np.ones_like(ring)
        _middle(ring, len(ring) // 2)[:] = 0
    out = np.empty((PHASES, PHASES, 2 * REACH + 1, 2 * REACH + 1), np.float32)
    number = np.arange(-REACH, REACH + 1)[:, None]
    bins = [(np.floor(samples + (p + 0.5) / PHASES) == number).astype(ring.dtype) for p in range(PHASES)]
    for up in range(PHASES):
        rows = bins[up] @ ring
        for across in range(PHASES):
            out[up, across] = rows @ bins[across].T
    return out / out.sum(axis=(2, 3), keepdims=True)


def _middle(image: np.ndarray, side: int) -> np.ndarray:
    """Return a view of the middle of an image; its centre stays on the sample len(image) / 2."""
    low = len(image) // 2 - side // 2
    return image[low : low + side, low : low + side]
