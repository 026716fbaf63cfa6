"""Products: lazy images and tables over units, each read from the store where it is and made where it is not."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import dask
import dask.array as da
import dask.dataframe as dd
import numpy as np
import pandas as pd
import pyarrow as pa
import xarray as xr
import zarr

from romandask.model.errors import UserError
from romandask.model.sky import Cone, Region
from romandask.runtime.manifest import Digest, digest, read_record
from romandask.runtime.store import (
    Store,
    Variable,
    few_chunks,
    open_images,
    read_parquet,
    write_array,
    write_coordinate,
    write_parquet,
)
from romandask.runtime.units import Unit, names_of

Coordinates = dict[str, tuple[tuple[str, ...], np.ndarray, dict]]
"""By name: axes, values, attributes."""


@dataclass(frozen=True)
class Made:
    """What storing one unit wrote."""

    output: str
    """Hash of the content."""
    bytes: int
    rows: int


@dataclass(frozen=True)
class ImageProduct:
    """Images over units; `dataset` is the lazy xarray view."""

    stage: str
    """For example exposures/roman; also its place in the store."""
    units: Sequence[Unit]
    make: Callable[[int], dict[str, Any]]
    """Makes the arrays of one unit."""
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
        return {**{name: made[name][(..., *window)] for name in wanted}, **{name: made[name] for name in tables}}

    def reader(self, unit: int) -> Callable[[str, tuple[slice, ...]], np.ndarray]:
        """Return what reads windows of the last axes of arrays of a stored unit: each is opened once."""
        assert self.store is not None
        group = zarr.open_group(self.store.images(self.stage), mode="r")
        place = self._place(unit)
        opened: dict[str, zarr.Array] = {}

        def read(name: str, window: tuple[slice, ...] = ()) -> np.ndarray:
            if name not in opened:
                opened[name] = _array(group, name)
            index: Any = (*place, ..., *window)
            with few_chunks():
                return np.asarray(opened[name][index])

        return read

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
        arrays = self.make(index)
        tables = [
            write_parquet(table_beside(store, self.stage, name, self.names[index]), conform(arrays[name], kind, name))
            for name, kind in self.tables.items()
        ]
        # each is let go once it is written
        return self._written(((v.name, arrays.pop(v.name)) for v in self.variables), index, store, *tables)

    def _written(self, arrays: Iterable[tuple[str, np.ndarray]], index: int, store: Store, *tables: bytes) -> Made:
        """Write the arrays of a unit, one after another."""
        variables = {variable.name: variable for variable in self.variables}
        state, size, rows = Digest(), 0, 0
        group = zarr.open_group(store.images(self.stage), mode="r+")
        place = self._place(index)
        for name, array in arrays:
            variable = variables.pop(name)
            if array.shape != variable.shape or not np.isfinite(array).all():
                raise ValueError(
                    f"{self.stage} {self.names[index]}: {variable.name} has shape {array.shape}, expected "
                    f"{variable.shape}, or values that are not finite"
                )
            write_array(_array(group, variable.name), place, array.astype(variable.dtype, copy=False))
            state.add(array)
            size, rows = size + array.nbytes, max(rows, array.size)
            del array
        if variables:
            raise ValueError(f"{self.stage} {self.names[index]}: {', '.join(variables)} were not made")
        for table in tables:
            state.add(table)
        return Made(state.value(), size, rows)

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
            _load_block, source, self.lengths, chunks=chunks, dtype=object, name=f"{name}-unit",
            meta=np.empty((0,) * len(chunks), object),
        )  # fmt: skip
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


def table_beside(store: Store, stage: str, name: str, unit: str) -> Path:
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


@dataclass(frozen=True)
class TableProduct:
    """A table over units, HEALPix partitions or others; `frame` is the lazy dask DataFrame."""

    stage: str
    units: Sequence[Unit]
    make: Callable[[int], pd.DataFrame]
    schema: pa.Schema
    pixels: tuple[int, ...] | None = None
    """HEALPix cell of each unit where the product is a HATS catalog."""
    order: int | None = None
    bytes_per_unit: int = 0
    seconds_per_unit: float = 0.0
    store: Store | None = None

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the units."""
        return names_of(self.units)

    def stored(self, store: Store) -> TableProduct:
        """Return the same product, reading what the store has."""
        return replace(self, store=store)

    def load(self, index: int) -> pd.DataFrame:
        """Return the rows of a unit: read where the manifest has it, made where not."""
        if self.store is not None and (record := read_record(self.store, self.stage, self.names[index])):
            if record.rows == 0:
                return to_frame(self.schema.empty_table())
            return to_frame(read_parquet(self._path(index, self.store)))
        return to_frame(conform(self.make(index), self.schema, self.stage))

    def has(self, index: int) -> bool:
        """True where the store has a unit."""
        return self.store is not None and read_record(self.store, self.stage, self.names[index]) is not None

    def select(
        self, index: int, columns: list[str] | None = None, between: tuple[int, int] | None = None
    ) -> pd.DataFrame:
        """Return some columns of a unit's rows, and of rows those whose _healpix_29 lies in low <= cell < high.

        Of a stored unit only the parts of the file are read that may hold them.
        """
        if self.store is not None and (record := read_record(self.store, self.stage, self.names[index])):
            if record.rows:
                return to_frame(read_parquet(self._path(index, self.store), columns, between))
            frame = self.empty()
        else:
            frame = self.load(index)
        if between is not None:
            frame = frame[(frame["_healpix_29"] >= between[0]) & (frame["_healpix_29"] < between[1])]
        return frame if columns is None else frame[columns]

    def touching(self, cells: np.ndarray) -> list[int]:
        """Return the units whose HEALPix cells (of the catalog's own order) are among some."""
        return sorted(self._places[cell] for cell in np.asarray(cells).tolist() if cell in self._places)

    @cached_property
    def _places(self) -> dict[int, int]:
        return {pixel: index for index, pixel in enumerate(self.pixels or ())}

    def empty(self) -> pd.DataFrame:
        """Return no rows, with the right columns."""
        return to_frame(self.schema.empty_table())

    def prepare(self, store: Store) -> None:
        """Tables need nothing before their units are written."""

    def write(self, index: int, store: Store) -> Made:
        """Make one unit and write it; a unit without rows has a record and no file."""
        table = conform(self.make(index), self.schema, self.stage)
        path = self._path(index, store)
        if table.num_rows == 0 and self.pixels is not None:
            path.unlink(missing_ok=True)
            return Made(digest(b""), 0, 0)
        return Made(digest(write_parquet(path, table)), table.nbytes, table.num_rows)

    @property
    def frame(self) -> dd.DataFrame:
        """The lazy table, a partition a unit."""
        meta = _with_lists(self.empty(), self.schema)
        if not len(self.units):
            return dd.from_pandas(meta, npartitions=1)
        return dd.from_map(_LoadPartition(self), range(len(self.units)), meta=meta, label=self.stage.replace("/", "-"))

    def within(self, region: Region | Cone, ra: str = "ra", dec: str = "dec") -> dd.DataFrame:
        """Return the lazy rows of a region, of the partitions alone that it touches."""
        chosen = self.touching(region.cells(self.order or 0))
        if not chosen:
            return dd.from_pandas(_with_lists(self.empty(), self.schema), npartitions=1)
        load = _LoadWithin(self, region, ra, dec)
        meta = _with_lists(self.empty(), self.schema)
        return dd.from_map(load, chosen, meta=meta, label=f"{self.stage.replace('/', '-')}-within")

    def rows_within(self, region: Region | Cone, ra: str = "ra", dec: str = "dec") -> pd.DataFrame:
        """Return the rows of a region, of the partitions alone that it touches."""
        load = _LoadWithin(self, region, ra, dec)
        return self._together([load(index) for index in self.touching(region.cells(self.order or 0))])

    def rows_where(self, name: str, values: np.ndarray, columns: list[str]) -> pd.DataFrame:
        """Return some columns of all rows whose value of a column is among some."""
        parts = (self.select(index, columns) for index in range(len(self.units)))
        return self._together([part[np.isin(part[name].to_numpy(), values)] for part in parts])[columns]

    def column(self, name: str) -> np.ndarray:
        """Return one column of all rows."""
        parts = [self.select(index, [name])[name].to_numpy() for index in range(len(self.units))]
        return np.concatenate(parts) if parts else self.empty()[name].to_numpy()

    def all_rows(self) -> pd.DataFrame:
        """Return the whole table in memory."""
        return self._together([self.load(index) for index in range(len(self.units))])

    def _together(self, parts: list[pd.DataFrame]) -> pd.DataFrame:
        """Return parts as one table; what is empty would change the types of columns."""
        filled = [part for part in parts if len(part)]
        return pd.concat(filled, ignore_index=True) if filled else self.empty()

    def _path(self, index: int, store: Store):
        if self.pixels is None:
            return store.table(self.stage, self.names[index])
        return store.partition(self.stage, self.order or 0, self.pixels[index])


