"""Table products: lazy tables over units, each read from the store if it is stored, otherwise made."""

from __future__ import annotations

import uuid
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
    """A table over units, which are HEALPix partitions or other pieces. `frame` is the lazy dask DataFrame."""

    stage: str
    """Name of the stage, for example objects/roman; also the path of the product in the store."""
    units: Sequence[Unit]
    """Units of the table, in the order of its partitions."""
    make: Callable[[int], pd.DataFrame]
    """Makes the rows of the unit with a given index."""
    schema: pa.Schema
    """Columns and their types."""
    pixels: tuple[int, ...] | None = None
    """Nested HEALPix cell of each unit if the product is a HATS catalog, otherwise None."""
    order: int | None = None
    """HEALPix order of `pixels`."""
    bytes_per_unit: int = 0
    """Peak memory of making one unit, bytes, in addition to what a worker holds between units."""
    seconds_per_unit: float = 0.0
    """Time to make one unit on one core of a laptop, s; used for planning."""
    store: Store | None = None
    """Store that stored units are read from; without one, every unit is made."""

    def __repr__(self) -> str:
        # the generated repr would include `make`, and through it all upstream products
        return f"TableProduct({self.stage}, {len(self.units)} units)"

    @cached_property
    def names(self) -> tuple[str, ...]:
        """Names of the units."""
        return names_of(self.units)

    @cached_property
    def token(self) -> str:
        """Identifies the object for dask. The settings of its units do not say what they are made from, and hashing the
        object with all upstream products, as dask would, takes half a minute."""
        return uuid.uuid4().hex

    @property
    def product(self) -> TableProduct:
        """The product itself: a stage may build it bare, or in a value that says more of it."""
        return self

    def stored(self, store: Store) -> TableProduct:
        """Return the product with `store`, from which its stored units are read."""
        return replace(self, store=store)

    def load(self, index: int) -> pd.DataFrame:
        """Return the rows of a unit: read if the manifest has a record of it, otherwise made."""
        if self.store is not None and (record := read_record(self.store, self.stage, self.names[index])):
            if record.rows == 0:
                return to_frame(self.schema.empty_table())
            return to_frame(read_parquet(self._path(index, self.store)))
        return to_frame(conform(self.make(index), self.schema, self.stage))

    def has(self, index: int) -> bool:
        """Return whether a unit is stored."""
        return self.store is not None and read_record(self.store, self.stage, self.names[index]) is not None

    def select(
        self, index: int, columns: list[str] | None = None, between: tuple[int, int] | None = None
    ) -> pd.DataFrame:
        """Return selected columns and rows of a unit.

        Of a stored unit, only the parts of the file that may contain the selection are read.

        Parameters
        ----------
        index : int
            Index of the unit.
        columns : list of str, optional
            Columns to return; all by default.
        between : (int, int), optional
            Range (low, high) of HEALPix cells of order 29: only rows with low <= _healpix_29 < high are returned.
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
        """Return the indices of the units of the given HEALPix cells, which have the order of the catalog."""
        return sorted(self._pixel_index[cell] for cell in np.asarray(cells).tolist() if cell in self._pixel_index)

    def touching_cells(self, cells: np.ndarray, order: int) -> list[int]:
        """Return the indices of the units that contain, or lie in, the given HEALPix cells of any order."""
        return self.touching(np.unique(self._own_cells(cells, order)))

    def rows_in(self, cells: np.ndarray, order: int, columns: list[str] | None = None) -> pd.DataFrame:
        """Return the rows in the given HEALPix cells.

        Reads only the rows between the first and the last requested cell of each partition.

        Parameters
        ----------
        cells : ndarray of int
            Nested HEALPix cells.
        order : int
            Order of `cells`, which may differ from the order of the catalog.
        columns : list of str, optional
            Columns to return, to which _healpix_29 is added; all by default.
        """
        cells, own = np.unique(cells), self.order or 0
        wanted = None if columns is None else list(dict.fromkeys([*columns, "_healpix_29"]))
        parts = []
        for index in self.touching_cells(cells, order):
            pixel, up = (self.pixels or ())[index], 2 * (order - own)
            requested = cells[cells >> up == pixel] if up >= 0 else np.array([pixel])
            shift = 2 * (29 - max(order, own))
            rows = self.select(index, wanted, (int(requested[0]) << shift, (int(requested[-1]) + 1) << shift))
            parts.append(rows[np.isin(rows["_healpix_29"].to_numpy() >> shift, requested)])
        filled = [part for part in parts if len(part)]
        if filled:
            return pd.concat(filled, ignore_index=True)
        return self.empty() if wanted is None else self.empty()[wanted]

    def _own_cells(self, cells: np.ndarray, order: int) -> np.ndarray:
        """Return the cells of the catalog's order that contain, or lie in, the given cells."""
        up = 2 * (order - (self.order or 0))
        if up >= 0:
            return cells >> up
        return (cells[:, None] * (1 << -up) + np.arange(1 << -up)).ravel()

    @cached_property
    def _pixel_index(self) -> dict[int, int]:
        return {pixel: index for index, pixel in enumerate(self.pixels or ())}

    def empty(self) -> pd.DataFrame:
        """Return an empty table with the columns of the schema."""
        return to_frame(self.schema.empty_table())

    @property
    def stored_bytes(self) -> int:
        """Zero: how many rows there are depends on what is found."""
        return 0

    def metadata_files(self, store: Store) -> list[AnyPath]:
        """Return no files: those of a HATS catalog are written when all its units are there."""
        return []

    def prepare(self, store: Store) -> None:
        """Do nothing: tables need no preparation, unlike image products."""

    def write(self, index: int, store: Store) -> Made:
        """Make one unit and write it; a HEALPix partition without rows gets no file."""
        table = conform(self.make(index), self.schema, self.stage)
        path = self._path(index, store)
        if table.num_rows == 0 and self.pixels is not None:
            remove(path)
            return Made(digest(b""), 0, 0)
        return Made(digest(write_parquet(path, table)), table.nbytes, table.num_rows)

    def verify(self, index: int, store: Store) -> str:
        """Return the hash of a stored unit; it equals `Record.output` if the unit is undamaged."""
        path = self._path(index, store)
        if self.pixels is not None and not path.exists():
            return digest(b"")
        return digest(path.read_bytes())

    @property
    def frame(self) -> dd.DataFrame:
        """The lazy table, with one dask partition per unit."""
        meta = _with_arrow_lists(self.empty(), self.schema)
        if not len(self.units):
            return dd.from_pandas(meta, npartitions=1)
        return dd.from_map(_LoadPartition(self), range(len(self.units)), meta=meta, label=self.stage.replace("/", "-"))

    def within(self, region: Region | Cone, ra: str = "ra", dec: str = "dec") -> dd.DataFrame:
        """Return the rows of a region as a lazy table; only partitions that touch it are read.

        Parameters
        ----------
        region : Region or Cone
            Area on the sky.
        ra, dec : str
            Columns of right ascension and declination, degrees.
        """
        chosen = self.touching(region.cells(self.order or 0))
        if not chosen:
            return dd.from_pandas(_with_arrow_lists(self.empty(), self.schema), npartitions=1)
        load = _LoadWithin(self, region, ra, dec)
        meta = _with_arrow_lists(self.empty(), self.schema)
        return dd.from_map(load, chosen, meta=meta, label=f"{self.stage.replace('/', '-')}-within")

    def rows_within(self, region: Region | Cone, ra: str = "ra", dec: str = "dec") -> pd.DataFrame:
        """Return the rows of a region in memory (see `within`)."""
        load = _LoadWithin(self, region, ra, dec)
        return self._concatenate([load(index) for index in self.touching(region.cells(self.order or 0))])

    def rows_where(self, name: str, values: np.ndarray, columns: list[str]) -> pd.DataFrame:
        """Return the given columns of all rows whose value in column `name` is one of `values`.

        `columns` must include `name`.
        """
        parts = (self.select(index, columns) for index in range(len(self.units)))
        return self._concatenate([part[np.isin(part[name].to_numpy(), values)] for part in parts])[columns]

    def column(self, name: str) -> np.ndarray:
        """Return one column of all rows."""
        parts = [self.select(index, [name])[name].to_numpy() for index in range(len(self.units))]
        return np.concatenate(parts) if parts else self.empty()[name].to_numpy()

    def all_rows(self) -> pd.DataFrame:
        """Return the whole table in memory."""
        return self._concatenate([self.load(index) for index in range(len(self.units))])

    def _concatenate(self, parts: list[pd.DataFrame]) -> pd.DataFrame:
        """Return parts as one table, without the empty ones, which could change the types of columns."""
        filled = [part for part in parts if len(part)]
        return pd.concat(filled, ignore_index=True) if filled else self.empty()

    def _path(self, index: int, store: Store) -> AnyPath:
        if self.pixels is None:
            return store.table(self.stage, self.names[index])
        return store.partition(self.stage, self.order or 0, self.pixels[index])


