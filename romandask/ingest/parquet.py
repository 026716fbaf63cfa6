"""Parquet files, read in slices of rows, so that memory is bounded for any size of files and row groups."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
from astropy.table.meta import YamlParseError, get_header_from_yaml

from romandask.ingest.identifiers import INTEGER, Identifiers, check_floats, identifiers
from romandask.ingest.rows import MAX_ROWS, Batch
from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath, local_copy

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
    """Return the rows from `start` to `stop` (exclusive) of a file; masked values are null, lists in single precision.

    Raises
    ------
    UserError
        If a page is damaged or the file cannot be read.
    """
    masks = _masks(schema(path), columns)
    parts = []
    for offset, part in _pieces(path, [*columns, *masks.values()], start, stop):
        first, last = max(start - offset, 0), min(stop - offset, part.num_rows)
        if last > first:
            table = _without_masked(pa.Table.from_batches([part.slice(first, last - first)]), masks)
            parts.append(_with_float32_lists(table.select(columns)))
    return pa.concat_tables(parts) if parts else schema(path).empty_table().select(columns)


def _masks(found: pa.Schema, columns: list[str]) -> dict[str, str]:
    """Return the columns with the masks of other columns, as astropy writes them for masked columns."""
    names = {column: f"{column}.mask" for column in columns}
    known = {field.name for field in found if pa.types.is_boolean(field.type)}
    return {column: mask for column, mask in names.items() if mask in known}


def _without_masked(table: pa.Table, masks: dict[str, str]) -> pa.Table:
    """Return a table with null for the masked values."""
    for column, mask in masks.items():
        kept = pc.if_else(table[mask], pa.scalar(None, table[column].type), table[column])
        table = table.set_column(table.column_names.index(column), table.schema.field(column), kept)
    return table


def _with_float32_lists(table: pa.Table) -> pa.Table:
    """Return a table with lists of floats in single precision, because spectra take most of the memory."""
    float32_list = pa.list_(pa.float32())
    has_lists = [pa.types.is_list(field.type) and pa.types.is_floating(field.type.value_type) for field in table.schema]
    fields = [f.with_type(float32_list) if is_list else f for f, is_list in zip(table.schema, has_lists, strict=True)]
    return table.cast(pa.schema(fields), safe=False) if any(has_lists) else table


def scalars(column: pa.ChunkedArray) -> pa.ChunkedArray:
    """Return a column whose values are lists of one value as these values, and any other column as it is."""
    if pa.types.is_fixed_size_list(column.type) and column.type.list_size == 1:
        return pc.list_element(column, 0)
    return column


def numbers(column: pa.ChunkedArray) -> np.ndarray:
    """Return a column as float64, with NaN for null."""
    return np.asarray(pc.cast(scalars(column), pa.float64(), safe=False).to_numpy(), float)


def texts(column: pa.ChunkedArray) -> np.ndarray:
    """Return a column as text without surrounding blanks, with "" for null."""
    text = pc.fill_null(pc.cast(column, pa.string()), "")
    return np.asarray(pc.utf8_trim_whitespace(text).to_numpy(), object)


def identifiers_of(column: pa.ChunkedArray, pattern: str = INTEGER) -> Identifiers:
    """Return a column as identifiers; `pattern` is that of texts (see `romandask.ingest.identifiers`)."""
    column = scalars(column)
    if pa.types.is_integer(column.type):
        return identifiers(pc.fill_null(column, 0).to_numpy(), missing=pc.is_null(column).to_numpy())
    if pa.types.is_floating(column.type):
        return identifiers(np.asarray(column.to_numpy()))
    found = texts(column)
    if pa.types.is_decimal(column.type):
        found = np.array([text.rstrip("0").rstrip(".") if "." in text else text for text in found], object)
    return identifiers(found, pattern)


def check_identifiers(path: AnyPath, column: str) -> None:
    """Raise a UserError if a column holds floats that cannot be identifiers."""
    if not pa.types.is_floating(schema(path).field(column).type):
        return
    for start in range(0, count(path), MAX_ROWS):
        part = read(path, [column], start, start + MAX_ROWS)
        check_floats(path, column, scalars(part[column]).to_numpy())


def kinds(path: AnyPath) -> dict[str, str]:
    """Return what each column of a file holds: number, text, lists, or the name of another type."""
    return {field.name: _kind(field.type) for field in schema(path)}


def _kind(data_type: pa.DataType) -> str:
    if pa.types.is_fixed_size_list(data_type) and data_type.list_size == 1:
        data_type = data_type.value_type
    if pa.types.is_dictionary(data_type):
        data_type = data_type.value_type
    numbers_like = (pa.types.is_integer, pa.types.is_floating, pa.types.is_decimal, pa.types.is_null)
    if any(test(data_type) for test in numbers_like):
        return "number"
    if pa.types.is_string(data_type) or pa.types.is_large_string(data_type) or pa.types.is_string_view(data_type):
        return "text"
    if pa.types.is_list(data_type) or pa.types.is_large_list(data_type) or pa.types.is_fixed_size_list(data_type):
        return "lists" if _kind(data_type.value_type) == "number" else str(data_type)
    return str(data_type)


def units(path: AnyPath) -> dict[str, str]:
    """Return the unit of each column that has one, in its metadata or in that which astropy writes."""
    found = schema(path)
    out = {field.name: (field.metadata or {}).get(b"unit", b"").decode() for field in found}
    if header := (found.metadata or {}).get(b"table_meta_yaml"):
        try:
            described = get_header_from_yaml(header.decode().splitlines())["datatype"]
        except (YamlParseError, ValueError, KeyError):
            described = []
        out |= {column["name"]: str(column["unit"]) for column in described if column.get("unit") is not None}
    return {name: unit for name, unit in out.items() if unit}


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
