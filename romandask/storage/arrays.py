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
from zarr.core.sync import sync
from zarr.storage import FsspecStore, LocalStore, WrapperStore

from romandask.model.errors import UserError
from romandask.model.tiles import PatchGrid
from romandask.storage.paths import OPTIONS, AnyPath

ROWS_A_FILE = 512
"""Approximate image rows per file of a variable that is not compressed."""
_CHUNK_PIXELS = 512
"""Approximate side of an inner chunk, pixels: coadds read windows of exposures, and detection reads patches of coadds
with a border; both decode the chunks that these touch."""
_SHARD_CHUNKS = 8
"""Most inner chunks along each side of a shard."""
PATCH_AXES = ("patch_y", "patch_x")
"""Names of the axes over the rows and the columns of the patches of an image."""
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
    fill: float = 0
    """Value of which large areas may consist; chunks of it are not stored, except in a file that has no others."""

    @property
    def is_image(self) -> bool:
        """Whether the last two axes are those of an image of the sky, which may be divided into patches."""
        return self.axes[-2:] == ("y", "x")


@dataclass(frozen=True)
class Layout:
    """Arrays of an image product, and its units.

    Without patches a unit is one index along `axes`. With patches it is a patch of it, and the units are in C order
    along `axes`, patch row and patch column: an image, a variable with the axes y and x whose shape is that of the
    whole image, is divided among the units, and every other variable belongs to a patch.
    """

    variables: tuple[Variable, ...]
    axes: tuple[str, ...]
    """Names of the axes over units."""
    lengths: tuple[int, ...]
    """Number of units along each of `axes`."""
    patches: PatchGrid | None = None
    """Division of images into patches."""

    def variable(self, name: str) -> Variable:
        """Return the variable with a name."""
        return next(variable for variable in self.variables if variable.name == name)

    @property
    def unit_lengths(self) -> tuple[int, ...]:
        """Number of units along each axis over units, and along the rows and columns of patches if there are any."""
        return self.lengths if self.patches is None else (*self.lengths, self.patches.count, self.patches.count)

    def leading(self, variable: Variable) -> tuple[tuple[str, ...], tuple[int, ...]]:
        """Return names and lengths of the leading axes of a stored variable."""
        if self.patches is None or variable.is_image:
            return self.axes, self.lengths
        return (*self.axes, *PATCH_AXES), self.unit_lengths

    def place(self, unit: int) -> tuple[int, ...]:
        """Return the indices of a unit along `axes`, followed by the row and column of its patch if there are any."""
        return tuple(int(k) for k in np.unravel_index(unit, self.unit_lengths))

    def unit(self, *place: int) -> int:
        """Return the index of the unit at some indices along `axes`, and the row and column of a patch."""
        return int(np.ravel_multi_index(place, self.unit_lengths))

    def location(self, variable: Variable, unit: int) -> tuple[tuple[int, ...], tuple[int, int], tuple[int, ...]]:
        """Return where the values of a unit are in a stored variable.

        Returns
        -------
        lead : tuple of int
            Indices along the leading axes.
        corner : (int, int)
            Row and column of the first pixel.
        shape : tuple of int
            Shape of the values.
        """
        place = self.place(unit)
        if self.patches is None or not variable.is_image:
            return place, (0, 0), variable.shape
        rows, columns = self.patches.window(*place[-2:])
        shape = (*variable.shape[:-2], rows.stop - rows.start, columns.stop - columns.start)
        return place[:-2], (rows.start, columns.start), shape

    def stored_index(self, name: str, unit: int, window: tuple[slice, ...]) -> tuple[Any, ...]:
        """Return the index into a stored array of a window of the last axes of the values of a unit."""
        variable = self.variable(name)
        lead, corner, shape = self.location(variable, unit)
        if self.patches is not None and variable.is_image:
            inner = limited(window[-2:], shape[-2:])
            shifted = (slice(first + w.start, first + w.stop) for first, w in zip(corner, inner, strict=True))
            window = (*window[:-2], *shifted)
        return (*lead, ..., *window)


