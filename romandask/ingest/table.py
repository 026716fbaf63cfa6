"""Tables of galaxies or of stars in Parquet (a file or a folder) or FITS, with a map of their columns."""

from __future__ import annotations

import difflib
from dataclasses import dataclass
from typing import Any

import numpy as np
import pandas as pd

from romandask.ingest import parquet
from romandask.ingest.fits_table import FitsTable, open_table
from romandask.ingest.hats_folder import parquet_files
from romandask.ingest.rows import (
    COMPONENTS,
    FLOAT_COLUMNS,
    FLUX_COLUMNS,
    MAX_ROWS,
    TEXT_COLUMNS,
    Batch,
    file_states,
    normal_form,
    with_reasons,
)
from romandask.ingest.units import factors
from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath, local_copy

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
    fits: FitsTable | None
    """The table, if the file is FITS."""
    factors: dict[str, dict[str, float]]
    """Factors that convert columns to the units of the normal form, by file and column of the normal form."""
    edges: tuple[float, ...] = ()
    """Always empty: such tables have no top-hat spectra."""
    components: bool = False
    """Always False: a row is a galaxy or a star."""

    def batches(self) -> tuple[Batch, ...]:
        """Return the batches of all files."""
        return tuple(
            Batch(path, start, min(start + self.rows, total), key)
            for key, path in self.paths.items()
            for total in [self._row_count(path)]
            for start in range(0, total, self.rows)
        )

    def _row_count(self, path: AnyPath) -> int:
        return self.fits.rows if self.fits else parquet.count(path)

    def count(self) -> int:
        """Return the number of rows of all files, from their headers."""
        return sum(self._row_count(path) for path in self.paths.values())

    def state(self) -> Any:
        """Return the sizes and modification times of the files, and the column map."""
        return {"files": file_states(self.paths), "columns": self.columns, "constants": self.constants}

    def read(self, batch: Batch) -> pd.DataFrame:
        """Return all rows of a batch in the normal form."""
        out: dict[str, Any] = {**DEFAULTS[self.kind], **self.constants}
        names = {name: column for name, column in self.columns.items() if name != "id"}
        texts = tuple(name for name in names if name in TEXT_COLUMNS)
        if self.fits:
            out |= self.fits.read(names, texts, batch.start, batch.stop)
            ids = self.fits.identifiers(self.columns["id"], batch.start, batch.stop)
        else:
            table = parquet.read(batch.path, sorted(set(self.columns.values())), batch.start, batch.stop)
            for name, column in names.items():
                out[name] = parquet.texts(table[column]) if name in texts else parquet.numbers(table[column])
            ids = parquet.identifiers_of(table[self.columns["id"]])
        for name, factor in self.factors[batch.source].items():
            out[name] = out[name] * factor
        out |= {"id": ids.values, "reason": ids.reason}
        if self.kind == "galaxy":
            for size in ("bulge", "disk"):
                out.setdefault(f"size_{size}_true", 0.0)
                out.setdefault(f"size_minor_{size}_true", out[f"size_{size}_true"])
            out.setdefault("knots_sed", out.get("disk_sed", ""))
        frame = normal_form(batch.source, np.arange(batch.start, batch.stop), self.kind, out)
        return with_reasons(frame)


def open_source(path: AnyPath, columns: dict[str, str | float], kind: str, rows: int = MAX_ROWS) -> Source:
    """Open a table and check its files and its column map.

    Parameters
    ----------
    path : path
        A Parquet or FITS file, or a folder of Parquet files (see `romandask.ingest.hats_folder.parquet_files`). Of a
        FITS file, the table that has the columns of the map is read, or LDAC_OBJECTS.
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
    table = None if path.is_dir() or _is_parquet(path) else open_table(path, set(names.values()))
    conversions = {}
    for key, file in paths.items():
        _check_columns(file, columns, names, kind, table.kinds if table else parquet.kinds(file))
        conversions[key] = factors(file, names, table.units if table else parquet.units(file))
        if table:
            table.check_identifiers(names["id"])
        else:
            parquet.check_identifiers(file, names["id"])
    return Source(
        paths=paths, columns=names, constants=constants, kind=kind, rows=rows, fits=table, factors=conversions
    )


def _check_columns(
    path: AnyPath, columns: dict[str, Any], names: dict[str, str], kind: str, found: dict[str, str]
) -> None:
    """Raise a UserError if a file lacks a column of the map, or if a column holds something else than it should.

    Parameters
    ----------
    path : path
        The file.
    columns : dict
        The column map.
    names : dict
        The columns of the file that are mapped, by column of the normal form.
    kind : str
        galaxy or star.
    found : dict
        What each column of the file holds: number, text, or a description of something else.
    """
    _require(path, columns, kind, found)
    for name, column in names.items():
        if column not in found:
            lower = {other.lower(): other for other in found}
            near = difflib.get_close_matches(column.lower(), list(lower), 1)
            hint = f"; meant {lower[near[0]]!r}?" if near else ""
            raise UserError(f"{path}: column {column!r} (for {name}) is missing (found {', '.join(found)}){hint}")
        wanted = ("number", "text") if name == "id" else ("text",) if name in TEXT_COLUMNS else ("number",)
        if found[column] not in wanted:
            raise UserError(f"{path}: column {column!r} (for {name}) holds {found[column]}: expected {wanted[0]}")


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
    return parquet_files(path)


def _is_parquet(path: AnyPath) -> bool:
    with open(local_copy(path), "rb") as file:
        start = file.read(9)
    if start[:4] == b"PAR1":
        return True
    if start == b"SIMPLE  =":
        return False
    remedy = ": unpack it" if start[:2] == b"\x1f\x8b" else ""
    raise UserError(f"{path}: neither a Parquet nor a FITS file (begins with {start[:4]!r}){remedy}")
