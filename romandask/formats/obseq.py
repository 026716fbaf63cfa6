"""Roman observing sequences: a FITS table of visits (date, exptime, ra, dec, pa, filter) in HDU 1."""

from __future__ import annotations

import warnings
from pathlib import Path

import numpy as np
import pandas as pd
from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning

from romandask.model.errors import UserError

COLUMNS = ("date", "exptime", "ra", "dec", "pa", "filter")
"""date is MJD; ra, dec and pa (degrees) are of the centre of the focal plane; the row index is the visit."""


def read(path: Path) -> pd.DataFrame:
    """Return all visits: visit, band, mjd, exptime, ra, dec, pa; seeing, airmass and sky_brightness are NaN.

    Raises
    ------
    UserError
        If the file is missing, truncated or not FITS, lacks a column or holds a non-finite value.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file; roman.pointings.path must name an observing sequence (FITS)")
    try:
        # a truncated table is only a warning to astropy, and then a failure far from its cause
        with warnings.catch_warnings():
            warnings.simplefilter("error", AstropyWarning)
            with fits.open(path, memmap=False) as hdus:
                table = hdus[1].data
                names = {name.lower() for name in table.names}
                data = {name: np.array(table[name]) for name in COLUMNS if name in names}
                expected = hdus[1].header["NAXIS2"]
    except (OSError, AstropyWarning, ValueError, TypeError, IndexError, AttributeError, KeyError):
        size = path.stat().st_size
        raise UserError(
            f"{path}: not a complete FITS table ({size} bytes; truncated or not FITS): copy the file again"
        ) from None
    missing = [name for name in COLUMNS if name not in data]
    if missing:
        raise UserError(f"{path}: column {missing[0]!r} is missing (found {', '.join(sorted(names))})")
    if len(data["date"]) != expected:
        raise UserError(f"{path}: holds {len(data['date'])} of {expected} rows: copy the file again")
    numbers = {name: np.asarray(data[name], dtype=np.float64) for name in COLUMNS if name != "filter"}
    for name, values in numbers.items():
        if not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values))[0])
            raise UserError(f"{path}: column {name!r}, row {row}: found {values[row]}, expected a finite number")
    return pd.DataFrame(
        {
            "visit": np.arange(expected),
            "band": [str(value).strip() for value in data["filter"]],
            "mjd": numbers["date"],
            "exptime": numbers["exptime"],
            "ra": numbers["ra"] % 360,
            "dec": numbers["dec"],
            "pa": numbers["pa"],
            "seeing": np.nan,
            "airmass": np.nan,
            "sky_brightness": np.nan,
        }
    )
