"""The lazy xarray view of an image product: a chunk is a unit, of which all variables are read or made together."""

from __future__ import annotations

from typing import Any, Protocol

import dask
import dask.array as da
import numpy as np
import xarray as xr

from romandask.storage.arrays import Layout, Variable

Coordinates = dict[str, tuple[tuple[str, ...], np.ndarray, dict]]
"""Axes, values and attributes of each coordinate, by name."""
LONGEST_SHOWN_TEXT = 100
"""Characters up to which a text coordinate is shown in the repr of a dataset."""


class Loads(Protocol):
    """What the chunks of a dataset are loaded from: an image product."""

    def load(self, index: int) -> dict[str, Any]:
        """Return the arrays of a unit, by name."""


def lazy_dataset(
    name: str, layout: Layout, source: Loads, coordinates: Coordinates, attributes: dict[str, Any]
) -> xr.Dataset:
    """Return the lazy dataset of an image product, with one chunk per unit.

    Parameters
    ----------
    name : str
        Prefix of the names of the tasks; no other dataset may have it.
    layout : Layout
        Arrays of the product, and its units.
    source : Loads
        The product.
    coordinates : Coordinates
    attributes : dict
        Attributes of the dataset.
    """
    chunks = tuple((1,) * length for length in layout.unit_lengths)
    bundles = da.map_blocks(
        _load_block,
        dask.delayed(source, name=f"{name}-product", traverse=False),
        layout.unit_lengths,
        chunks=chunks,
        dtype=object,
        name=f"{name}-unit",
        meta=np.empty((0,) * len(chunks), object),
    )
    data = {}
    for variable in layout.variables:
        array = _variable_array(layout, variable, bundles, f"{name}-{variable.name}")
        data[variable.name] = ((*layout.leading(variable)[0], *variable.axes), array, variable.attributes)
    values = {key: (axes, _coordinate_values(values), extra) for key, (axes, values, extra) in coordinates.items()}
    return xr.Dataset(data, values, attributes)


def _variable_array(layout: Layout, variable: Variable, bundles: da.Array, name: str) -> da.Array:
    """Return the lazy array of a variable, made of the bundles of all variables of each unit."""
    units = tuple(range(bundles.ndim))
    own = tuple(range(bundles.ndim, bundles.ndim + len(variable.shape)))
    lengths = dict(zip(own, variable.shape, strict=True))
    out, sizes = units + own, None
    if layout.patches is not None and variable.is_image:
        # the blocks along the patches' axes are those along y and x
        patch_axes = units[-2:]
        out = (*units[:-2], *own[:-2], *patch_axes)
        lengths = {axis: lengths[axis] for axis in own[:-2]}
        limits = [layout.patches.window(k, k)[0] for k in range(layout.patches.count)]
        side = tuple(part.stop - part.start for part in limits)
        sizes = dict.fromkeys(patch_axes, side)
    return da.blockwise(
        _pick,
        out,
        bundles,
        units,
        variable.name,
        None,
        len(out) - len(variable.shape),
        None,
        new_axes=lengths,
        adjust_chunks=sizes,
        dtype=variable.dtype,
        meta=np.empty((0,) * len(out), variable.dtype),
        name=name,
    )


def _coordinate_values(values: np.ndarray) -> Any:
    """Return the values of a coordinate as xarray takes them: long texts, which would fill a repr, as a lazy array."""
    if values.dtype != object:
        return values
    texts = values.astype(str)
    return da.from_array(texts, chunks=-1) if texts.dtype.itemsize > 4 * LONGEST_SHOWN_TEXT else texts


def _load_block(source: Loads, lengths: tuple[int, ...], block_id: tuple[int, ...] = ()) -> np.ndarray:
    bundle = np.empty((1,) * len(lengths), object)
    bundle.flat[0] = source.load(int(np.ravel_multi_index(block_id, lengths)))
    return bundle


def _pick(bundle: np.ndarray, name: str, leading: int) -> np.ndarray:
    return bundle.flat[0][name][(None,) * leading]
