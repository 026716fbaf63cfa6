"""Any table of galaxies or of stars, Parquet (a file or a folder) or FITS, with a map of its columns."""

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
    FLOATS,
    FLUXES,
    MAX_ROWS,
    TEXTS,
    Batch,
    file_states,
    identifiers,
    normal_form,
    repeats,
    with_reasons,
)
from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath, file_state, local_copy

TARGETS = ("id", *FLOATS, "n_knots", *TEXTS, *FLUXES)
"""Columns of the normal form that a map may name."""
DEFAULTS = {
    "galaxy": {"shear_1": 0.0, "shear_2": 0.0, "convergence": 0.0, "position_angle_unlensed": 0.0, "n_knots": 0.0}
    | {f"{c}_magnorm": np.inf for c in COMPONENTS}
    | {"bulge_av": 0.0, "bulge_rv": 3.1, "disk_av": 0.0, "disk_rv": 3.1, "MW_av": 0.0, "MW_rv": 3.1},
    "star": {"MW_av": 0.0, "MW_rv": 3.1},
}
"""Values of columns that the map leaves out: no lensing, no dust, no such component. A minor axis left out is the major
axis (round), sizes of components left out are 0, the knots' spectrum left out is the disk's."""
PATTERN = r"(-?\d{1,18})"


@dataclass(frozen=True)
class Source:
    """Tables of one kind of object, with the map of their columns."""

    paths: dict[str, AnyPath]
    """By path relative to the source."""
    columns: dict[str, str]
    """The file's column by that of the normal form."""
    constants: dict[str, float | str]
    kind: str
    rows: int
    """Most rows of a batch."""
    edges: tuple[float, ...] = ()

    def batches(self) -> tuple[Batch, ...]:
        """Return slices of the files."""
        return tuple(
            Batch(path, start, min(start + self.rows, total), key)
            for key, path in self.paths.items()
            for total in [_count(path)]
            for start in range(0, total, self.rows)
        )

    def count(self) -> int:
        """Return the rows of all files, from their headers."""
        return sum(_count(path) for path in self.paths.values())

    def state(self) -> Any:
        """Return bytes and times of the files, and the map."""
        return {"files": file_states(self.paths), "columns": self.columns, "constants": self.constants}

    def read(self, batch: Batch) -> pd.DataFrame:
        """Return all rows of a batch in the normal form."""
        read = _read_parquet if _is_parquet(batch.path) else _read_fits
        found = read(batch, sorted(set(self.columns.values())), {self.columns[n] for n in self.columns if n in TEXTS})
        out: dict[str, Any] = {**DEFAULTS[self.kind], **self.constants}
        for name, column in self.columns.items():
            out[name] = found[column]
        out["id"] = identifiers(out["id"], PATTERN)
        if self.kind == "galaxy":
            for size in ("bulge", "disk"):
                out.setdefault(f"size_{size}_true", 0.0)
                out.setdefault(f"size_minor_{size}_true", out[f"size_{size}_true"])
            out.setdefault("knots_sed", out.get("disk_sed", ""))
        frame = normal_form(batch.source, np.arange(batch.start, batch.stop), self.kind, out)
        return with_reasons(frame, 0, _repeated(batch, self.columns["id"]))


def open_source(path: AnyPath, columns: dict[str, str | float], kind: str, rows: int = MAX_ROWS) -> Source:
    """Return a table, its map and its files checked.

    Parameters
    ----------
    path : a Parquet or FITS file, or a folder with Parquet files at any depth (names with a leading _ are left out)
    columns : for columns of the normal form the file's column, or a number, or a text after "=", for all rows
    kind : galaxy or star
    rows : most rows of a batch

    Raises
    ------
    UserError
        If a file is missing, damaged or of another format, or the map names what is not there or lacks something.
    """
    if kind not in DEFAULTS:
        raise UserError(f"{path}: kind {kind!r} is not known: expected galaxy or star")
    paths = _paths(path)
    for name in columns:
        if name not in TARGETS:
            near = difflib.get_close_matches(name, TARGETS, 1) or ["id, ra, dec, ..."]
            raise UserError(f"{path}: the column map names {name!r}, which romandask does not have: meant {near[0]!r}?")
    constants = {k: v.removeprefix("=") if isinstance(v, str) else float(v) for k, v in columns.items() if _constant(v)}
    names = {name: str(value) for name, value in columns.items() if name not in constants}
    for name, value in constants.items():
        if (name in TEXTS) != isinstance(value, str) or name == "id":
            expected = "the file's column" if name == "id" else "a name after =" if name in TEXTS else "a number"
            raise UserError(f"{path}: the column map gives {name} as {columns[name]!r}: expected {expected}")
    for file in paths.values():
        kinds = _column_kinds(file)
        _require(file, columns, kind, kinds)
        for name, column in names.items():
            if column not in kinds:
                lower = {other.lower(): other for other in kinds}
                near = difflib.get_close_matches(column.lower(), list(lower), 1)
                hint = f"; meant {lower[near[0]]!r}?" if near else ""
                raise UserError(f"{file}: column {column!r} (for {name}) is missing (found {', '.join(kinds)}){hint}")
            wanted = ("number", "text") if name == "id" else ("text",) if name in TEXTS else ("number",)
            if kinds[column] not in wanted:
                raise UserError(f"{file}: column {column!r} (for {name}) holds {kinds[column]}: expected {wanted[0]}")
    return Source(paths, names, constants, kind, rows)