def limited(window: tuple[slice, ...], shape: tuple[int, ...]) -> tuple[slice, ...]:
    """Return a window of an image with its limits as numbers; () is the whole image.

    Examples
    --------
    >>> limited((slice(None, 3), slice(2, 99)), (8, 9))
    (slice(0, 3, None), slice(2, 9, None))
    """
    limits = []
    for part, length in zip(window or (slice(None),) * len(shape), shape, strict=True):
        start, stop, step = part.indices(length)
        if step != 1:
            raise ValueError("windows of images have every pixel: no step")
        limits.append(slice(start, max(start, stop)))
    return tuple(limits)


class _StrictStore(WrapperStore[ZarrStore]):
    """A Zarr store in which a missing or empty file is an error; Zarr would return zeros, which look like an image."""

    async def get(self, key: str, prototype: BufferPrototype, byte_range: ByteRequest | None = None) -> Buffer | None:
        """Return the bytes of a key, None for missing metadata; raise FileNotFoundError for a chunk without bytes."""
        content = await super().get(key, prototype, byte_range)
        if not content and _CHUNK_KEY.search(key):
            raise FileNotFoundError(f"{self._store}/{key}: the chunk is {'gone' if content is None else 'empty'}")
        return content


def read_group(path: AnyPath) -> zarr.Group:
    """Open a stored group for reading; a missing chunk raises FileNotFoundError."""
    return zarr.open_group(_StrictStore(_zarr_store(path)), mode="r")


def write_group(path: AnyPath, mode: Any = "r+") -> zarr.Group:
    """Open a group for writing."""
    return zarr.open_group(_zarr_store(path), mode=mode)


def _zarr_store(path: AnyPath) -> Any:
    return LocalStore(path) if isinstance(path, Path) else FsspecStore.from_url(str(path), storage_options=OPTIONS)


def open_images(path: AnyPath, layout: Layout) -> zarr.Group:
    """Open the Zarr group of an image product, creating or resizing its arrays.

    No two units, and so no two writers, share a shard. A shard consists of inner chunks of about 512 x 512 pixels, each
    with a checksum; it has at most 8 x 8 of them, because several copies of a shard are in memory while it is written.
    Variables that are not compressed have no shards; their files hold about 512 full rows. An array that was created
    for another number of units is resized. One of another unit shape, chunk shape or type is replaced.

    With patches, an image is one array of the full image whose shards are patches, of 2 x 2 inner chunks; other
    variables have two more axes, the row and the column of the patch.

    Parameters
    ----------
    path : path
        Zarr group of the product.
    layout : Layout
        Arrays of the product, and its units.

    Raises
    ------
    UserError
        If the store has something other than an array under the name of a variable.
    """
    group = write_group(path, "a")
    for variable in layout.variables:
        unit_axes, unit_lengths = layout.leading(variable)
        ones = (1,) * len(unit_lengths)
        shape = (*unit_lengths, *variable.shape)
        chunk, shard = _chunk_shapes(variable, layout.patches)
        chunks, shards = ones + chunk, None if shard is None else ones + shard
        if variable.name in group:
            array = group[variable.name]
            if not isinstance(array, zarr.Array):
                raise UserError(f"{path}/{variable.name}: not an array: use another store")
            stored = array.shape[len(unit_lengths) :], array.chunks, array.shards, array.dtype, array.fill_value
            if stored == (variable.shape, chunks, shards, np.dtype(variable.dtype), variable.fill):
                if array.shape != shape:
                    array.resize(shape)
                array.update_attributes(variable.attributes)
                continue
        packing = [BloscCodec(cname="zstd", clevel=1, shuffle="bitshuffle")] if variable.compress else []
        if variable.zeros:
            packing = [BloscCodec(cname="lz4", clevel=1, shuffle="noshuffle")]
        group.create_array(
            variable.name,
            shape=shape,
            dtype=variable.dtype,
            chunks=chunks,
            shards=shards,
            compressors=[*packing, Crc32cCodec()],
            fill_value=variable.fill,
            dimension_names=(*unit_axes, *variable.axes),
            attributes=variable.attributes,
            overwrite=True,
        )
    return group


def limited_concurrency() -> Any:
    """Return a context in which Zarr decodes two chunks at a time instead of ten.

    The buffers of ten chunks take a quarter of a worker's memory. Two are not slower, as a process has one core.
    """
    return zarr.config.set({"async.concurrency": 2})


