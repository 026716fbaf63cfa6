"""What all formats of tables of visits share: names of filters, numbers, dates, and the checks of values.

The index of a Series is the row of the file, which messages name. They begin with `where`: the file and, if it has
several, the table, for example "visits.db: table observations, ".
"""

from __future__ import annotations

from collections.abc import Collection

import numpy as np
import pandas as pd

from romandask.model.errors import UserError
from romandask.model.filters import FilterNames
from romandask.storage.paths import AnyPath

RANGES = {
    "mjd": (40_000.0, 100_000.0),
    "ra": (-360.0, 720.0),
    "dec": (-90.0, 90.0),
    "exptime": (1e-3, 1e6),
    "seeing": (0.05, 20.0),
    "airmass": (1.0, 40.0),
}
"""Valid range of each column, degrees, s, arcsec or MJD (years 1968 to 2132).

A value outside is in other units or does not describe a visit.
"""
JULIAN = 2_400_000.5
"""Julian date of MJD 0."""


def bands_of(texts: pd.Series, names: FilterNames, bands: Collection[str], where: str, column: str) -> pd.Series:
    """Return the band of each row; elements that are not bands keep their name.

    Parameters
    ----------
    texts : Series of str
        Names of filters in the file.
    names : FilterNames
        Names of the telescope's filters.
    bands : collection of str
        Bands of the survey, which need not be in `names`.
    where : str
        File and table, the first words of the message of an error.
    column : str
        Column of the file.

    Raises
    ------
    UserError
        If a name is missing or not known.
    """
    if texts.isna().any():
        raise UserError(missing_values(texts, where, column))
    texts = texts.astype(str).str.strip()
    empty = texts.index[texts == ""]
    if len(empty):
        raise UserError(f"{where}column {column!r}, row {empty[0]}: the name of the filter is empty: give it one")
    found = {name: names.find(name, bands) or (name if names.is_other(name) else None) for name in texts.unique()}
    unknown = [name for name, band in found.items() if band is None]
    if unknown:
        raise UserError(
            f"{where}column {column!r} has {', '.join(map(repr, unknown))} in {int(texts.isin(unknown).sum())} of "
            f"{len(texts)} rows, the first in row {texts.index[texts.isin(unknown)][0]}: not the name of a filter; "
            f"known: {names.known(bands)}"
        )
    return texts.map(found)


def check_all_bands(texts: pd.Series, rows: pd.Series, bands: Collection[str], where: str, column: str) -> None:
    """Check that every band has visits.

    Parameters
    ----------
    texts : Series of str
        Names of filters in the file.
    rows : Series of str
        Band of each row.
    bands : collection of str
        Bands of the survey.
    where : str
        File and table, the first words of the message of an error.
    column : str
        Column of the file.

    Raises
    ------
    UserError
        If a band has no rows; names the filters that have some.
    """
    present = set(rows.unique())
    absent = [band for band in bands if band not in present]
    if absent:
        counts = ", ".join(f"{name} ({count} rows)" for name, count in texts.value_counts().items())
        raise UserError(
            f"{where}column {column!r} has no rows of {', '.join(absent)}, but of {counts}: "
            "leave these bands out of the survey, or add their visits"
        )


def numbers_of(values: pd.Series, where: str, column: str) -> pd.Series:
    """Return finite numbers; a text that is a number becomes one.

    Parameters
    ----------
    values : Series
        Values of rows that are used.
    where : str
        File and table, the first words of the message of an error.
    column : str
        Column of the file.

    Raises
    ------
    UserError
        If a value is missing, not a number, or not finite.
    """
    if values.dtype.kind != "f" and values.isna().any():
        raise UserError(missing_values(values, where, column))
    if values.dtype.kind not in "fiuOTU" and not pd.api.types.is_string_dtype(values):
        raise UserError(f"{where}column {column!r} holds values of type {values.dtype}, expected numbers")
    numbers = pd.to_numeric(values, errors="coerce")
    wrong = values[numbers.isna() & values.notna()]
    if len(wrong):
        raise UserError(
            f"{where}column {column!r}, row {wrong.index[0]}: found {_plain(wrong.iloc[0])!r}, expected a number "
            f"(so in {len(wrong)} of {len(values)} rows): write numbers"
        )
    wrong = numbers[~np.isfinite(numbers.to_numpy(float))]
    if len(wrong):
        raise UserError(
            f"{where}column {column!r}, row {wrong.index[0]}: found {wrong.iloc[0]}, expected a finite number"
        )
    return numbers


def missing_values(values: pd.Series, where: str, column: str) -> str:
    """Return the message for a column with missing values."""
    rows = values.index[values.isna()]
    return (
        f"{where}column {column!r} has {len(rows)} missing values in {len(values)} rows, the first in row {rows[0]}: "
        "remove these rows or fill them in"
    )


def modified_julian(dates: pd.Series, where: str, column: str) -> pd.Series:
    """Return dates as MJD; all of them may be Julian dates.

    Raises
    ------
    UserError
        If only some are Julian dates.
    """
    julian = dates > JULIAN
    if not julian.any():
        return dates
    if not julian.all():
        raise UserError(
            f"{where}column {column!r} mixes Julian dates ({dates[julian].iloc[0]:.3f} in row "
            f"{dates.index[julian][0]}) and others ({dates[~julian].iloc[0]:.3f} in row {dates.index[~julian][0]}): "
            "convert all to MJD"
        )
    return dates - JULIAN


def check_ranges(visits: pd.DataFrame, path: AnyPath, names: dict[str, str]) -> None:
    """Check that the columns of a table of visits are within their valid ranges.

    Parameters
    ----------
    visits : DataFrame
        Visits; columns of `RANGES` that are missing, and missing values, are not checked.
    path : path
        File that the visits were read from, for the error message.
    names : dict
        Column of the file, by our column; a column that is not in it has the same name in the file.

    Raises
    ------
    UserError
        If a value is out of range; names the file, its column and the first such value.
    """
    for name, (low, high) in RANGES.items():
        if name not in visits:
            continue
        wrong = visits[name][~visits[name].between(low, high) & visits[name].notna()]
        if len(wrong):
            raise UserError(
                f"{path}: column {names.get(name, name)!r} has {wrong.iloc[0]:g} in row {wrong.index[0]}, "
                f"one of {len(wrong)} values not within {low:g} to {high:g}: remove these rows, or convert them"
            )


def _plain(value: object) -> object:
    """Return a value of NumPy as Python's, which prints as in a file."""
    return value.item() if isinstance(value, np.generic) else value
