"""OpSim databases (SQLite) of Rubin's survey simulators, of all generations, and visit tables (Parquet)."""

from __future__ import annotations

import sqlite3
import warnings
from collections.abc import Collection, Mapping
from contextlib import closing
from dataclasses import dataclass

import numpy as np
import pandas as pd

from romandask.ingest import visit_tables
from romandask.ingest.dithers import UNDITHERED, differ, families, places
from romandask.ingest.visits import bands_of, check_all_bands, check_ranges, missing_values, modified_julian, numbers_of
from romandask.model.errors import UserError
from romandask.model.filters import RUBIN
from romandask.storage.paths import AnyPath, local_copy

TABLES = ("observations", "SummaryAllProps", "Summary")
"""Tables of visits, newest first: feature-based scheduler, OpSim 4 (2018-2021), OpSim 3 (minion, kraken, enigma)."""
COLUMNS = {
    "visit": ("observationId", "obsHistID"),
    "band": ("band", "filter"),
    "mjd": ("observationStartMJD", "expMJD"),
    "exptime": ("visitExposureTime", "visitExpTime"),
    "ra": ("fieldRA",),
    "dec": ("fieldDec",),
    "pa": ("rotSkyPos",),
    "seeing": ("seeingFwhm500", "rawSeeing"),
    "airmass": ("airmass",),
    "sky_brightness": ("skyBrightness", "filtSkyBrightness"),
}
"""Names in OpSim databases, newest first, of each of our columns; upper and lower case are the same.

`seeing` is the FWHM of the atmosphere at 500 nm and zenith, arcsec. OpSim 3 has it in rawSeeing; its FWHMeff and
finSeeing are for the band and airmass of the visit. If a database has both `band` and `filter`, the former is a letter
and the latter a physical filter (r_57).
"""
ANGLES = ("ra", "dec", "pa")
"""Columns that OpSim 3 stores in radians."""


@dataclass(frozen=True, kw_only=True)
class _Source:
    """The rows of a file with the columns that may be needed."""

    rows: pd.DataFrame
    names: dict[str, str]
    """Name in the file of each of our columns."""
    dithers: dict[str, dict[str, str]]
    """Families of columns with dithered places (`romandask.ingest.dithers.families`)."""
    table: str
    """Name of the table; empty in Parquet."""


def read(path: AnyPath, bands: Collection[str] | None = None, dither: str | None = None) -> pd.DataFrame:
    """Return all visits in some bands, sorted by time.

    Parameters
    ----------
    path : path
        SQLite database, or a visit table in Parquet (`romandask.ingest.visit_tables`).
    bands : collection of str, optional
        Bands whose visits are returned; all of Rubin's if not given. Other rows may have missing or wrong values.
    dither : str, optional
        Family of the columns with the places (`romandask.ingest.dithers`). If not given, the places are those of the
        scheduler, with a warning if the database has other ones.

    Returns
    -------
    DataFrame
        The columns of `COLUMNS`; angles in degrees, exposure times in s, seeing in arcsec.

    Raises
    ------
    UserError
        If the file is missing or of another format, lacks a column or family, has no rows or an unknown filter, if
        a visit in one of the bands has a value that is missing, not a number or out of range, or if a visit number is
        not unique.
    """
    if not path.is_file():
        raise UserError(
            f"{path}: no such file; rubin.pointings.path must name an OpSim database (SQLite) or visit table (Parquet)"
        )
    source = _parquet(path) if visit_tables.is_parquet(path) else _database(path)
    names, rows = source.names, source.rows
    where = f"{path}: table {source.table}, " if source.table else f"{path}: "
    if rows.empty:
        raise UserError(f"{where.rstrip(' ,:')} has no rows: there are no visits to read")
    band = bands_of(rows[names["band"]], RUBIN, bands or (), where, names["band"])
    band = band[band.isin(tuple(RUBIN.synonyms if bands is None else bands))].astype(str)
    texts, rows = rows[names["band"]], rows.loc[band.index]
    visits = pd.DataFrame(
        {ours: band if ours == "band" else _numbers(rows[theirs], where, theirs) for ours, theirs in names.items()}
    )
    visits["mjd"] = modified_julian(visits["mjd"], where, names["mjd"])
    if source.table == "Summary" and (visits[list(ANGLES)].abs().max() <= 2 * np.pi).all():
        # OpSim 3 writes radians, but some copies were converted to degrees; the range of the angles shows which
        visits[list(ANGLES)] = np.degrees(visits[list(ANGLES)])
    if not source.table:
        visits = visit_tables.completed(visits, names, where)[list(COLUMNS)]
    check_ranges(visits, path, names)
    check_all_bands(texts, band, bands or (), where, names["band"])
    visits = _at_places(visits, rows, source.dithers, dither, where)
    # a visit that belongs to several proposals has one row for each
    visits = visits.drop_duplicates(ignore_index=True)
    repeated = visits["visit"][visits["visit"].duplicated()]
    if len(repeated):
        raise UserError(
            f"{where}column {names['visit']!r}: {repeated.nunique()} numbers name several visits each, "
            f"the first {repeated.iloc[0]}: number the visits uniquely"
        )
    return visits.sort_values(["mjd", "visit"], ignore_index=True)