def _constant(value: str | float) -> bool:
    return not isinstance(value, str) or value.startswith("=")


def _require(path: AnyPath, columns: dict[str, Any], kind: str, found: dict[str, str]) -> None:
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
    if path.is_file():
        return {path.name: path}
    if not path.is_dir():
        raise UserError(f"{path}: no such file or folder; truth.path must name a table below data")
    found = {p.relative_to(path).as_posix(): p for p in sorted(path.rglob("*.parquet"))}
    found = {key: p for key, p in found.items() if not any(part.startswith(("_", ".")) for part in key.split("/"))}
    if not found:
        raise UserError(f"{path}: holds no .parquet file")
    return found


def _is_parquet(path: AnyPath) -> bool:
    with open(local_copy(path), "rb") as file:
        start = file.read(9)
    if start[:4] == b"PAR1":
        return True
    if start == b"SIMPLE  =":
        return False
    hint = ": unpack it" if start[:2] == b"\x1f\x8b" else ""
    raise UserError(f"{path}: neither a Parquet nor a FITS file (begins with {start[:4]!r}){hint}")


def _count(path: AnyPath) -> int:
    if _is_parquet(path):
        return parquet.count(path)
    with fits.open(local_copy(path), memmap=True) as hdus:
        return int(_table(path, hdus).header["NAXIS2"])


def _table(path: AnyPath, hdus: fits.HDUList) -> fits.BinTableHDU:
    for hdu in hdus:
        if isinstance(hdu, fits.BinTableHDU):
            return hdu
    raise UserError(f"{path}: holds no binary table")


def _column_kinds(path: AnyPath) -> dict[str, str]:
    """Return by column number, text or other; UserError where the file is not complete."""
    if _is_parquet(path):
        return {field.name: _arrow_kind(field.type) for field in parquet.schema(path)}
    try:
        with warnings.catch_warnings():
            # astropy warns of a file cut short; it is told below
            warnings.simplefilter("ignore")
            with fits.open(local_copy(path), memmap=True) as hdus:
                hdu = _table(path, hdus)
                end = hdu.fileinfo()["datLoc"] + hdu.header["NAXIS1"] * hdu.header["NAXIS2"]
                formats = [(column.name, column.format) for column in hdu.columns]
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(f"{path}: not a complete FITS file ({error}): copy it again") from None
    if path.stat().st_size < end:
        raise UserError(f"{path}: not a complete FITS file ({path.stat().st_size} bytes of {end}): copy it again")
    kinds = {}
    for name, code in formats:
        letter = code.lstrip("0123456789")[:1]
        count = code[: len(code) - len(code.lstrip("0123456789"))] or "1"
        kinds[name] = "text" if letter == "A" else "number" if letter in "LBIJKED" and count == "1" else "other"
    return kinds


def _arrow_kind(kind: pa.DataType) -> str:
    if pa.types.is_dictionary(kind):
        kind = kind.value_type
    if pa.types.is_integer(kind) or pa.types.is_floating(kind) or pa.types.is_decimal(kind):
        return "number"
    if pa.types.is_string(kind) or pa.types.is_large_string(kind) or pa.types.is_string_view(kind):
        return "text"
    return "other"


def _read_parquet(batch: Batch, columns: list[str], texts: set[str]) -> dict[str, np.ndarray]:
    table = parquet.read(batch.path, columns, batch.start, batch.stop)
    return {n: parquet.texts(table[n]) if n in texts else _native(table[n]) for n in columns}


def _native(column: pa.ChunkedArray) -> np.ndarray:
    if pa.types.is_integer(column.type):
        # an integer with nulls would lose digits as a float
        return column.to_numpy() if not column.null_count else column.to_pandas(integer_object_nulls=True).to_numpy()
    kind = _arrow_kind(column.type)
    return parquet.numbers(column) if kind == "number" else parquet.texts(column)


def _read_fits(batch: Batch, columns: list[str], texts: set[str]) -> dict[str, np.ndarray]:
    with fits.open(local_copy(batch.path), memmap=True) as hdus:
        rows = _table(batch.path, hdus).data[batch.start : batch.stop]
        return {name: _plain(rows[name]) for name in columns}


def _plain(values: np.ndarray) -> np.ndarray:
    """Return a copy in the machine's byte order; texts stripped."""
    if values.dtype.kind in "SU":
        return np.array([text.strip() for text in values.astype(str).tolist()], object)
    return np.array(values.astype(values.dtype.newbyteorder("=")))


def _repeated(batch: Batch, column: str) -> np.ndarray:
    if _is_parquet(batch.path):
        return parquet.repeated(batch, column, PATTERN)
    rows = _repeated_in_fits(batch.path, file_state(batch.path)[1], column)
    return np.isin(np.arange(batch.start, batch.stop), rows)


@lru_cache(maxsize=4)
def _repeated_in_fits(path: AnyPath, stamp: int, column: str) -> np.ndarray:
    with fits.open(local_copy(path), memmap=True) as hdus:
        data = _table(path, hdus).data
        parts = [data[start : start + MAX_ROWS][column] for start in range(0, len(data), MAX_ROWS)]
        return repeats(np.concatenate([identifiers(_plain(part), PATTERN) for part in parts] or [np.empty(0, int)]))
