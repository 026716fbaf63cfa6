"""Checks of tables of visits that apply to every input format."""

from __future__ import annotations

import pandas as pd

from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath

RANGES = {
    "ra": (-360.0, 720.0),
    "dec": (-90.0, 90.0),
    "exptime": (1e-3, 1e6),
    "seeing": (0.05, 20.0),
    "airmass": (1.0, 40.0),
}
"""Valid range of each column, degrees, s or arcsec. A value outside is in other units or does not describe a visit."""


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
