"""Rubin's OpSim databases: SQLite, of every generation of the simulator."""

from __future__ import annotations

import sqlite3
from contextlib import closing

import numpy as np
import pandas as pd

from romandask.ingest.visits import check_ranges
from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath, local_copy

TABLES = ("observations", "SummaryAllProps", "Summary")
"""Newest first: the feature-based scheduler, OpSim 4 (2018-2021) and OpSim 3 (minion, kraken, enigma)."""
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
"""Our columns and OpSim's, newest first; seeing is the atmosphere's FWHM at 500 nm and zenith, arcsec.

Of two filter columns `band` is a letter and `filter` the glass (r_57). OpSim 3's FWHMeff and finSeeing are those of the
visit's band and airmass, its rawSeeing is at 500 nm and zenith.
"""
ANGLES = ("ra", "dec", "pa")


def read(path: AnyPath) -> pd.DataFrame:
    """Return all visits, by time; angles in degrees.

    Raises
    ------
    UserError
        If the file is missing or is not an OpSim database, lacks a column or has missing values.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file; rubin.pointings.path must name an OpSim database (SQLite)")
    try:
        with closing(sqlite3.connect(f"{local_copy(path).resolve().as_uri()}?mode=ro", uri=True)) as connection:
            table, names = _names(connection, path)
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
        # OpSim 3 wrote radians; some copies were converted to degrees, which a survey's range of angles betrays
        visits[list(ANGLES)] = np.degrees(visits[list(ANGLES)])
    check_ranges(visits, path, names)
    visits["band"] = visits["band"].astype(str).str.split("_").str[0]
    # a visit that serves several proposals has a row for each
    visits = visits.drop_duplicates(ignore_index=True)
    again = visits["visit"][visits["visit"].duplicated()]
    if len(again):
        raise UserError(
            f"{path}: table {table}, column {names['visit']!r}: {again.nunique()} numbers name several visits each, "
            f"the first {again.iloc[0]}: number the visits uniquely"
        )
    return visits.sort_values(["mjd", "visit"], ignore_index=True)


def _names(connection: sqlite3.Connection, path: AnyPath) -> tuple[str, dict[str, str]]:
    """Return the table of visits and the names of its columns, by ours."""
    found = [row[0] for row in connection.execute("SELECT name FROM sqlite_master WHERE type IN ('table', 'view')")]
    tables = [name for name in TABLES if name.lower() in {other.lower() for other in found}]
    if not tables:
        raise UserError(
            f"{path}: holds no table {TABLES[0]!r}, {TABLES[1]!r} or {TABLES[2]!r} "
            f"(found {', '.join(found) or 'none'}): not an OpSim database"
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
