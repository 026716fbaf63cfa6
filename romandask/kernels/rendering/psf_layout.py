"""PSF models as arrays of fixed shapes, in which the models of all detectors and bands of an instrument are stored."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from romandask.kernels.rendering.psf import CORE, Grid, PsfModel

SMALLEST_EDGE = 16
"""Smallest stamp whose edge brightness is stored, pixels."""


@dataclass(frozen=True)
class PsfLayout:
    """Largest sizes of the PSF models of an instrument, in any of its bands."""

    nodes: int
    """Number of PSF nodes of a band."""
    grid: Grid
    """Frequencies of the transforms of the nodes."""
    positions: int = 0
    """Number of positions on a detector at which the variation of the PSF is sampled."""
    bright: tuple[tuple[int, Grid], ...] = ()
    """Number of nodes and frequencies of each PSF of bright stars, in increasing order of brightness."""

    @property
    def core(self) -> Grid:
        """Frequencies of the modes."""
        return Grid(min(self.grid.size, CORE), self.grid.folds)

    @property
    def shapes(self) -> dict[str, tuple[int, ...]]:
        """Shapes of the arrays of a model (see `arrays_of`), by name."""
        rows = self.nodes * (1 + self.positions)
        return {
            "layout": (7,),
            "nodes": (self.nodes, *self.grid.shape),
            "modes": (1 + rows, *self.core.shape),
            "mixing": (rows, 1 + rows),
            "peaks": (1 + rows,),
        }

    @property
    def edge_sizes(self) -> list[int]:
        """Sizes of the stamps whose edge brightness is stored, pixels."""
        return [SMALLEST_EDGE << k for k in range(self.grid.size.bit_length() - SMALLEST_EDGE.bit_length() + 1)]


def arrays_of(model: PsfModel, layout: PsfLayout) -> dict[str, np.ndarray]:
    """Return the arrays of a PSF model, filled up with zeros to the shapes of a layout.

    Parameters
    ----------
    model : PsfModel
        PSF model, not larger than the layout.
    layout : PsfLayout
        Layout of the models of the instrument.

    Returns
    -------
    dict of str to ndarray
        `layout` (size and folds of the grid, size of the core, degree, rows and columns of the detector, number of
        modes) and the arrays `nodes`, `modes`, `mixing` and `peaks` of the model.
    """
    numbers = (model.grid.size, model.grid.folds, model.core.size, model.degree, *model.shape, len(model.peaks))
    parts = {
        "layout": np.array(numbers, np.int32),
        "nodes": model.nodes,
        "modes": model.modes,
        "mixing": model.mixing,
        "peaks": model.peaks,
    }
    return {name: padded(parts[name], shape) for name, shape in layout.shapes.items()}


def model_of(arrays: Mapping[str, np.ndarray]) -> PsfModel:
    """Return the PSF model of the arrays that `arrays_of` gives."""
    size, folds, core_size, degree, ny, nx, modes = (int(value) for value in arrays["layout"])
    grid, core = Grid(size, folds), Grid(core_size, folds)
    nodes = len(arrays["nodes"])
    rows = nodes * (1 + (degree + 1) * (degree + 2) // 2 if degree else 1)
    return PsfModel(
        nodes=trimmed(arrays["nodes"], (nodes, *grid.shape)),
        grid=grid,
        core=core,
        modes=trimmed(arrays["modes"], (modes, *core.shape)),
        mixing=trimmed(arrays["mixing"], (rows, modes)),
        peaks=trimmed(arrays["peaks"], (modes,)),
        degree=degree,
        shape=(ny, nx),
    )


def padded(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return an array in the first corner of an array of zeros, or the array itself if it has the shape."""
    if values.shape == shape:
        return values
    whole = np.zeros(shape, values.dtype)
    whole[tuple(slice(length) for length in values.shape)] = values
    return whole


def trimmed(values: np.ndarray, shape: tuple[int, ...]) -> np.ndarray:
    """Return a copy of the first corner of an array, or the array itself if it has the shape."""
    return values if values.shape == shape else values[tuple(slice(length) for length in shape)].copy()
