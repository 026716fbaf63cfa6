"""The store: the only module that knows path names. Files are written whole, beside their place, then renamed."""

from __future__ import annotations

import errno
import itertools
import json
import os
import uuid
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import zarr
from zarr.codecs import BloscCodec, Crc32cCodec, ZstdCodec

from romandask.model.errors import UserError

CELL = "_healpix_29"
"""Column of HEALPix cells of order 29, by which the rows of catalogs are sorted."""
ROWS_A_GROUP = 50_000
ROWS_A_FILE = 512
"""About, of variables that are not compressed."""
_SHARD = 4
"""Inner chunks along each side of a shard."""
MARGIN = "_margin"
"""Ending of the names of stages that make a catalog's margin."""


@dataclass(frozen=True)
class Variable:
    """One array of an image product; its axes are those of the units, then those of a unit."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    """Of one unit."""
    axes: tuple[str, ...]
    """Names of the axes of one unit."""
    attributes: dict[str, Any]
    """units, long_name, ..."""
    compress: bool = True
    """False where it would gain little and cost every reader time: a chunk is then a file of whole rows."""


@dataclass(frozen=True)
class Store:
    """A folder that holds one survey."""

    root: Path

    @property
    def pipeline(self) -> Path:
        """The resolved configuration."""
        return self.root / "pipeline.yaml"

    @property
    def report(self) -> Path:
        """The folder of the report."""
        return self.root / "report"

    @property
    def log(self) -> Path:
        """The folder of the logs of runs."""
        return self.root / "log"

    def collection(self, name: str) -> Path:
        """Folder of a HATS collection, for example truth/galaxies: a catalog and its margin."""
        return self.root / name.removesuffix(MARGIN)

    def catalog(self, name: str) -> Path:
        """Folder of a HATS catalog, or of a margin: for example truth/galaxies, truth/galaxies_margin."""
        return self.collection(name) / ("margin" if name.endswith(MARGIN) else "catalog")

    def partition(self, name: str, order: int, pixel: int) -> Path:
        """File of one partition of a HATS catalog."""
        folder = pixel // 10_000 * 10_000
        return self.catalog(name) / "dataset" / f"Norder={order}" / f"Dir={folder}" / f"Npix={pixel}.parquet"

    def table(self, name: str, unit: str | None = None) -> Path:
        """File of a table that is not partitioned by the sky, whole or one unit of it."""
        return self.root / f"{name}.parquet" if unit is None else self.root / name / f"{unit}.parquet"

    def images(self, name: str) -> Path:
        """Zarr group of an image product."""
        return self.root / f"{name}.zarr"

    def record(self, stage: str, unit: str) -> Path:
        """Manifest record of one unit."""
        return self.root / "manifest" / stage / f"{unit}.json"

    def records(self, stage: str) -> list[Path]:
        """All manifest records of a stage."""
        return sorted((self.root / "manifest" / stage).glob("*.json"))

    def prepare(self) -> None:
        """Make the folder, and raise a UserError where it cannot be written."""
        try:
            self.root.mkdir(parents=True, exist_ok=True)
            probe = self.root / f".probe-{uuid.uuid4().hex}"
            probe.write_bytes(b"")
            probe.unlink()
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


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file so that it appears whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    temporary = path.with_name(f".{path.name}.{uuid.uuid4().hex}.partial")
    with open(temporary, "wb") as file:
        file.write(content)
        file.flush()
        os.fsync(file.fileno())
    os.replace(temporary, path)


def write_json(path: Path, content: Any) -> None:
    """Write a JSON file whole."""
    write_bytes(path, json.dumps(content, indent=1, sort_keys=True, default=str).encode())


def write_parquet(path: Path, table: pa.Table) -> bytes:
    """Write a Parquet file whole, with page checksums, and return the bytes that were written."""
    sink = pa.BufferOutputStream()
    pq.write_table(table, sink, compression="zstd", write_page_checksum=True, row_group_size=ROWS_A_GROUP)
    content = sink.getvalue().to_pybytes()
    write_bytes(path, content)
    return content


def read_parquet(path: Path, columns: list[str] | None = None, between: tuple[int, int] | None = None) -> pa.Table:
    """Read a Parquet file, page checksums verified; of rows those with low <= _healpix_29 < high if asked."""
    file = pq.ParquetFile(path, page_checksum_verification=True)
    if between is None:
        return file.read(columns=columns)
    low, high = between
    place = file.schema_arrow.names.index(CELL)
    ranges = [file.metadata.row_group(k).column(place).statistics for k in range(file.metadata.num_row_groups)]
    groups = [k for k, found in enumerate(ranges) if found is None or (found.max >= low and found.min < high)]
    wanted = None if columns is None else list(dict.fromkeys([*columns, CELL]))
    table = file.read_row_groups(groups, columns=wanted)
    cells = table.column(CELL)
    table = table.filter(pc.and_(pc.greater_equal(cells, low), pc.less(cells, high)))
    return table if columns is None else table.select(columns)


def open_images(
    path: Path, variables: tuple[Variable, ...], lengths: tuple[int, ...], axes: tuple[str, ...]
) -> zarr.Group:
    """Open, or make, the Zarr group of an image product with `lengths` units along the axes `axes`.

    No two units (two writers) share a shard; one is cut in inner chunks of about 1k x 1k, each with a checksum, and is
    of at most 4 x 4 of them, for what is written at a time is in memory several times. Variables that are not
    compressed have no shards: their files are of about 512 whole rows. An array made for another number of units is
    resized.
    """
    group = zarr.open_group(path, mode="a")
    for variable in variables:
        shape = (*lengths, *variable.shape)
        if variable.name in group:
            array = group[variable.name]
            if not isinstance(array, zarr.Array):
                raise UserError(f"{path}/{variable.name}: not an array: use another store")
            if array.shape[len(lengths) :] == variable.shape and array.dtype == np.dtype(variable.dtype):
                if array.shape != shape:
                    array.resize(shape)
                array.update_attributes(variable.attributes)
                continue
        ones = (1,) * len(lengths)
        packing = [BloscCodec(cname="zstd", clevel=1, shuffle="bitshuffle")] if variable.compress else []
        inner, shard = _chunks(variable)
        group.create_array(
            variable.name,
            shape=shape,
            dtype=variable.dtype,
            chunks=ones + inner,
            shards=None if shard is None else ones + shard,
            compressors=[*packing, Crc32cCodec()],
            fill_value=0,
            dimension_names=(*axes, *variable.axes),
            attributes=variable.attributes,
            config={"write_empty_chunks": True},
            overwrite=True,
        )
    return group


def few_chunks() -> Any:
    """Return a context in which zarr decodes two chunks at a time, not ten: their buffers are a quarter of a worker.

    It takes no longer: one process has one core.
    """
    return zarr.config.set({"async.concurrency": 2})


def write_array(array: zarr.Array, place: tuple[int, ...], values: np.ndarray) -> None:
    """Write the values of one unit, a file of its last two axes after another: what is written is in memory twice."""
    files = (array.shards or array.chunks)[len(place) :]
    cuts = [range(0, length, step) for length, step in zip(values.shape[-2:], files[-2:], strict=True)]
    for corner in itertools.product(*cuts):
        part: Any = (..., *(slice(low, low + step) for low, step in zip(corner, files[-2:], strict=True)))
        with few_chunks():
            array[(*place, *part)] = values[part]


def write_coordinate(group: zarr.Group, name: str, values: np.ndarray, axes: tuple[str, ...], attributes: dict) -> None:
    """Write one coordinate array whole; texts as variable-length UTF-8."""
    text = values.dtype.kind in "OU"
    array = group.create_array(
        name,
        shape=values.shape,
        dtype="string" if text else values.dtype,
        chunks=values.shape,
        compressors=[ZstdCodec(level=1, checksum=True)],
        dimension_names=axes,
        attributes=attributes,
        overwrite=True,
    )
    array[...] = values.astype(object) if text else values


def _chunks(variable: Variable) -> tuple[tuple[int, ...], tuple[int, ...] | None]:
    """Return the shapes of the chunks of a unit and of its shards; None where there are none."""
    many, image = variable.shape[:-2], variable.shape[-2:]
    if not variable.compress:
        return (*many, *(chunk_side(length, ROWS_A_FILE) for length in image[:-1]), image[-1]), None
    inner = tuple(chunk_side(length) for length in image)
    shard = (min(_SHARD, -(-length // chunk)) * chunk for length, chunk in zip(image, inner, strict=True))
    return (*(1 for _ in many), *inner), (*many, *shard)


def chunk_side(length: int, about: int = 1024) -> int:
    """Return a chunk of about some length that divides a length as evenly as it can."""
    return -(-length // max(1, round(length / about)))
