"""The store: the only module that knows path names. Files are written whole, beside their place, then renamed."""

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
ROWS_A_GROUP = 50_000
_RANGE = 4 << 20
MARGIN = "_margin"
"""Ending of the names of stages that make a catalog's margin."""


@dataclass(frozen=True)
class Store:
    """A folder, of this machine or of an object store, that holds one survey."""

    root: AnyPath

    @property
    def pipeline(self) -> AnyPath:
        """The resolved configuration."""
        return self.root / "pipeline.yaml"

    @property
    def report(self) -> AnyPath:
        """The folder of the report."""
        return self.root / "report"

    @property
    def log(self) -> AnyPath:
        """The folder of the logs of runs."""
        return self.root / "log"

    def collection(self, name: str) -> AnyPath:
        """Folder of a HATS collection, for example truth/galaxies: a catalog and its margin."""
        return self.root / name.removesuffix(MARGIN)

    def catalog(self, name: str) -> AnyPath:
        """Folder of a HATS catalog, or of a margin: for example truth/galaxies, truth/galaxies_margin."""
        return self.collection(name) / ("margin" if name.endswith(MARGIN) else "catalog")

    def partition(self, name: str, order: int, pixel: int) -> AnyPath:
        """File of one partition of a HATS catalog."""
        folder = pixel // 10_000 * 10_000
        return self.catalog(name) / "dataset" / f"Norder={order}" / f"Dir={folder}" / f"Npix={pixel}.parquet"

    def table(self, name: str, unit: str | None = None) -> AnyPath:
        """File of a table that is not partitioned by the sky, whole or one unit of it."""
        return self.root / f"{name}.parquet" if unit is None else self.root / name / f"{unit}.parquet"

    def images(self, name: str) -> AnyPath:
        """Zarr group of an image product."""
        return self.root / f"{name}.zarr"

    def record(self, stage: str, unit: str) -> AnyPath:
        """Manifest record of one unit."""
        return self.root / "manifest" / stage / f"{unit}.json"

    def records(self, stage: str) -> AnyPath:
        """Folder of the manifest records of a stage."""
        return self.root / "manifest" / stage

    def recorded(self, stage: str) -> list[str]:
        """Names of the units of a stage that have a manifest record."""
        return file_names(self.records(stage), ".json")

    def stages(self) -> list[str]:
        """Names of the stages that have a folder in the manifest."""
        manifest = self.root / "manifest"
        if not manifest.exists():
            return []
        kinds = [kind for kind in manifest.iterdir() if kind.is_dir()]
        return sorted(f"{kind.name}/{folder.name}" for kind in kinds for folder in kind.iterdir() if folder.is_dir())

    def prepare(self) -> None:
        """Make the folder, and raise a UserError where it cannot be written."""
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
"""Errors of a disk that takes no more."""


def refuse_full(error: BaseException | None, store: Store) -> None:
    """Raise a UserError where an error, or what led to it, says that the store's disk can take no more."""
    while error is not None:
        if isinstance(error, OSError) and error.errno in FULL:
            raise UserError(f"{store.root}: {os.strerror(error.errno)}: make room; the same command resumes") from None
        error = error.__cause__ or error.__context__


def write_json(path: AnyPath, content: Any) -> None:
    """Write a JSON file whole."""
    write_bytes(path, json.dumps(content, indent=1, sort_keys=True, default=str).encode())


def write_parquet(path: AnyPath, table: pa.Table) -> bytes:
    """Write a Parquet file whole, with page checksums, and return the bytes that were written."""
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd", write_page_checksum=True, row_group_size=ROWS_A_GROUP)
    content = sink.getvalue().to_pybytes()
    write_bytes(path, content)
    return content


def read_parquet(path: AnyPath, columns: list[str] | None = None, between: tuple[int, int] | None = None) -> pa.Table:
    """Read a Parquet file, page checksums verified; of rows those with low <= _healpix_29 < high if asked."""
    with ExitStack() as opened:
        # an object is read by ranges, a few MB at a time
        source = path if isinstance(path, Path) else opened.enter_context(path.open("rb", block_size=_RANGE))
        file = opened.enter_context(pq.ParquetFile(source, page_checksum_verification=True))
        return file.read(columns=columns) if between is None else _rows_between(file, columns, *between)


def _rows_between(file: pq.ParquetFile, columns: list[str] | None, low: int, high: int) -> pa.Table:
    place = file.schema_arrow.names.index(CELL)
    ranges = [file.metadata.row_group(k).column(place).statistics for k in range(file.metadata.num_row_groups)]
    groups = [k for k, found in enumerate(ranges) if found is None or (found.max >= low and found.min < high)]
    wanted = None if columns is None else list(dict.fromkeys([*columns, CELL]))
    table = file.read_row_groups(groups, columns=wanted)
    cells = table.column(CELL)
    table = table.filter(pc.and_(pc.greater_equal(cells, low), pc.less(cells, high)))
    return table if columns is None else table.select(columns)
