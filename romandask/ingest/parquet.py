"""Parquet files, read in slices of rows, so that memory is bounded for any size of files and row groups."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from romandask.ingest.rows import Batch, duplicate_rows, identifiers
from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath, file_state, local_copy

CHUNK = 20_000
"""Number of rows that are decoded at a time."""


def schema(path: AnyPath) -> pa.Schema:
    """Return the schema of a file.

    Raises
    ------
    UserError
        If the file is missing or not a complete Parquet file.
    """
    try:
        return pq.read_schema(local_copy(path))
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except (pa.ArrowInvalid, OSError):
        raise UserError(f"{path}: not a complete Parquet file ({path.stat().st_size} bytes): copy it again") from None


def count(path: AnyPath) -> int:
    """Return the number of rows of a file, from its footer."""
    return pq.read_metadata(local_copy(path)).num_rows


def slices(path: AnyPath, key: str, rows: int) -> tuple[Batch, ...]:
    """Return batches that cover a file.

    Parameters
    ----------
    path : path
        The file.
    key : str
        Key of the batches (`Batch.key`).
    rows : int
        Largest number of rows of a batch.
    """
    total = count(path)
    return tuple(Batch(path, start, min(start + rows, total), key) for start in range(0, total, rows))


def read(path: AnyPath, columns: list[str], start: int, stop: int) -> pa.Table:
    """Return the rows from `start` to `stop` (exclusive) of a file; lists are in single precision.

    Raises
    ------
    UserError
        If a page is damaged or the file cannot be read.
    """
    parts = []
    for offset, part in _pieces(path, columns, start, stop):
        first, last = max(start - offset, 0), min(stop - offset, part.num_rows)
        if last > first:
            parts.append(_with_float32_lists(pa.Table.from_batches([part.slice(first, last - first)])))
    return pa.concat_tables(parts) if parts else schema(path).empty_table().select(columns)


def _with_float32_lists(table: pa.Table) -> pa.Table:
    """Return a table with lists of floats in single precision, because spectra take most of the memory."""
    float32_list = pa.list_(pa.float32())
    has_lists = [pa.types.is_list(field.type) and pa.types.is_floating(field.type.value_type) for field in table.schema]
    fields = [f.with_type(float32_list) if is_list else f for f, is_list in zip(table.schema, has_lists, strict=True)]
    return table.cast(pa.schema(fields), safe=False) if any(has_lists) else table


@lru_cache(maxsize=4)
def _duplicate_rows(path: AnyPath, modified: int, column: str, pattern: str) -> np.ndarray:
    """Return the rows of a file with the identifier of an earlier row; `modified` (ns) keys the cache."""
    total = count(path)
    ids = np.empty(total, np.int64)
    for offset, part in _pieces(path, [column], 0, total):
        ids[offset : offset + part.num_rows] = integers(pa.chunked_array([part.column(0)]), pattern)
    return duplicate_rows(ids)


def is_duplicate(batch: Batch, column: str, pattern: str) -> np.ndarray:
    """Return, for each row of a batch, whether an earlier row of its file has the same identifier.

    Parameters
    ----------
    batch : Batch
        Rows of a file.
    column : str
        Column of the identifiers.
    pattern : str
        Pattern of the identifiers (see `romandask.ingest.rows.identifiers`).
    """
    rows = _duplicate_rows(batch.path, file_state(batch.path)[1], column, pattern)
    return np.isin(np.arange(batch.start, batch.stop), rows)


def numbers(column: pa.ChunkedArray) -> np.ndarray:
    """Return a column as float64, with NaN for null."""
    return np.asarray(pc.cast(column, pa.float64(), safe=False).to_numpy(), float)


def texts(column: pa.ChunkedArray) -> np.ndarray:
    """Return a column as text without surrounding blanks, with "" for null."""
    text = pc.fill_null(pc.cast(column, pa.string()), "")
    return np.asarray(pc.utf8_trim_whitespace(text).to_numpy(), object)


def integers(column: pa.ChunkedArray, pattern: str) -> np.ndarray:
    """Return a column of identifiers as int64 (see `romandask.ingest.rows.identifiers`), with -1 for null."""
    if pa.types.is_integer(column.type):
        return np.where(pc.is_null(column).to_numpy(), -1, identifiers(pc.fill_null(column, 0).to_numpy()))
    if pa.types.is_floating(column.type):
        return identifiers(numbers(column))
    return identifiers(texts(column), pattern)


def float_lists(column: pa.ChunkedArray) -> np.ndarray:
    """Return a column of lists as an object array of float32 arrays, with an empty array for null."""
    array = column.combine_chunks() if column.num_chunks != 1 else column.chunk(0)
    lengths = pc.fill_null(pc.list_value_length(array), 0).to_numpy(zero_copy_only=False).astype(np.int64)
    flat = np.asarray(pc.cast(pc.list_flatten(array), pa.float32(), safe=False).to_numpy(zero_copy_only=False))
    out = np.empty(len(lengths), object)
    ends = np.cumsum(lengths)
    for row, (end, length) in enumerate(zip(ends.tolist(), lengths.tolist(), strict=True)):
        out[row] = flat[end - length : end]
    return out


def _pieces(path: AnyPath, columns: list[str], start: int, stop: int) -> Iterator[tuple[int, pa.RecordBatch]]:
    """Yield (first row, rows) for the row groups that contain rows from `start` to `stop`, and end at `stop`."""
    try:
        # pre-buffering would load complete row groups, which have a million rows in some files
        with pq.ParquetFile(
            local_copy(path), page_checksum_verification=True, pre_buffer=False, buffer_size=1 << 20
        ) as file:
            sizes = [file.metadata.row_group(index).num_rows for index in range(file.metadata.num_row_groups)]
            ends = np.cumsum(sizes)
            groups = [i for i, size in enumerate(sizes) if ends[i] > start and ends[i] - size < stop]
            if not groups:
                return
            offset = int(ends[groups[0]] - sizes[groups[0]])
            for part in file.iter_batches(CHUNK, row_groups=groups, columns=columns):
                yield offset, part
                offset += part.num_rows
                if offset >= stop:
                    return
    except (pa.ArrowInvalid, OSError) as error:
        raise UserError(f"{path}: cannot be read ({str(error).splitlines()[0]}): copy it again") from None
