"""Table products: lazy tables over units, each read from the store where it is and made where it is not."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import dask.dataframe as dd
import numpy as np
import pandas as pd
import pyarrow as pa

from romandask.model.errors import UserError
from romandask.model.sky import Cone, Region
from romandask.products.units import Made, Unit, names_of
from romandask.storage.manifest import digest, read_record
from romandask.storage.paths import AnyPath, remove
from romandask.storage.store import Store, read_parquet, write_parquet


@dataclass(frozen=True, repr=False, kw_only=True)
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

    def __repr__(self) -> str:
        # what makes it holds the products that it reads, and those theirs
        return f"TableProduct({self.stage}, {len(self.units)} units)"

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

    def touching_cells(self, cells: np.ndarray, order: int) -> list[int]:
        """Return the units that hold, or lie in, some HEALPix cells of any order."""
        return self.touching(np.unique(self._own_cells(cells, order)))

    def rows_in(self, cells: np.ndarray, order: int, columns: list[str] | None = None) -> pd.DataFrame:
        """Return some columns, _healpix_29 among them, of the rows in HEALPix cells of any order.

        Of a partition no more is read than what lies between the first and the last of its cells.
        """
        cells, own = np.unique(cells), self.order or 0
        wanted = None if columns is None else list(dict.fromkeys([*columns, "_healpix_29"]))
        parts = []
        for index in self.touching_cells(cells, order):
            pixel, up = (self.pixels or ())[index], 2 * (order - own)
            here = cells[cells >> up == pixel] if up >= 0 else np.array([pixel])
            shift = 2 * (29 - max(order, own))
            near = self.select(index, wanted, (int(here[0]) << shift, (int(here[-1]) + 1) << shift))
            parts.append(near[np.isin(near["_healpix_29"].to_numpy() >> shift, here)])
        filled = [part for part in parts if len(part)]
        if filled:
            return pd.concat(filled, ignore_index=True)
        return self.empty() if wanted is None else self.empty()[wanted]

    def _own_cells(self, cells: np.ndarray, order: int) -> np.ndarray:
        """Return the cells of the catalog's own order that hold cells of another, or lie in them."""
        up = 2 * (order - (self.order or 0))
        if up >= 0:
            return cells >> up
        return (cells[:, None] * (1 << -up) + np.arange(1 << -up)).ravel()

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
            remove(path)
            return Made(digest(b""), 0, 0)
        return Made(digest(write_parquet(path, table)), table.nbytes, table.num_rows)

    def verify(self, index: int, store: Store) -> str:
        """Return the hash of what is stored of a unit: that of its record, where every byte is as it was written."""
        path = self._path(index, store)
        if self.pixels is not None and not path.exists():
            return digest(b"")
        return digest(path.read_bytes())

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

    def _path(self, index: int, store: Store) -> AnyPath:
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