@dataclass(frozen=True)
class _LoadPartition:
    product: TableProduct

    def __call__(self, index: int) -> pd.DataFrame:
        return _with_lists(self.product.load(index), self.product.schema)


def _with_lists(frame: pd.DataFrame, schema: pa.Schema) -> pd.DataFrame:
    """Return a frame whose lists have an Arrow type: dask makes texts of objects."""
    lists = {
        field.name: pd.arrays.ArrowExtensionArray(pa.array(list(frame[field.name]), type=field.type))
        for field in schema
        if pa.types.is_list(field.type)
    }
    return frame.assign(**lists) if lists else frame


@dataclass(frozen=True)
class _LoadWithin:
    product: TableProduct
    region: Region | Cone
    ra: str
    dec: str

    def __call__(self, index: int) -> pd.DataFrame:
        frame = _with_lists(self.product.load(index), self.product.schema)
        return frame[self.region.contains(frame[self.ra], frame[self.dec])]


def to_frame(table: pa.Table) -> pd.DataFrame:
    """Return a table as pandas with Arrow-independent types (lists become arrays)."""
    return table.replace_schema_metadata(None).to_pandas()


def conform(frame: pd.DataFrame, schema: pa.Schema, name: str) -> pa.Table:
    """Return the frame as a table of exactly the schema's columns and types.

    Raises
    ------
    UserError
        If a column is missing or holds what its type cannot.
    """
    arrays = []
    for column in schema:
        if column.name not in frame:
            raise UserError(f"{name}: column {column.name!r} is missing (found {', '.join(map(str, frame.columns))})")
        try:
            values = frame[column.name]
            values = list(values) if pa.types.is_list(column.type) else values.to_numpy()
            arrays.append(pa.array(values, type=column.type, from_pandas=False))
        except (pa.ArrowInvalid, pa.ArrowTypeError, ValueError) as error:
            raise UserError(f"{name}: column {column.name!r} cannot be {column.type}: {error}") from None
    return pa.Table.from_arrays(arrays, schema=schema)
