"""Tables of galaxies or of stars in Parquet (a file or a folder) or FITS, with a map of their columns."""

from __future__ import annotations

import difflib
import warnings
from dataclasses import dataclass
from functools import lru_cache
from typing import Any

import numpy as np
import pandas as pd
import pyarrow as pa
from astropy.io import fits

from romandask.ingest import parquet
from romandask.ingest.rows import (
    COMPONENTS,
    FLOAT_COLUMNS,
    FLUX_COLUMNS,
    MAX_ROWS,
    TEXT_COLUMNS,
    Batch,
    duplicate_rows,
    file_states,
    identifiers,
    normal_form,
    with_reasons,
)
from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath, file_state, local_copy

MAPPED_COLUMNS = ("id", *FLOAT_COLUMNS, "n_knots", *TEXT_COLUMNS, *FLUX_COLUMNS)
"""Columns of the normal form that a column map may contain."""
DEFAULTS = {
    "galaxy": {"shear_1": 0.0, "shear_2": 0.0, "convergence": 0.0, "position_angle_unlensed": 0.0, "n_knots": 0.0}
    | {f"{c}_magnorm": np.inf for c in COMPONENTS}
    | {"bulge_av": 0.0, "bulge_rv": 3.1, "disk_av": 0.0, "disk_rv": 3.1, "MW_av": 0.0, "MW_rv": 3.1},
    "star": {"MW_av": 0.0, "MW_rv": 3.1},
}
"""Values of columns that are not in the column map: no lensing, no dust, no such component.

Three further defaults depend on other columns: a minor axis equals the major axis (round), the size of a missing
component is 0, and the knots have the spectrum of the disk.
"""
ID_PATTERN = r"(-?\d{1,18})"
"""Pattern of identifiers that are texts."""


@dataclass(frozen=True, kw_only=True)
class Source:
    """Tables of one kind of object, with the map of their columns."""

    paths: dict[str, AnyPath]
    """Files, by their path relative to the source."""
    columns: dict[str, str]
    """Column of the file, by column of the normal form."""
    constants: dict[str, float | str]
    """Value for all rows, by column of the normal form."""
    kind: str
    """galaxy or star."""
    rows: int
    """Largest number of rows of a batch."""
    edges: tuple[float, ...] = ()
    """Always empty: such tables have no top-hat spectra."""

    def batches(self) -> tuple[Batch, ...]:
        """Return the batches of all files."""
        return tuple(
            Batch(path, start, min(start + self.rows, total), key)
            for key, path in self.paths.items()
            for total in [_row_count(path)]
            for start in range(0, total, self.rows)
        )

    def count(self) -> int:
        """Return the number of rows of all files, from their headers."""
        return sum(_row_count(path) for path in self.paths.values())

    def state(self) -> Any:
        """Return the sizes and modification times of the files, and the column map."""
        return {"files": file_states(self.paths), "columns": self.columns, "constants": self.constants}

    def read(self, batch: Batch) -> pd.DataFrame:
        """Return all rows of a batch in the normal form."""
        read = _read_parquet if _is_parquet(batch.path) else _read_fits
        texts = {self.columns[name] for name in self.columns if name in TEXT_COLUMNS}
        values = read(batch, sorted(set(self.columns.values())), texts)
        out: dict[str, Any] = {**DEFAULTS[self.kind], **self.constants}
        for name, column in self.columns.items():
            out[name] = values[column]
        out["id"] = identifiers(out["id"], ID_PATTERN)
        if self.kind == "galaxy":
            for size in ("bulge", "disk"):
                out.setdefault(f"size_{size}_true", 0.0)
                out.setdefault(f"size_minor_{size}_true", out[f"size_{size}_true"])
            out.setdefault("knots_sed", out.get("disk_sed", ""))
        frame = normal_form(batch.source, np.arange(batch.start, batch.stop), self.kind, out)
        return with_reasons(frame, 0, _is_duplicate(batch, self.columns["id"]))