@dataclass(frozen=True)
class _LoadPartition:
    product: TableProduct

    def __dask_tokenize__(self) -> tuple[str, str]:
        return type(self).__name__, self.product.token

    def __call__(self, index: int) -> pd.DataFrame:
        return _with_arrow_lists(self.product.load(index), self.product.schema)


def _with_arrow_lists(frame: pd.DataFrame, schema: pa.Schema) -> pd.DataFrame:
    """Return a frame whose list columns have an Arrow type, because dask converts object columns to strings."""
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

    def __dask_tokenize__(self) -> tuple[object, ...]:
        return type(self).__name__, self.product.token, type(self.region).__name__, vars(self.region), self.ra, self.dec

    def __call__(self, index: int) -> pd.DataFrame:
        frame = _with_arrow_lists(self.product.load(index), self.product.schema)
        return frame[self.region.contains(frame[self.ra], frame[self.dec])]


def to_frame(table: pa.Table) -> pd.DataFrame:
    """Return a table as a DataFrame with NumPy types; lists become arrays."""
    return table.replace_schema_metadata(None).to_pandas()


def conform(frame: pd.DataFrame, schema: pa.Schema, name: str) -> pa.Table:
    """Return a frame as a table with exactly the columns and types of a schema.

    Parameters
    ----------
    frame : DataFrame
        Rows; columns that are not in the schema are dropped.
    schema : pyarrow.Schema
        Columns of the table.
    name : str
        Name of the table in error messages.

    Raises
    ------
    UserError
        If a column is missing or has values that its type cannot represent.
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
