"""Parquet files a slice of rows at a time: memory stays bounded whatever the size of the file or of a row group."""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from romandask.ingest.rows import Batch, identifiers, repeats
from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath, file_state, local_copy

CHUNK = 20_000
"""Rows decoded at once."""


def schema(path: AnyPath) -> pa.Schema:
    """Return the schema of a file; UserError where it is missing or not complete."""
    try:
        return pq.read_schema(local_copy(path))
    except FileNotFoundError:
        raise UserError(f"{path}: no such file") from None
    except (pa.ArrowInvalid, OSError):
        raise UserError(f"{path}: not a complete Parquet file ({path.stat().st_size} bytes): copy it again") from None


def count(path: AnyPath) -> int:
    """Return the rows of a file, from its footer."""
    return pq.read_metadata(local_copy(path)).num_rows


def slices(path: AnyPath, key: str, rows: int) -> tuple[Batch, ...]:
    """Return batches of at most `rows` rows that cover a file."""
    total = count(path)
    return tuple(Batch(path, start, min(start + rows, total), key) for start in range(0, total, rows))


def read(path: AnyPath, columns: list[str], start: int, stop: int) -> pa.Table:
    """Return rows start..stop of a file; UserError where a page is damaged."""
    parts = []
    for offset, part in _pieces(path, columns, start, stop):
        first, last = max(start - offset, 0), min(stop - offset, part.num_rows)
        if last > first:
            parts.append(_single(pa.Table.from_batches([part.slice(first, last - first)])))
    return pa.concat_tables(parts) if parts else schema(path).empty_table().select(columns)


def _single(table: pa.Table) -> pa.Table:
    """Return a table with lists in single precision: spectra are most of the memory."""
    lists = pa.list_(pa.float32())
    wide = [pa.types.is_list(field.type) and pa.types.is_floating(field.type.value_type) for field in table.schema]
    fields = [f.with_type(lists) if is_wide else f for f, is_wide in zip(table.schema, wide, strict=True)]
    return table.cast(pa.schema(fields), safe=False) if any(wide) else table


@lru_cache(maxsize=4)
def repeated_rows(path: AnyPath, stamp: int, column: str, pattern: str) -> np.ndarray:
    """Return the rows of a file whose id an earlier row has; `stamp` is the file's time of change."""
    total = count(path)
    ids = np.empty(total, np.int64)
    for offset, part in _pieces(path, [column], 0, total):
        ids[offset : offset + part.num_rows] = integers(pa.chunked_array([part.column(0)]), pattern)
    return repeats(ids)


def repeated(batch: Batch, column: str, pattern: str) -> np.ndarray:
    """Return, for the rows of a batch, whether an earlier row of its file has the same id."""
    rows = repeated_rows(batch.path, file_state(batch.path)[1], column, pattern)
    return np.isin(np.arange(batch.start, batch.stop), rows)


def numbers(column: pa.ChunkedArray) -> np.ndarray:
    """Return a column as float64, NaN for null."""
    return np.asarray(pc.cast(column, pa.float64(), safe=False).to_numpy(), float)


def texts(column: pa.ChunkedArray) -> np.ndarray:
    """Return a column as stripped text, empty for null."""
    text = pc.fill_null(pc.cast(column, pa.string()), "")
    return np.asarray(pc.utf8_trim_whitespace(text).to_numpy(), object)


def integers(column: pa.ChunkedArray, pattern: str) -> np.ndarray:
    """Return identifiers as int64, -1 where there is none."""
    if pa.types.is_integer(column.type):
        return np.where(pc.is_null(column).to_numpy(), -1, identifiers(pc.fill_null(column, 0).to_numpy()))
    if pa.types.is_floating(column.type):
        return identifiers(numbers(column))
    return identifiers(texts(column), pattern)


def bins(column: pa.ChunkedArray) -> np.ndarray:
    """Return a column of lists as an object array of float32 arrays, empty for null."""
    array = column.combine_chunks() if column.num_chunks != 1 else column.chunk(0)
    lengths = pc.fill_null(pc.list_value_length(array), 0).to_numpy(zero_copy_only=False).astype(np.int64)
    flat = np.asarray(pc.cast(pc.list_flatten(array), pa.float32(), safe=False).to_numpy(zero_copy_only=False))
    out = np.empty(len(lengths), object)
    ends = np.cumsum(lengths)
    for row, (end, length) in enumerate(zip(ends.tolist(), lengths.tolist(), strict=True)):
        out[row] = flat[end - length : end]
    return out


def _pieces(path: AnyPath, columns: list[str], start: int, stop: int) -> Iterator[tuple[int, pa.RecordBatch]]:
    """Yield (first row, rows) of the row groups that hold rows start..stop, up to `stop`."""
    try:
        # no pre-buffering: it would hold whole row groups, which hold a million rows in some files
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
