"""Rubin's OpSim databases: SQLite, table `observations`."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pandas as pd

from romandask.model.errors import UserError

COLUMNS = {
    "observationId": "visit",
    "filter": "band",
    "observationStartMJD": "mjd",
    "visitExposureTime": "exptime",
    "fieldRA": "ra",
    "fieldDec": "dec",
    "rotSkyPos": "pa",
    "seeingFwhm500": "seeing",
    "airmass": "airmass",
    "skyBrightness": "sky_brightness",
}
"""OpSim's columns and ours; angles in degrees, seeing is the atmosphere's FWHM at 500 nm and zenith, arcsec."""


def read(path: Path) -> pd.DataFrame:
    """Return all visits, by time.

    Raises
    ------
    UserError
        If the file is missing or is not an OpSim database, or lacks a column.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file; rubin.pointings.path must name an OpSim database (SQLite)")
    try:
        connection = sqlite3.connect(f"{path.resolve().as_uri()}?mode=ro", uri=True)
        try:
            found = [row[1] for row in connection.execute("PRAGMA table_info(observations)")]
            missing = [name for name in COLUMNS if name not in found]
            if found and not missing:
                visits = pd.read_sql_query(f"SELECT {', '.join(COLUMNS)} FROM observations", connection)
        finally:
            connection.close()
    except (sqlite3.DatabaseError, pd.errors.DatabaseError):
        raise UserError(f"{path}: not a readable SQLite database: copy the file again") from None
    if not found:
        raise UserError(f"{path}: holds no table 'observations': not an OpSim database")
    if missing:
        raise UserError(f"{path}: table observations lacks column {missing[0]!r} (found {', '.join(found)})")
    visits = visits.rename(columns=COLUMNS).sort_values(["mjd", "visit"], ignore_index=True)
    for name in visits.columns:
        if visits[name].isna().any():
            raise UserError(f"{path}: column {name!r} has {int(visits[name].isna().sum())} missing values")
    return visits