def _numbers(values: pd.Series, where: str, column: str) -> pd.Series:
    """Return finite numbers; NULL and NaN are missing values."""
    if values.isna().any():
        raise UserError(missing_values(values, where, column))
    return numbers_of(values, where, column)


def _at_places(
    visits: pd.DataFrame, rows: pd.DataFrame, dithers: dict[str, dict[str, str]], dither: str | None, where: str
) -> pd.DataFrame:
    """Return the visits at the places of a family of columns.

    Parameters
    ----------
    visits : DataFrame
        Visits at the scheduler's places.
    rows : DataFrame
        The rows of the visits, with the columns of the database.
    dithers : dict
        Families of the database (`romandask.ingest.dithers.families`).
    dither : str or None
        Family that is wanted; None for the scheduler's places, with a warning if there are others.
    where : str
        First words of messages.
    """
    if dither is None:
        other = []
        for name, parts in dithers.items():
            values = {part: pd.to_numeric(rows[column], errors="coerce") for part, column in parts.items()}
            moved = None if any(series.isna().any() for series in values.values()) else places(visits, values)
            if moved is not None and differ(visits, moved):
                other.append(name)
        if other:
            warnings.warn(
                f"{where}the visits are at fieldRA, fieldDec, but there are dithered places too: {', '.join(other)}; "
                f"choose with rubin.pointings.dither: {' or '.join(other)}, or {UNDITHERED} for these",
                stacklevel=2,
            )
        return visits
    if dither == UNDITHERED:
        return visits
    if dither not in dithers:
        raise UserError(
            f"{where}rubin.pointings.dither: no columns {dither}RA and {dither}Dec: "
            f"choose {' or '.join([*dithers, UNDITHERED])}"
        )
    parts = dithers[dither]
    values = {part: _numbers(rows[column], where, column) for part, column in parts.items()}
    moved = places(visits, values)
    if moved is None:
        raise UserError(
            f"{where}columns {parts['ra']!r} and {parts['dec']!r} are not near the fields' places, neither in degrees "
            f"nor in radians: choose another family in rubin.pointings.dither"
        )
    return moved


def _database(path: AnyPath) -> _Source:
    """Return the visits of a database."""
    try:
        with closing(sqlite3.connect(f"{local_copy(path).resolve().as_uri()}?mode=ro", uri=True)) as connection:
            existing = [
                row[0] for row in connection.execute("SELECT name FROM sqlite_master WHERE type IN ('table', 'view')")
            ]
            tables = [name for name in TABLES if name.lower() in {other.lower() for other in existing}]
            if not tables:
                raise UserError(
                    f"{path}: holds no table {TABLES[0]!r}, {TABLES[1]!r} or {TABLES[2]!r} "
                    f"(found {', '.join(existing) or 'none'}): not an OpSim database"
                )
            columns = [row[1] for row in connection.execute(f"PRAGMA table_info({tables[0]})")]
            names = _names(columns, COLUMNS, f"{path}: table {tables[0]}")
            dithers = families(columns)
            wanted = ", ".join(f'"{name}"' for name in _wanted(names, dithers))
            rows = pd.read_sql_query(f'SELECT {wanted} FROM "{tables[0]}"', connection)
    except (sqlite3.DatabaseError, pd.errors.DatabaseError):
        raise UserError(f"{path}: not a readable SQLite database: copy the file again") from None
    return _Source(rows=rows, names=names, dithers=dithers, table=tables[0])


def _parquet(path: AnyPath) -> _Source:
    """Return the visits of a visit table."""
    columns = visit_tables.columns_of(path)
    choices = {ours: names + visit_tables.COLUMNS[ours] for ours, names in COLUMNS.items()}
    names = _names(columns, choices, str(path), optional=("sky_brightness",))
    dithers = families(columns)
    return _Source(rows=visit_tables.rows_of(path, _wanted(names, dithers)), names=names, dithers=dithers, table="")


def _names(
    columns: list[str], choices: Mapping[str, tuple[str, ...]], table: str, optional: Collection[str] = ()
) -> dict[str, str]:
    """Return the name in a table of each of our columns.

    Parameters
    ----------
    columns : list of str
        Columns of the table.
    choices : mapping
        Possible names, the best first, by our column.
    table : str
        File and table, the first words of the message of an error.
    optional : collection of str
        Columns of ours that may be left out.
    """
    by_lower = {name.lower(): name for name in columns}
    names = {}
    for ours, possible in choices.items():
        known = [by_lower[name.lower()] for name in possible if name.lower() in by_lower]
        if known:
            names[ours] = known[0]
        elif ours not in optional:
            wanted = " or ".join(map(repr, possible))
            raise UserError(f"{table} lacks column {wanted} (found {', '.join(columns)})")
    return names


def _wanted(names: dict[str, str], dithers: dict[str, dict[str, str]]) -> list[str]:
    """Return the columns to read, each once."""
    return list(dict.fromkeys([*names.values(), *(name for parts in dithers.values() for name in parts.values())]))
