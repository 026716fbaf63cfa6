"""Images across the patches that they are made and stored in: a reader of windows of the whole image."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np

from romandask.storage.arrays import Layout, limited

Read = Callable[[str, tuple[slice, ...]], np.ndarray]
"""Function that returns a window of the last axes of an array with a name."""


class Mosaic:
    """One image of a product, as a function that returns windows of its arrays.

    Patches that are stored are read, window by window. Others are made when a window first touches them, and kept for
    as long as the object lives.

    Parameters
    ----------
    layout : Layout
        Arrays and patches of the product.
    place : tuple of int
        Indices of the image along the product's `axes`.
    opened : callable
        Returns a reader of the arrays of the unit with an index.
    """

    def __init__(self, layout: Layout, place: tuple[int, ...], opened: Callable[[int], Read]):
        self._layout, self._place, self._opened = layout, place, opened
        self._readers: dict[int, Read] = {}

    def __call__(self, name: str, window: tuple[slice, ...] = ()) -> np.ndarray:
        """Return a window of an array of the image.

        Parameters
        ----------
        name : str
            Name of a variable with the axes y and x.
        window : tuple of slice
            Window of the last axes, in pixels of the whole image; by default the whole image. Only the window is held
            in memory, besides the patches that are not stored.
        """
        layout = self._layout
        variable, patches = layout.variable(name), layout.patches
        if patches is None:
            return self._unit(layout.unit(*self._place))(name, window)
        if not variable.is_image:
            raise ValueError(f"{name} belongs to patches, not to a whole image")
        rows, columns = limited(window[-2:], variable.shape[-2:])
        all_planes = (slice(None),) * len(variable.shape[:-2])
        planes = [
            range(length)[part] for length, part in zip(variable.shape[:-2], window[:-2] or all_planes, strict=True)
        ]
        shape = (*map(len, planes), rows.stop - rows.start, columns.stop - columns.start)
        out = np.empty(shape, variable.dtype)
        for row, column in patches.touching((rows, columns)):
            patch = patches.window(row, column)
            low = [max(w.start, p.start) for w, p in zip((rows, columns), patch, strict=True)]
            high = [min(w.stop, p.stop) for w, p in zip((rows, columns), patch, strict=True)]
            inside = _window(low, high, (patch[0].start, patch[1].start))
            target: Any = (..., *_window(low, high, (rows.start, columns.start)))
            index = layout.unit(*self._place, row, column)
            out[target] = self._unit(index)(name, (*window[:-2], *inside))
        return out

    def _unit(self, index: int) -> Read:
        """Return a reader of the arrays of a unit."""
        if index not in self._readers:
            self._readers[index] = self._opened(index)
        return self._readers[index]


def evaluated(array: Any) -> Any:
    """Return an array, or the result of the function that makes it."""
    return array() if callable(array) else array


def from_memory(made: dict[str, Any]) -> Read:
    """Return a reader of arrays in memory."""

    def read(name: str, window: tuple[slice, ...] = ()) -> np.ndarray:
        return evaluated(made[name])[(..., *window)].copy()

    return read


def _window(low: list[int], high: list[int], corner: tuple[int, int]) -> tuple[slice, ...]:
    """Return the slices from `low` to `high`, counted from a corner."""
    return tuple(slice(a - c, b - c) for a, b, c in zip(low, high, corner, strict=True))