def write_array(
    array: zarr.Array[Any], unit_index: tuple[int, ...], values: np.ndarray, corner: tuple[int, ...] = (0, 0)
) -> None:
    """Write the values of one unit, one file of its last two axes at a time.

    Zarr holds a second copy of the values that it writes, so one file at a time bounds the memory. An earlier file is
    removed first: Zarr would read it, also where every value of it is written, and fail if it is damaged.

    Parameters
    ----------
    array : zarr.Array
        Array of the product.
    unit_index : tuple of int
        Indices of the unit along the axes over units.
    values : ndarray
        Values of the unit.
    corner : (int, int)
        Row and column of the first pixel of the unit in the stored image, which has the pixels of other units too if it
        is divided into patches; an array of one axis has only the second.
    """
    # settings of the writer, not of the array. A chunk of the fill value is left out of a file that has others, whose
    # index says so; a file of such chunks alone is written, because a missing file is an error.
    complete, sparse = (array.with_config({"write_empty_chunks": written}) for written in (True, False))
    file_shape = (array.shards or array.chunks)[len(unit_index) :]
    starts = [range(0, length, step) for length, step in zip(values.shape[-2:], file_shape[-2:], strict=True)]
    corner = corner[-len(starts) :]
    for start in itertools.product(*starts):
        ends = [
            min(low + step, length) for low, step, length in zip(start, file_shape[-2:], values.shape[-2:], strict=True)
        ]
        own: Any = (..., *(slice(low, high) for low, high in zip(start, ends, strict=True)))
        first = corner[-len(start) :]
        stored: Any = [slice(origin + low, origin + high) for origin, low, high in zip(first, start, ends, strict=True)]
        planes = (0,) * (values.ndim - 2)
        rows_and_columns = (place.start // step for place, step in zip(stored, file_shape[-2:], strict=True))
        _remove_file(array, (*unit_index, *planes, *rows_and_columns))
        writer = complete if array.shards is None or (values[own] == array.fill_value).all() else sparse
        with limited_concurrency():
            writer[(*unit_index, ..., *stored)] = values[own]


def _remove_file(array: zarr.Array[Any], file_index: tuple[int, ...]) -> None:
    """Remove a file (shard, or chunk without shards) of an array, given its indices in the grid of files."""
    sync((array.store_path / array.metadata.encode_chunk_key(file_index)).delete())


def write_coordinate(
    group: zarr.Group, name: str, values: np.ndarray, axes: tuple[str, ...], attributes: dict[str, Any]
) -> None:
    """Write one coordinate array in a single chunk; strings are stored as variable-length UTF-8.

    An array that is stored with the same values is left as it is, because others may be reading it.
    """
    if _has_coordinate(group, name, values, axes, attributes):
        return
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


def _has_coordinate(
    group: zarr.Group, name: str, values: np.ndarray, axes: tuple[str, ...], attributes: dict[str, Any]
) -> bool:
    """Return whether a group has a coordinate with these values; a damaged one counts as missing."""
    try:
        array = group[name]
        if not isinstance(array, zarr.Array) or array.shape != values.shape or dict(array.attrs) != attributes:
            return False
        stored = np.asarray(array[...])
    except (KeyError, OSError, ValueError, RuntimeError, TypeError):
        return False
    kinds = ["text" if kind in "OUT" else kind for kind in (stored.dtype.kind, values.dtype.kind)]
    same_names = getattr(array.metadata, "dimension_names", None) == axes
    return same_names and kinds[0] == kinds[1] and np.array_equal(stored.astype(values.dtype), values)


def _chunk_shapes(variable: Variable, patches: PatchGrid | None) -> tuple[tuple[int, ...], tuple[int, ...] | None]:
    """Return the shapes of a chunk and of a shard of one unit; the latter is None for uncompressed variables."""
    planes, image = variable.shape[:-2], variable.shape[-2:]
    if patches is not None and variable.is_image:
        half = patches.side // 2
        if not variable.compress:
            return (*planes, half, 2 * half), None
        # a quarter of a large patch, which divides it if its side is a multiple of four
        side = half // 2 if half % 2 == 0 and half > _CHUNK_PIXELS else half
        return (*(1 for _ in planes), side, side), (*planes, 2 * half, 2 * half)
    if not variable.compress:
        return (*planes, *(chunk_side(length, ROWS_A_FILE) for length in image[:-1]), image[-1]), None
    chunk = tuple(chunk_side(length, _CHUNK_PIXELS) for length in image)
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
