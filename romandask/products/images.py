"""Image products: lazy images over units, each read from the store if it is stored, otherwise made."""

from __future__ import annotations

import uuid
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import numpy as np
import pyarrow as pa
import xarray as xr
import zarr

from romandask.model.errors import UserError
from romandask.model.tiles import PatchGrid
from romandask.products.lazy_dataset import Coordinates, lazy_dataset
from romandask.products.mosaic import Mosaic, evaluated, from_memory
from romandask.products.tables import conform, to_frame
from romandask.products.units import Made, Unit, names_of
from romandask.storage.arrays import (
    Layout,
    Variable,
    limited_concurrency,
    open_images,
    read_group,
    write_array,
    write_coordinate,
    write_group,
)
from romandask.storage.checksums import image_metadata_files
from romandask.storage.manifest import digest, read_record
from romandask.storage.paths import AnyPath
from romandask.storage.store import Store, read_parquet, write_parquet

_NO_TABLES: Mapping[str, bytes] = MappingProxyType({})


@dataclass(frozen=True, repr=False, kw_only=True)
class ImageProduct:
    """Images over units. `dataset` is the lazy xarray view."""

    stage: str
    """Name of the stage, for example exposures/roman; also the path of the product in the store."""
    units: Sequence[Unit]
    """Units of the product, in C order along `axes`."""
    make: Callable[[int], dict[str, Any]]
    """Makes the arrays of the unit with a given index, by name.

    An array may be given as a function without arguments that returns it; it is called when the array is needed.
    """
    variables: tuple[Variable, ...]
    """Arrays of the product."""
    axes: tuple[str, ...]
    """Names of the axes over units."""
    lengths: tuple[int, ...]
    """Number of units along each of `axes`."""
    coordinates: Callable[[], Coordinates]
    """Returns the coordinates; called only when they are needed, because the headers of many exposures take time."""
    attributes: dict[str, Any] = field(default_factory=dict)
    """Attributes of the Zarr group and of `dataset`."""
    bytes_per_unit: int = 0
    """Peak memory of making one unit, bytes, in addition to what a worker holds between units."""
    seconds_per_unit: float = 0.0
    """Time to make one unit on one core of a laptop, s; used for planning."""
    store: Store | None = None
    """Store that stored units are read from; without one, every unit is made."""
    stream: Callable[[int], Iterator[tuple[str, np.ndarray]]] | None = None
    """Makes the arrays of a unit one after another, for units that do not fit the memory of a worker as a whole."""
    tables: dict[str, pa.Schema] = field(default_factory=dict)
    """Schemas, by name, of tables that `make` returns in addition to the arrays; they may have any number of rows."""
    patches: PatchGrid | None = None
    """Division of images into patches. With it a unit is one patch, and the units are in C order along `axes`, patch
    row and patch column. An image (a variable with the axes y and x; its shape is that of the whole image) is stored as
    one array, of which each unit makes and writes the part in its patch. Other variables belong to a patch."""

    def __repr__(self) -> str:
        # the generated repr would include `make`, and through it all upstream products
        return f"ImageProduct({self.stage}, {len(self.units)} units)"

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the units."""
        return names_of(self.units)

    @property
    def product(self) -> ImageProduct:
        """The product itself: a stage may build it bare, or in a value that says more of it."""
        return self

    def stored(self, store: Store) -> ImageProduct:
        """Return the product with `store`, from which its stored units are read."""
        return replace(self, store=store)

    def has(self, index: int) -> bool:
        """Return whether a unit is stored."""
        return self.store is not None and read_record(self.store, self.stage, self.names[index]) is not None

    def load(self, index: int, names: tuple[str, ...] | None = None, window: tuple[slice, ...] = ()) -> dict[str, Any]:
        """Return the arrays of a unit: read if the manifest has a record of it, otherwise made.

        Parameters
        ----------
        index : int
            Index of the unit.
        names : tuple of str, optional
            Names of the arrays, and of tables, to return; by default all arrays and no table.
        window : tuple of slice
            Window of the last axes of each array of the unit; by default the full array. Tables are always complete.
        """
        wanted = [variable.name for variable in self.variables if names is None or variable.name in names]
        tables = [name for name in self.tables if name in (names or ())]
        if self.store is not None and self.has(index):
            read = self.reader(index)
            paths = {name: table_beside(self.store, self.stage, name, self.names[index]) for name in tables}
            frames = {name: to_frame(read_parquet(path)) for name, path in paths.items()}
            return {**{name: read(name, window) for name in wanted}, **frames}
        made = self.make(index)
        return {
            **{name: evaluated(made[name])[(..., *window)] for name in wanted},
            **{name: made[name] for name in tables},
        }

    def reader(self, unit: int) -> Callable[[str, tuple[slice, ...]], np.ndarray]:
        """Return a function that reads arrays of a stored unit; it opens each array once.

        Returns
        -------
        callable
            read(name, window) returns an array, or a window of its last axes. It raises a UserError if the stored
            data are damaged or missing.
        """
        assert self.store is not None
        group = read_group(self.store.images(self.stage))
        opened: dict[str, zarr.Array] = {}

        def read(name: str, window: tuple[slice, ...] = ()) -> np.ndarray:
            if name not in opened:
                opened[name] = _array(group, name)
            index: Any = self.layout.stored_index(name, unit, window)
            # arrays without shards are not compressed, so reading many of their chunks at a time takes little memory
            with self._damage_reported(name, unit), limited_concurrency() if opened[name].shards else nullcontext():
                return np.asarray(opened[name][index])

        return read

    @contextmanager
    def _damage_reported(self, name: str, unit: int) -> Iterator[None]:
        """Turn the errors of decoders into a UserError that names the array and the remedy."""
        try:
            yield
        except (FileNotFoundError, ValueError, RuntimeError) as error:
            reason = str(error).splitlines()[0] if str(error) else type(error).__name__
            damage = f"{self.stage} {self.names[unit]}: {name} is damaged ({reason})"
            raise UserError(f"{damage}: romandask verify --forget, then run again") from error

    @property
    def stored_bytes(self) -> int:
        """Uncompressed bytes of the images of all units."""
        leading = {v.name: self.layout.leading(v)[1] for v in self.variables}
        return sum(int(np.prod((*leading[v.name], *v.shape))) * np.dtype(v.dtype).itemsize for v in self.variables)

    def metadata_files(self, store: Store) -> list[AnyPath]:
        """Return the stored files that belong to no unit: metadata of the arrays, and coordinates."""
        return image_metadata_files(store, self.stage, [variable.name for variable in self.variables])

    def prepare(self, store: Store) -> None:
        """Create the arrays that units are written into, and write the coordinates; leave what is stored already."""
        if not self.units:
            return
        group = open_images(store.images(self.stage), self.layout)
        for name, (axes, values, attributes) in self.coordinates().items():
            write_coordinate(group, name, values, axes, attributes)
        if any(group.attrs.get(key) != value for key, value in self.attributes.items()):
            group.attrs.update(self.attributes)

    def write(self, index: int, store: Store) -> Made:
        """Make one unit and write it. No other unit shares its shards, so units can be written concurrently."""
        if self.stream is not None:
            return self._write_arrays(self.stream(index), index, store)
        # a copy, because arrays are removed below and `make` may keep the dictionary
        arrays = dict(self.make(index))
        tables = {
            name: write_parquet(
                table_beside(store, self.stage, name, self.names[index]), conform(arrays[name], schema, name)
            )
            for name, schema in self.tables.items()
        }
        # each array is freed once it is written
        return self._write_arrays(
            ((v.name, evaluated(arrays.pop(v.name))) for v in self.variables), index, store, tables
        )

    def verify(self, index: int, store: Store) -> str:
        """Return the hash of a stored unit; it equals `Record.output` if the unit is undamaged."""
        read = replace(self, store=store).reader(index)
        parts = {variable.name: _hash(variable, read(variable.name, ())) for variable in self.variables}
        paths = {name: table_beside(store, self.stage, name, self.names[index]) for name in self.tables}
        return digest(parts | {name: digest(path.read_bytes()) for name, path in paths.items()})

    def _write_arrays(
        self,
        arrays: Iterable[tuple[str, np.ndarray]],
        index: int,
        store: Store,
        tables: Mapping[str, bytes] = _NO_TABLES,
    ) -> Made:
        """Write the arrays of a unit one after another; `tables` are the contents of its table files, for the hash."""
        variables = {variable.name: variable for variable in self.variables}
        parts, size, rows = {name: digest(content) for name, content in tables.items()}, 0, 0
        group = write_group(store.images(self.stage))
        for name, array in arrays:
            variable = variables.pop(name)
            lead, corner, shape = self.layout.location(variable, index)
            if array.shape != shape or not np.isfinite(array).all():
                raise ValueError(
                    f"{self.stage} {self.names[index]}: {variable.name} has shape {array.shape}, expected "
                    f"{shape}, or values that are not finite"
                )
            array = array.astype(variable.dtype, copy=False)
            write_array(_array(group, variable.name), lead, array, corner)
            parts[name] = _hash(variable, array)
            size, rows = size + array.nbytes, max(rows, array.size)
            del array
        if variables:
            raise ValueError(f"{self.stage} {self.names[index]}: {', '.join(variables)} were not made")
        return Made(digest(parts), size, rows)

    @cached_property
    def layout(self) -> Layout:
        """Where the values of each unit are in the stored arrays."""
        return Layout(self.variables, self.axes, self.lengths, self.patches)

    def image(self, *place: int) -> Mosaic:
        """Return a reader of windows of a whole image, across its patches.

        Parameters
        ----------
        *place : int
            Indices of the image along `axes`.
        """
        return Mosaic(
            self.layout, place, lambda unit: self.reader(unit) if self.has(unit) else from_memory(self.make(unit))
        )

    @cached_property
    def dataset(self) -> xr.Dataset:
        """The lazy dataset, with one chunk per unit. The variables of a unit are read or made together, once."""
        # a name of its own, as the settings of the units do not say what the units are made from
        name = f"{self.stage.replace('/', '-')}-{uuid.uuid4().hex}"
        return lazy_dataset(name, self.layout, self, self.coordinates(), self.attributes)


def table_beside(store: Store, stage: str, name: str, unit: str) -> AnyPath:
    """Return the file of a table (a name in `ImageProduct.tables`) of one unit of an image product."""
    return store.table(f"{stage}_{name}", unit)


def _hash(variable: Variable, values: np.ndarray) -> str:
    """Return the hash of the values of a unit; those outside the part that is not of the fill value are left out."""
    if not variable.fill:
        return digest(values)
    other = values != variable.fill
    part = tuple(
        slice(int(used[0]), int(used[-1]) + 1) if len(used := np.flatnonzero(other.any(axis=1 - axis))) else slice(0)
        for axis in range(2)
    )
    return digest(values.shape, [(place.start, place.stop) for place in part], values[part])


def _array(group: zarr.Group, name: str) -> Any:
    array = group[name]
    assert isinstance(array, zarr.Array)
    return array
