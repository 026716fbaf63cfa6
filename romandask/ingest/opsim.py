"""OpSim databases (SQLite) of Rubin's survey simulators, of all generations."""

from __future__ import annotations

import sqlite3
from contextlib import closing

import numpy as np
import pandas as pd

from romandask.ingest.visits import check_ranges
from romandask.model.errors import UserError
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
"""Names in OpSim databases, newest first, of each of our columns.

`seeing` is the FWHM of the atmosphere at 500 nm and zenith, arcsec. OpSim 3 has it in rawSeeing; its FWHMeff and
finSeeing are for the band and airmass of the visit. If a database has both `band` and `filter`, the former is a letter
and the latter a physical filter (r_57).
"""
ANGLES = ("ra", "dec", "pa")
"""Columns that OpSim 3 stores in radians."""


def read(path: AnyPath) -> pd.DataFrame:
    """Return all visits, sorted by time.

    Parameters
    ----------
    path : path
        SQLite database.

    Returns
    -------
    DataFrame
        The columns of `COLUMNS`; angles in degrees, exposure times in s, seeing in arcsec.

    Raises
    ------
    UserError
        If the file is missing or not an OpSim database, lacks a column, has missing values or values out of range, or
        if a visit number is not unique.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file; rubin.pointings.path must name an OpSim database (SQLite)")
    try:
        with closing(sqlite3.connect(f"{local_copy(path).resolve().as_uri()}?mode=ro", uri=True)) as connection:
            table, names = _table_and_columns(connection, path)
            columns = ", ".join(f'"{name}"' for name in names.values())
            visits = pd.read_sql_query(f'SELECT {columns} FROM "{table}"', connection)
    except (sqlite3.DatabaseError, pd.errors.DatabaseError):
        raise UserError(f"{path}: not a readable SQLite database: copy the file again") from None
    visits.columns = pd.Index(names)
    for ours, theirs in names.items():
        if ours != "band":
            visits[ours] = pd.to_numeric(visits[ours], errors="coerce")
        missing = int(visits[ours].isna().sum())
        if missing:
            raise UserError(
                f"{path}: table {table}, column {theirs!r} has {missing} missing values in {len(visits)} rows: "
                "remove these rows or simulate again"
            )
    if table == "Summary" and (visits[list(ANGLES)].abs().max() <= 2 * np.pi).all():
        # OpSim 3 writes radians, but some copies were converted to degrees; the range of the angles shows which
        visits[list(ANGLES)] = np.degrees(visits[list(ANGLES)])
    check_ranges(visits, path, names)
    visits["band"] = visits["band"].astype(str).str.split("_").str[0]
    # a visit that belongs to several proposals has one row for each
    visits = visits.drop_duplicates(ignore_index=True)
    repeated = visits["visit"][visits["visit"].duplicated()]
    if len(repeated):
        raise UserError(
            f"{path}: table {table}, column {names['visit']!r}: {repeated.nunique()} numbers name several visits each, "
            f"the first {repeated.iloc[0]}: number the visits uniquely"
        )
    return visits.sort_values(["mjd", "visit"], ignore_index=True)


def _table_and_columns(connection: sqlite3.Connection, path: AnyPath) -> tuple[str, dict[str, str]]:
    """Return the name of the table of visits, and the name of its column for each of our columns."""
    existing = [row[0] for row in connection.execute("SELECT name FROM sqlite_master WHERE type IN ('table', 'view')")]
    tables = [name for name in TABLES if name.lower() in {other.lower() for other in existing}]
    if not tables:
        raise UserError(
            f"{path}: holds no table {TABLES[0]!r}, {TABLES[1]!r} or {TABLES[2]!r} "
            f"(found {', '.join(existing) or 'none'}): not an OpSim database"
        )
    columns = [row[1] for row in connection.execute(f"PRAGMA table_info({tables[0]})")]
    names = {}
    for ours, choices in COLUMNS.items():
        known = [name for name in choices if name in columns]
        if not known:
            wanted = " or ".join(map(repr, choices))
            raise UserError(f"{path}: table {tables[0]} lacks column {wanted} (found {', '.join(columns)})")
        names[ours] = known[0]
    return tables[0], names