def open_source(path: AnyPath, columns: dict[str, str | float], kind: str, rows: int = MAX_ROWS) -> Source:
    """Open a table and check its files and its column map.

    Parameters
    ----------
    path : path
        A Parquet or FITS file, or a folder with Parquet files at any depth; names that begin with _ or . are left out.
    columns : dict
        For each column of the normal form, the column of the file, or a value for all rows: a number, or "=" followed
        by a text.
    kind : str
        galaxy or star.
    rows : int
        Largest number of rows of a batch.

    Raises
    ------
    UserError
        If a file is missing, damaged or in another format, or if the column map has an unknown column, lacks a
        required one, or names a column of the wrong type.
    """
    if kind not in DEFAULTS:
        raise UserError(f"{path}: kind {kind!r} is not known: expected galaxy or star")
    paths = _paths(path)
    for name in columns:
        if name not in MAPPED_COLUMNS:
            near = difflib.get_close_matches(name, MAPPED_COLUMNS, 1) or ["id, ra, dec, ..."]
            raise UserError(f"{path}: the column map names {name!r}, which romandask does not have: meant {near[0]!r}?")
    constants = {
        name: value.removeprefix("=") if isinstance(value, str) else float(value)
        for name, value in columns.items()
        if _is_constant(value)
    }
    names = {name: str(value) for name, value in columns.items() if name not in constants}
    for name, value in constants.items():
        if (name in TEXT_COLUMNS) != isinstance(value, str) or name == "id":
            expected = "the file's column" if name == "id" else "a name after =" if name in TEXT_COLUMNS else "a number"
            raise UserError(f"{path}: the column map gives {name} as {columns[name]!r}: expected {expected}")
    for file in paths.values():
        types = _column_types(file)
        _require(file, columns, kind, types)
        for name, column in names.items():
            if column not in types:
                lower = {other.lower(): other for other in types}
                near = difflib.get_close_matches(column.lower(), list(lower), 1)
                hint = f"; meant {lower[near[0]]!r}?" if near else ""
                raise UserError(f"{file}: column {column!r} (for {name}) is missing (found {', '.join(types)}){hint}")
            wanted = ("number", "text") if name == "id" else ("text",) if name in TEXT_COLUMNS else ("number",)
            if types[column] not in wanted:
                raise UserError(f"{file}: column {column!r} (for {name}) holds {types[column]}: expected {wanted[0]}")
    return Source(paths=paths, columns=names, constants=constants, kind=kind, rows=rows)


def _is_constant(value: str | float) -> bool:
    return not isinstance(value, str) or value.startswith("=")


def _require(path: AnyPath, columns: dict[str, Any], kind: str, found: dict[str, str]) -> None:
    """Raise a UserError if the column map lacks a required column; `found` has the columns of the file."""
    missing = [name for name in ("id", "ra", "dec") if name not in columns]
    if kind == "star":
        missing += [] if "magnorm" in columns or {"ref_mag", "ref_band"} <= set(columns) else ["magnorm"]
        missing += [] if "sed" in columns else ["sed"]
    else:
        missing += [] if "redshift" in columns else ["redshift"]
        given = [c for c in COMPONENTS if f"{c}_magnorm" in columns]
        missing += [] if given else ["one of bulge_magnorm, disk_magnorm, knots_magnorm"]
        for component in given:
            size = f"size_{'bulge' if component == 'bulge' else 'disk'}_true"
            sed = "disk_sed" if component == "knots" and "knots_sed" not in columns else f"{component}_sed"
            missing += [name for name in (size, sed) if name not in columns and name not in missing]
            missing += ["n_knots"] if component == "knots" and "n_knots" not in columns else []
    if missing:
        raise UserError(f"{path}: the column map of a {kind} lacks {'; '.join(missing)} (found {', '.join(found)})")


def _paths(path: AnyPath) -> dict[str, AnyPath]:
    """Return the files of a table, by their path relative to it."""
    if path.is_file():
        return {path.name: path}
    if not path.is_dir():
        raise UserError(f"{path}: no such file or folder; truth.path must name a table below data")
    files = {file.relative_to(path).as_posix(): file for file in sorted(path.rglob("*.parquet"))}
    files = {key: file for key, file in files.items() if not any(p.startswith(("_", ".")) for p in key.split("/"))}
    if not files:
        raise UserError(f"{path}: holds no .parquet file")
    return files


def _is_parquet(path: AnyPath) -> bool:
    with open(local_copy(path), "rb") as file:
        start = file.read(9)
    if start[:4] == b"PAR1":
        return True
    if start == b"SIMPLE  =":
        return False
    remedy = ": unpack it" if start[:2] == b"\x1f\x8b" else ""
    raise UserError(f"{path}: neither a Parquet nor a FITS file (begins with {start[:4]!r}){remedy}")


