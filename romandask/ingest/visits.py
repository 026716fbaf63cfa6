"""What every table of visits must be, wherever it comes from."""

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
"""Of our columns: what is beyond them is in other units, or no visit."""


def check_ranges(visits: pd.DataFrame, path: AnyPath, names: dict[str, str]) -> None:
    """Check that every visit points at the sky for some time.

    Parameters
    ----------
    visits : columns of RANGES, those that there are; degrees, seconds, arcsec
    names : by column of ours the file's

    Raises
    ------
    UserError
        Naming the file, its column and the first value that is wrong.
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
