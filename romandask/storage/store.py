"""The layout of a store, and its JSON and Parquet files; no other module knows the paths.

Files are written atomically (see `romandask.storage.paths.write_bytes`).
"""

from __future__ import annotations

import errno
import json
import os
import uuid
from contextlib import ExitStack
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath, access_errors_explained, file_names, remove, write_bytes

CELL = "_healpix_29"
"""Column of HEALPix cells of order 29, by which the rows of catalogs are sorted."""
ROWS_PER_GROUP = 50_000
"""Rows per Parquet row group."""
_READ_BYTES = 4 << 20
"""Bytes per range request to an object store."""
MARGIN = "_margin"
"""Suffix of the names of stages that make the margin of a catalog."""


@dataclass(frozen=True)
class Store:
    """A folder, local or in an object store, that holds one survey."""

    root: AnyPath

    @property
    def pipeline(self) -> AnyPath:
        """Path of the resolved pipeline configuration."""
        return self.root / "pipeline.yaml"

    @property
    def report(self) -> AnyPath:
        """Folder of the report."""
        return self.root / "report"

    @property
    def log(self) -> AnyPath:
        """Folder of the run logs."""
        return self.root / "log"

    def collection(self, name: str) -> AnyPath:
        """Return the folder of a HATS collection (a catalog and its margin), for example truth/galaxies."""
        return self.root / name.removesuffix(MARGIN)

    def catalog(self, name: str) -> AnyPath:
        """Return the folder of a HATS catalog or margin: for example of truth/galaxies or truth/galaxies_margin."""
        return self.collection(name) / ("margin" if name.endswith(MARGIN) else "catalog")

    def partition(self, name: str, order: int, pixel: int) -> AnyPath:
        """Return the file of one partition (HEALPix order and nested pixel) of a HATS catalog."""
        folder = pixel // 10_000 * 10_000
        return self.catalog(name) / "dataset" / f"Norder={order}" / f"Dir={folder}" / f"Npix={pixel}.parquet"

    def table(self, name: str, unit: str | None = None) -> AnyPath:
        """Return the file of a table without HEALPix partitions: the whole table, or one unit of it."""
        return self.root / f"{name}.parquet" if unit is None else self.root / name / f"{unit}.parquet"

    def images(self, name: str) -> AnyPath:
        """Return the Zarr group of an image product."""
        return self.root / f"{name}.zarr"

    def record(self, stage: str, unit: str) -> AnyPath:
        """Return the file of the manifest record of a unit."""
        return self.root / "manifest" / stage / f"{unit}.json"

    def records(self, stage: str) -> AnyPath:
        """Return the folder of the manifest records of a stage."""
        return self.root / "manifest" / stage

    def recorded(self, stage: str) -> list[str]:
        """Return the names of the units of a stage that have a manifest record."""
        return file_names(self.records(stage), ".json")

    def stages(self) -> list[str]:
        """Return the names of the stages that have a folder in the manifest."""
        manifest = self.root / "manifest"
        if not manifest.exists():
            return []
        groups = [group for group in manifest.iterdir() if group.is_dir()]
        return sorted(f"{group.name}/{stage.name}" for group in groups for stage in group.iterdir() if stage.is_dir())

    def prepare(self) -> None:
        """Create the folder and check that it can be written.

        Raises
        ------
        UserError
            If the store cannot be written or reached.
        """
        probe = self.root / f".probe-{uuid.uuid4().hex}"
        try:
            with access_errors_explained(self.root):
                write_bytes(probe, b"")
                remove(probe)
        except OSError as error:
            raise UserError(
                f"{self.root}: the store cannot be written ({error.strerror}): choose another --store"
            ) from None


FULL = {errno.ENOSPC, errno.EDQUOT, errno.EROFS}
"""Error numbers of a disk that is full, over quota or read-only."""


def refuse_full(error: BaseException | None, store: Store) -> None:
    """Raise a UserError if an error, or one in its chain of causes, means that the disk of the store is full.

    Parameters
    ----------
    error : BaseException or None
        Error to inspect.
    store : Store
        Store that was written.
    """
    while error is not None:
        if isinstance(error, OSError) and error.errno in FULL:
            raise UserError(f"{store.root}: {os.strerror(error.errno)}: make room; the same command resumes") from None
        error = error.__cause__ or error.__context__


def write_json(path: AnyPath, content: Any) -> None:
    """Write a JSON file atomically, with sorted keys."""
    write_bytes(path, json.dumps(content, indent=1, sort_keys=True, default=str).encode())


def write_parquet(path: AnyPath, table: pa.Table) -> bytes:
    """Write a Parquet file atomically, with page checksums, and return its content."""
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd", write_page_checksum=True, row_group_size=ROWS_PER_GROUP)
    content = sink.getvalue().to_pybytes()
    write_bytes(path, content)
    return content


def read_parquet(path: AnyPath, columns: list[str] | None = None, between: tuple[int, int] | None = None) -> pa.Table:
    """Read a Parquet file and verify its page checksums.

    Parameters
    ----------
    path : path
        File to read.
    columns : list of str, optional
        Columns to read; all by default.
    between : (int, int), optional
        Range (low, high) of HEALPix cells of order 29: only rows with low <= _healpix_29 < high are returned, and only
        row groups that may contain such rows are read.
    """
    with ExitStack() as opened:
        # objects are read in ranges of a few MB
        source = path if isinstance(path, Path) else opened.enter_context(path.open("rb", block_size=_READ_BYTES))
        file = opened.enter_context(pq.ParquetFile(source, page_checksum_verification=True))
        return file.read(columns=columns) if between is None else _rows_between(file, columns, *between)


def _rows_between(file: pq.ParquetFile, columns: list[str] | None, low: int, high: int) -> pa.Table:
    cell_column = file.schema_arrow.names.index(CELL)
    ranges = [file.metadata.row_group(k).column(cell_column).statistics for k in range(file.metadata.num_row_groups)]
    groups = [k for k, bounds in enumerate(ranges) if bounds is None or (bounds.max >= low and bounds.min < high)]
    wanted = None if columns is None else list(dict.fromkeys([*columns, CELL]))
    table = file.read_row_groups(groups, columns=wanted)
    cells = table.column(CELL)
    table = table.filter(pc.and_(pc.greater_equal(cells, low), pc.less(cells, high)))
    return table if columns is None else table.select(columns)
