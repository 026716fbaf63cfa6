"""Image products: lazy images over units, each read from the store where it is and made where it is not."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, nullcontext
from dataclasses import dataclass, field, replace
from functools import cached_property
from types import MappingProxyType
from typing import Any

import dask
import dask.array as da
import numpy as np
import pyarrow as pa
import xarray as xr
import zarr

from romandask.model.errors import UserError
from romandask.products.tables import conform, to_frame
from romandask.products.units import Made, Unit, names_of
from romandask.storage.arrays import (
    Variable,
    limited_concurrency,
    open_images,
    read_group,
    write_array,
    write_coordinate,
    write_group,
)
from romandask.storage.manifest import digest, read_record
from romandask.storage.paths import AnyPath
from romandask.storage.store import Store, read_parquet, write_parquet

NOTHING: Mapping[str, bytes] = MappingProxyType({})
Coordinates = dict[str, tuple[tuple[str, ...], np.ndarray, dict]]
"""By name: axes, values, attributes."""


@dataclass(frozen=True, repr=False, kw_only=True)
class ImageProduct:
    """Images over units; `dataset` is the lazy xarray view."""

    stage: str
    """For example exposures/roman; also its place in the store."""
    units: Sequence[Unit]
    make: Callable[[int], dict[str, Any]]
    """Makes the arrays of one unit; one may be a function of no arguments, which makes it when it is wanted."""
    variables: tuple[Variable, ...]
    axes: tuple[str, ...]
    """Names of the axes over units."""
    lengths: tuple[int, ...]
    """Their lengths; units are in C order."""
    coordinates: Callable[[], Coordinates]
    """Values along the axes; asked for only when images are, for headers of many exposures take their time."""
    attributes: dict[str, Any] = field(default_factory=dict)
    bytes_per_unit: int = 0
    """Peak memory, bytes, of making one unit beyond the interpreter."""
    seconds_per_unit: float = 0.0
    """Time, seconds of a core as measured on a laptop, of making one unit: for plans."""
    store: Store | None = None
    stream: Callable[[int], Iterator[tuple[str, np.ndarray]]] | None = None
    """Makes the arrays of one unit one after another, where all at once would not fit a worker."""
    tables: dict[str, pa.Schema] = field(default_factory=dict)
    """Tables that `make` returns beside the arrays of a unit, of any number of rows."""

    def __repr__(self) -> str:
        # what makes it holds the products that it reads, and those theirs
        return f"ImageProduct({self.stage}, {len(self.units)} units)"

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the units."""
        return names_of(self.units)

    def stored(self, store: Store) -> ImageProduct:
        """Return the same product, reading what the store has."""
        return replace(self, store=store)

    def has(self, index: int) -> bool:
        """True where the store has a unit."""
        return self.store is not None and read_record(self.store, self.stage, self.names[index]) is not None

    def load(self, index: int, names: tuple[str, ...] | None = None, window: tuple[slice, ...] = ()) -> dict[str, Any]:
        """Return the arrays of a unit, or a window of their last axes: read where the manifest has it, made where not.

        Tables of the unit are among them, whole, where `names` has theirs.
        """
        wanted = [variable.name for variable in self.variables if names is None or variable.name in names]
        tables = [name for name in self.tables if name in (names or ())]
        if self.store is not None and self.has(index):
            read = self.reader(index)
            beside = {name: table_beside(self.store, self.stage, name, self.names[index]) for name in tables}
            found = {name: to_frame(read_parquet(path)) for name, path in beside.items()}
            return {**{name: read(name, window) for name in wanted}, **found}
        made = self.make(index)
        return {**{name: _made(made[name])[(..., *window)] for name in wanted}, **{name: made[name] for name in tables}}

    def reader(self, unit: int) -> Callable[[str, tuple[slice, ...]], np.ndarray]:
        """Return what reads windows of the last axes of arrays of a stored unit: each is opened once."""
        assert self.store is not None
        group = read_group(self.store.images(self.stage))
        place = self._place(unit)
        opened: dict[str, zarr.Array] = {}

        def read(name: str, window: tuple[slice, ...] = ()) -> np.ndarray:
            if name not in opened:
                opened[name] = _array(group, name)
            index: Any = (*place, ..., *window)
            # what is not compressed has no files in parts: its chunks are read as they are, ten at a time
            with self._damage_told(name, unit), limited_concurrency() if opened[name].shards else nullcontext():
                return np.asarray(opened[name][index])

        return read

    @contextmanager
    def _damage_told(self, name: str, unit: int) -> Iterator[None]:
        """Turn what a decoder makes of damaged bytes into a UserError that names the array and the remedy."""
        try:
            yield
        except (FileNotFoundError, ValueError, RuntimeError) as error:
            found = str(error).splitlines()[0] if str(error) else type(error).__name__
            what = f"{self.stage} {self.names[unit]}: {name} is damaged ({found})"
            raise UserError(f"{what}: romandask verify --forget, then run again") from error

    def prepare(self, store: Store) -> None:
        """Make the arrays and coordinates that units are written into."""
        if not self.units:
            return
        group = open_images(store.images(self.stage), self.variables, self.lengths, self.axes)
        for name, (axes, values, attributes) in self.coordinates().items():
            write_coordinate(group, name, values, axes, attributes)
        group.attrs.update(self.attributes)

    def write(self, index: int, store: Store) -> Made:
        """Make one unit and write it; no other unit shares its shards."""
        if self.stream is not None:
            return self._written(self.stream(index), index, store)
        # what is made may be what the maker keeps
        arrays = dict(self.make(index))
        tables = {
            name: write_parquet(
                table_beside(store, self.stage, name, self.names[index]), conform(arrays[name], kind, name)
            )
            for name, kind in self.tables.items()
        }
        # each is let go once it is written
        return self._written(((v.name, _made(arrays.pop(v.name))) for v in self.variables), index, store, tables)

    def verify(self, index: int, store: Store) -> str:
        """Return the hash of what is stored of a unit: that of its record, where every byte is as it was written."""
        read = replace(self, store=store).reader(index)
        parts = {variable.name: digest(read(variable.name, ())) for variable in self.variables}
        beside = {name: table_beside(store, self.stage, name, self.names[index]) for name in self.tables}
        return digest(parts | {name: digest(path.read_bytes()) for name, path in beside.items()})

    def _written(
        self, arrays: Iterable[tuple[str, np.ndarray]], index: int, store: Store, tables: Mapping[str, bytes] = NOTHING
    ) -> Made:
        """Write the arrays of a unit, one after another."""
        variables = {variable.name: variable for variable in self.variables}
        parts, size, rows = {name: digest(content) for name, content in tables.items()}, 0, 0
        group = write_group(store.images(self.stage))
        place = self._place(index)
        for name, array in arrays:
            variable = variables.pop(name)
            if array.shape != variable.shape or not np.isfinite(array).all():
                raise ValueError(
                    f"{self.stage} {self.names[index]}: {variable.name} has shape {array.shape}, expected "
                    f"{variable.shape}, or values that are not finite"
                )
            array = array.astype(variable.dtype, copy=False)
            write_array(_array(group, variable.name), place, array)
            parts[name] = digest(array)
            size, rows = size + array.nbytes, max(rows, array.size)
            del array
        if variables:
            raise ValueError(f"{self.stage} {self.names[index]}: {', '.join(variables)} were not made")
        return Made(digest(parts), size, rows)

    def _place(self, index: int) -> tuple[int, ...]:
        """Return the indices of a unit along the axes of units."""
        return tuple(int(k) for k in np.unravel_index(index, self.lengths))

    @cached_property
    def dataset(self) -> xr.Dataset:
        """The lazy dataset, one chunk a unit; a unit's variables share one reading or making of it."""
        chunks = tuple((1,) * length for length in self.lengths)
        name = f"{self.stage.replace('/', '-')}-" + digest([unit.settings for unit in self.units])
        source = dask.delayed(self, name=f"{name}-product", traverse=False)
        bundles = da.map_blocks(
            _load_block,
            source,
            self.lengths,
            chunks=chunks,
            dtype=object,
            name=f"{name}-unit",
            meta=np.empty((0,) * len(chunks), object),
        )
        data = {}
        for variable in self.variables:
            data[variable.name] = (
                (*self.axes, *variable.axes),
                da.map_blocks(
                    _pick,
                    bundles,
                    variable.name,
                    chunks=chunks + tuple((length,) for length in variable.shape),
                    new_axis=list(range(len(chunks), len(chunks) + len(variable.shape))),
                    dtype=variable.dtype,
                    meta=np.empty((0,) * (len(chunks) + len(variable.shape)), variable.dtype),
                    name=f"{name}-{variable.name}",
                ),
                variable.attributes,
            )
        coordinates = {
            key: (axes, values.astype(str) if values.dtype == object else values, attributes)
            for key, (axes, values, attributes) in self.coordinates().items()
        }
        return xr.Dataset(data, coordinates, self.attributes)


def _made(array: Any) -> Any:
    """Return an array, or what makes it when it is wanted."""
    return array() if callable(array) else array


def table_beside(store: Store, stage: str, name: str, unit: str) -> AnyPath:
    """Return the file of a table that belongs to one unit of an image product."""
    return store.table(f"{stage}_{name}", unit)


def _array(group: zarr.Group, name: str) -> Any:
    array = group[name]
    assert isinstance(array, zarr.Array)
    return array


def _load_block(product: ImageProduct, lengths: tuple[int, ...], block_id: tuple[int, ...] = ()) -> np.ndarray:
    bundle = np.empty((1,) * len(lengths), object)
    bundle.flat[0] = product.load(int(np.ravel_multi_index(block_id, lengths)))
    return bundle


def _pick(bundle: np.ndarray, name: str) -> np.ndarray:
    return bundle.flat[0][name][(None,) * bundle.ndim]
