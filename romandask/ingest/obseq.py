"""Roman observing sequences: FITS files with a table of visits (date, exptime, ra, dec, pa, filter) in HDU 1.

`romandask.export.obseq` writes them.
"""

from __future__ import annotations

import warnings

import numpy as np
import pandas as pd
from astropy.io import fits
from astropy.utils.exceptions import AstropyWarning

from romandask.ingest.visits import check_ranges
from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath, local_copy

COLUMNS = ("date", "exptime", "ra", "dec", "pa", "filter")
"""Columns of the table; the row index is the visit.

`date` is in MJD and `exptime` in s; `ra`, `dec` and `pa` (degrees) refer to the centre of the focal plane.
"""


def read(path: AnyPath) -> pd.DataFrame:
    """Return all visits.

    Parameters
    ----------
    path : path
        FITS file.

    Returns
    -------
    DataFrame
        Columns visit, band, mjd, exptime (s), ra, dec and pa (degrees); seeing, airmass and sky_brightness are NaN.

    Raises
    ------
    UserError
        If the file is missing, truncated or not FITS, lacks a column, or has a value that is not finite or is out of
        range.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file; roman.pointings.path must name an observing sequence (FITS)")
    try:
        # astropy only warns of a truncated table, and fails later with an unrelated error
        with warnings.catch_warnings():
            warnings.simplefilter("error", AstropyWarning)
            with fits.open(local_copy(path), memmap=False) as hdus:
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
    numbers = {}
    for name in COLUMNS[:-1]:
        if data[name].dtype.kind not in "fiu":
            raise UserError(f"{path}: column {name!r} holds {data[name][0]!r}, expected numbers")
        numbers[name] = values = np.asarray(data[name], dtype=np.float64)
        if not np.isfinite(values).all():
            row = int(np.flatnonzero(~np.isfinite(values))[0])
            raise UserError(f"{path}: column {name!r}, row {row}: found {values[row]}, expected a finite number")
    visits = pd.DataFrame(
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
    check_ranges(visits, path, {})
    return visits
