"""Arrays of image products: Zarr groups with shards of one writer and checksums; a chunk that is gone is an error."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.abc.store import ByteRequest
from zarr.codecs import BloscCodec, Crc32cCodec, ZstdCodec
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import FsspecStore, LocalStore, WrapperStore

from romandask.model.errors import UserError
from romandask.storage.paths import OPTIONS, AnyPath

ROWS_A_FILE = 512
"""About, of variables that are not compressed."""
_SHARD = 4
"""Inner chunks along each side of a shard."""
_CHUNK = re.compile(r"(^|/)c(/\d+)+$")
"""Keys of chunks and shards."""


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


class _Whole(WrapperStore):
    """A store in which a chunk that is not there is an error: to Zarr it is zeros, which look like an image."""

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """Return bytes of a key, None where there is no such metadata; FileNotFoundError of a chunk."""
        found = await super().get(key, prototype, byte_range)
        if found is None and _CHUNK.search(key):
            raise FileNotFoundError(f"{self._store}/{key}: the chunk is gone")
        return found


def read_group(path: AnyPath) -> zarr.Group:
    """Return a stored group for reading; chunks that are missing are errors."""
    return zarr.open_group(_Whole(_zarr_store(path)), mode="r")


def write_group(path: AnyPath, mode: Any = "r+") -> zarr.Group:
    """Return a group for writing."""
    return zarr.open_group(_zarr_store(path), mode=mode)


def _zarr_store(path: AnyPath) -> Any:
    return LocalStore(path) if isinstance(path, Path) else FsspecStore.from_url(str(path), storage_options=OPTIONS)


def open_images(
    path: AnyPath, variables: tuple[Variable, ...], lengths: tuple[int, ...], axes: tuple[str, ...]
) -> zarr.Group:
    """Open, or make, the Zarr group of an image product with `lengths` units along the axes `axes`.

    No two units (two writers) share a shard; one is cut in inner chunks of about 1k x 1k, each with a checksum, and is
    of at most 4 x 4 of them, for what is written at a time is in memory several times. Variables that are not
    compressed have no shards: their files are of about 512 whole rows. An array made for another number of units is
    resized.
    """
    group = write_group(path, "a")
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
    # a setting of whoever writes, not of the array: without it chunks of zeros would not be written, and be gone
    array = array.with_config({"write_empty_chunks": True})
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