def _row_count(path: AnyPath) -> int:
    if _is_parquet(path):
        return parquet.count(path)
    with fits.open(local_copy(path), memmap=True) as hdus:
        return int(_table(path, hdus).header["NAXIS2"])


def _table(path: AnyPath, hdus: fits.HDUList) -> fits.BinTableHDU:
    """Return the first binary table of a FITS file."""
    for hdu in hdus:
        if isinstance(hdu, fits.BinTableHDU):
            return hdu
    raise UserError(f"{path}: holds no binary table")


def _column_types(path: AnyPath) -> dict[str, str]:
    """Return the type (number, text or other) of each column; raise a UserError if the file is not complete."""
    if _is_parquet(path):
        return {field.name: _arrow_type(field.type) for field in parquet.schema(path)}
    try:
        with warnings.catch_warnings():
            # astropy only warns of a truncated file; it is an error below
            warnings.simplefilter("ignore")
            with fits.open(local_copy(path), memmap=True) as hdus:
                hdu = _table(path, hdus)
                end = hdu.fileinfo()["datLoc"] + hdu.header["NAXIS1"] * hdu.header["NAXIS2"]
                formats = [(column.name, column.format) for column in hdu.columns]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}: not a complete FITS file ({error}): copy it again") from None
    if path.stat().st_size < end:
        raise UserError(f"{path}: not a complete FITS file ({path.stat().st_size} bytes of {end}): copy it again")
    types = {}
    for name, code in formats:
        letter = code.lstrip("0123456789")[:1]
        count = code[: len(code) - len(code.lstrip("0123456789"))] or "1"
        types[name] = "text" if letter == "A" else "number" if letter in "LBIJKED" and count == "1" else "other"
    return types


def _arrow_type(data_type: pa.DataType) -> str:
    """Return number, text or other."""
    if pa.types.is_dictionary(data_type):
        data_type = data_type.value_type
    if pa.types.is_integer(data_type) or pa.types.is_floating(data_type) or pa.types.is_decimal(data_type):
        return "number"
    if pa.types.is_string(data_type) or pa.types.is_large_string(data_type) or pa.types.is_string_view(data_type):
        return "text"
    return "other"


def _read_parquet(batch: Batch, columns: list[str], texts: set[str]) -> dict[str, np.ndarray]:
    table = parquet.read(batch.path, columns, batch.start, batch.stop)
    return {n: parquet.texts(table[n]) if n in texts else _to_numpy(table[n]) for n in columns}


def _to_numpy(column: pa.ChunkedArray) -> np.ndarray:
    if pa.types.is_integer(column.type):
        # integers with nulls would lose digits if converted to floats
        return column.to_numpy() if not column.null_count else column.to_pandas(integer_object_nulls=True).to_numpy()
    return parquet.numbers(column) if _arrow_type(column.type) == "number" else parquet.texts(column)


def _read_fits(batch: Batch, columns: list[str], texts: set[str]) -> dict[str, np.ndarray]:
    with fits.open(local_copy(batch.path), memmap=True) as hdus:
        rows = _table(batch.path, hdus).data[batch.start : batch.stop]
        return {name: _normalised(rows[name]) for name in columns}


def _normalised(values: np.ndarray) -> np.ndarray:
    """Return a copy in native byte order, and texts without surrounding blanks."""
    if values.dtype.kind in "SU":
        return np.array([text.strip() for text in values.astype(str).tolist()], object)
    return np.array(values.astype(values.dtype.newbyteorder("=")))


def _is_duplicate(batch: Batch, column: str) -> np.ndarray:
    """Return, for each row of a batch, whether an earlier row of its file has the same identifier."""
    if _is_parquet(batch.path):
        return parquet.is_duplicate(batch, column, ID_PATTERN)
    rows = _duplicate_rows_of_fits(batch.path, file_state(batch.path)[1], column)
    return np.isin(np.arange(batch.start, batch.stop), rows)


@lru_cache(maxsize=4)
def _duplicate_rows_of_fits(path: AnyPath, modified: int, column: str) -> np.ndarray:
    """Return the rows of a file with the identifier of an earlier row; `modified` (ns) keys the cache."""
    with fits.open(local_copy(path), memmap=True) as hdus:
        data = _table(path, hdus).data
        parts = [data[start : start + MAX_ROWS][column] for start in range(0, len(data), MAX_ROWS)]
        return duplicate_rows(
            np.concatenate([identifiers(_normalised(part), ID_PATTERN) for part in parts] or [np.empty(0, int)])
        )
