"""Zarr arrays of image products: one writer per shard, a checksum per chunk, and an error for a missing chunk."""

from __future__ import annotations

import itertools
import re
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import zarr
from zarr.abc.store import ByteRequest
from zarr.abc.store import Store as ZarrStore
from zarr.codecs import BloscCodec, Crc32cCodec, ZstdCodec
from zarr.core.buffer import Buffer, BufferPrototype
from zarr.storage import FsspecStore, LocalStore, WrapperStore

from romandask.model.errors import UserError
from romandask.storage.paths import OPTIONS, AnyPath

ROWS_A_FILE = 512
"""Approximate image rows per file of a variable that is not compressed."""
_SHARD_CHUNKS = 4
"""Most inner chunks along each side of a shard."""
_CHUNK_KEY = re.compile(r"(^|/)c(/\d+)+$")
"""Zarr keys of chunks and shards."""


@dataclass(frozen=True)
class Variable:
    """One array of an image product. Its leading axes are those over units, the others those of one unit."""

    name: str
    dtype: str
    shape: tuple[int, ...]
    """Shape of one unit."""
    axes: tuple[str, ...]
    """Names of the axes of one unit."""
    attributes: dict[str, Any]
    """Zarr attributes: units, long_name, ..."""
    compress: bool = True
    """False where compression would gain little and slow down every reader; each chunk is then a file of full rows."""
    zeros: bool = False
    """True for a variable that is not compressed but has large areas of zeros, which are then stored as almost nothing
    (LZ4, which copies other values as they are)."""


class _StrictStore(WrapperStore[ZarrStore]):
    """A Zarr store in which a missing chunk is an error; Zarr itself would return zeros, which look like an image."""

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """Return the bytes of a key, or None for missing metadata; raise FileNotFoundError for a missing chunk."""
        content = await super().get(key, prototype, byte_range)
        if content is None and _CHUNK_KEY.search(key):
            raise FileNotFoundError(f"{self._store}/{key}: the chunk is gone")
        return content


def read_group(path: AnyPath) -> zarr.Group:
    """Open a stored group for reading; a missing chunk raises FileNotFoundError."""
    return zarr.open_group(_StrictStore(_zarr_store(path)), mode="r")


def write_group(path: AnyPath, mode: Any = "r+") -> zarr.Group:
    """Open a group for writing."""
    return zarr.open_group(_zarr_store(path), mode=mode)


def _zarr_store(path: AnyPath) -> Any:
    return LocalStore(path) if isinstance(path, Path) else FsspecStore.from_url(str(path), storage_options=OPTIONS)


def open_images(
    path: AnyPath, variables: tuple[Variable, ...], lengths: tuple[int, ...], axes: tuple[str, ...]
) -> zarr.Group:
    """Open the Zarr group of an image product, creating or resizing its arrays.

    No two units, and so no two writers, share a shard. A shard consists of inner chunks of about 1k x 1k pixels, each
    with a checksum; it has at most 4 x 4 of them, because several copies of a shard are in memory while it is written.
    Variables that are not compressed have no shards; their files hold about 512 full rows. An array that was created
    for another number of units is resized. One of another unit shape or type is replaced.

    Parameters
    ----------
    path : path
        Zarr group of the product.
    variables : tuple of Variable
        Arrays of the product.
    lengths : tuple of int
        Number of units along each axis over units.
    axes : tuple of str
        Names of the axes over units.

    Raises
    ------
    UserError
        If the store has something other than an array under the name of a variable.
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
        if variable.zeros:
            packing = [BloscCodec(cname="lz4", clevel=1, shuffle="noshuffle")]
        chunk, shard = _chunk_shapes(variable)
        group.create_array(
            variable.name,
            shape=shape,
            dtype=variable.dtype,
            chunks=ones + chunk,
            shards=None if shard is None else ones + shard,
            compressors=[*packing, Crc32cCodec()],
            fill_value=0,
            dimension_names=(*axes, *variable.axes),
            attributes=variable.attributes,
            overwrite=True,
        )
    return group


def limited_concurrency() -> Any:
    """Return a context in which Zarr decodes two chunks at a time instead of ten.

    The buffers of ten chunks take a quarter of a worker's memory. Two are not slower, as a process has one core.
    """
    return zarr.config.set({"async.concurrency": 2})


def write_array(array: zarr.Array[Any], unit_index: tuple[int, ...], values: np.ndarray) -> None:
    """Write the values of one unit, one file of its last two axes at a time.

    Zarr holds a second copy of the values that it writes, so one file at a time bounds the memory.

    Parameters
    ----------
    array : zarr.Array
        Array of the product.
    unit_index : tuple of int
        Indices of the unit along the axes over units.
    values : ndarray
        Values of the unit, of the variable's shape.
    """
    # a setting of the writer, not of the array; without it, chunks of zeros would not be written and would be missing
    array = array.with_config({"write_empty_chunks": True})
    file_shape = (array.shards or array.chunks)[len(unit_index) :]
    starts = [range(0, length, step) for length, step in zip(values.shape[-2:], file_shape[-2:], strict=True)]
    for corner in itertools.product(*starts):
        window: Any = (..., *(slice(low, low + step) for low, step in zip(corner, file_shape[-2:], strict=True)))
        with limited_concurrency():
            array[(*unit_index, *window)] = values[window]


def write_coordinate(
    group: zarr.Group, name: str, values: np.ndarray, axes: tuple[str, ...], attributes: dict[str, Any]
) -> None:
    """Write one coordinate array in a single chunk; strings are stored as variable-length UTF-8."""
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


def _chunk_shapes(variable: Variable) -> tuple[tuple[int, ...], tuple[int, ...] | None]:
    """Return the shapes of a chunk and of a shard of one unit; the latter is None for uncompressed variables."""
    planes, image = variable.shape[:-2], variable.shape[-2:]
    if not variable.compress:
        return (*planes, *(chunk_side(length, ROWS_A_FILE) for length in image[:-1]), image[-1]), None
    chunk = tuple(chunk_side(length) for length in image)
    shard = (min(_SHARD_CHUNKS, -(-length // side)) * side for length, side in zip(image, chunk, strict=True))
    return (*(1 for _ in planes), *chunk), (*planes, *shard)


def chunk_side(length: int, about: int = 1024) -> int:
    """Return the side of chunks that divide an axis as evenly as possible.

    Parameters
    ----------
    length : int
        Length of the axis, pixels.
    about : int
        Approximate side, pixels.
    """
    return -(-length // max(1, round(length / about)))
