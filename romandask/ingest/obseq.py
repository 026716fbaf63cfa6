"""Roman observing sequences: FITS files with a table of visits (date, exptime, ra, dec, pa, filter).

`romandask.export.obseq` writes them.
"""

from __future__ import annotations

import warnings
from collections.abc import Collection
from dataclasses import dataclass

import astropy.units as u
import numpy as np
import pandas as pd
from astropy.io import fits
from astropy.table import Table
from astropy.utils.exceptions import AstropyWarning

from romandask.ingest.units import factor_to
from romandask.ingest.visits import bands_of, check_all_bands, check_ranges, modified_julian, numbers_of
from romandask.model.errors import UserError
from romandask.model.filters import ROMAN
from romandask.storage.paths import AnyPath, local_copy

COLUMNS = ("date", "exptime", "ra", "dec", "pa", "filter")
"""Columns of the table, in upper or lower case; the row index is the visit.

`date` is in MJD or JD and `exptime` in s; `ra`, `dec` and `pa` (degrees) refer to the centre of the focal plane. A unit
of the file (TUNIT) is converted to these.
"""
UNITS = {"date": u.day, "exptime": u.second, "ra": u.degree, "dec": u.degree, "pa": u.degree}
"""Unit of each column of numbers."""
SPELLINGS = {"mjd": "d", "jd": "d", "days": "d", "seconds": "s", "secs": "s", "sec": "s"}
SPELLINGS |= {"degrees": "deg", "degs": "deg", "radians": "rad", "rads": "rad", "hours": "h", "hourangles": "hourangle"}
"""Units that astropy does not know by these names."""


@dataclass(frozen=True, kw_only=True)
class _Visits:
    """The table of visits as the file has it."""

    table: Table
    """All rows, missing values masked."""
    columns: dict[str, str]
    """Name in the file of each of `COLUMNS`."""
    units: dict[str, str]
    """Text of the unit (TUNIT) of each of `COLUMNS` that has one."""


def read(path: AnyPath, bands: Collection[str] | None = None) -> pd.DataFrame:
    """Return all visits.

    Parameters
    ----------
    path : path
        FITS file. The table may be in any HDU; it is found by its columns.
    bands : collection of str, optional
        Bands whose visits are needed; all of Roman's if not given. The values of visits in other filters are returned
        as they are: they may be missing or wrong.

    Returns
    -------
    DataFrame
        Columns visit, band, mjd, exptime (s), ra, dec and pa (degrees); seeing, airmass and sky_brightness are NaN.

    Raises
    ------
    UserError
        If the file is missing, truncated or not FITS, lacks a column, has no rows, an unknown filter or a unit that
        cannot be converted, or if a value in one of the bands is missing, not a finite number or out of range.
    """
    if not path.is_file():
        raise UserError(f"{path}: no such file; roman.pointings.path must name an observing sequence (FITS)")
    found, where = _visits_of(path), f"{path}: "
    values = {name: _series(found.table[column], path, column) for name, column in found.columns.items()}
    wanted = tuple(ROMAN.synonyms if bands is None else bands)
    band = bands_of(values["filter"], ROMAN, wanted, where, found.columns["filter"])
    used = band.isin(wanted)
    numbers = {}
    for name, unit in UNITS.items():
        column = found.columns[name]
        factor = _factor(found.units.get(name, ""), unit, path, column)
        checked = numbers_of(values[name][used], where, column).astype(float)
        if name == "date":
            checked = modified_julian(checked * factor, where, column)
        else:
            checked = checked * factor
        others = pd.to_numeric(values[name][~used], errors="coerce").astype(float) * factor
        numbers[name] = pd.concat([checked, others]).sort_index()
    visits = pd.DataFrame(
        {
            "visit": np.arange(len(band)),
            "band": band.astype(str),
            "mjd": numbers["date"],
            "exptime": numbers["exptime"],
            "ra": numbers["ra"],
            "dec": numbers["dec"],
            "pa": numbers["pa"],
            "seeing": np.nan,
            "airmass": np.nan,
            "sky_brightness": np.nan,
        }
    )
    check_ranges(visits[used], path, {"mjd": found.columns["date"]} | found.columns)
    check_all_bands(values["filter"], band, bands or (), where, found.columns["filter"])
    return visits.assign(ra=visits["ra"] % 360)


def _visits_of(path: AnyPath) -> _Visits:
    """Return the table that has all columns, and rows if any such table has rows."""
    candidates: dict[int, _Visits] = {}
    lacking: dict[int, list[str]] = {}
    try:
        with warnings.catch_warnings():
            # astropy only warns of a truncated table, and fails later with an unrelated error
            warnings.simplefilter("ignore", AstropyWarning)
            warnings.filterwarnings("error", ".*truncated", AstropyWarning)
            with fits.open(local_copy(path), memmap=False) as hdus:
                for number, hdu in enumerate(hdus):
                    if not isinstance(hdu, fits.BinTableHDU | fits.TableHDU):
                        continue
                    own = {name.strip().lower(): name for name in reversed(hdu.columns.names)}
                    columns = {
                        name: name if name in hdu.columns.names else own[name] for name in COLUMNS if name in own
                    }
                    if len(columns) < len(COLUMNS):
                        lacking[number] = list(own)
                        continue
                    units = {name: str(hdu.columns[column].unit or "") for name, column in columns.items()}
                    table = Table.read(hdu, mask_invalid=False)
                    if len(table) != hdu.header["NAXIS2"]:
                        raise OSError(f"{len(table)} of {hdu.header['NAXIS2']} rows")
                    candidates[number] = _Visits(table=table, columns=columns, units=units)
                if not candidates and not lacking and len(hdus) < 2:
                    raise OSError("no second HDU")
    except (OSError, AstropyWarning, ValueError, TypeError, IndexError, AttributeError, KeyError):
        size = path.stat().st_size
        raise UserError(
            f"{path}: not a complete FITS table ({size} bytes; truncated or not FITS): copy the file again"
        ) from None
    if not candidates:
        if not lacking:
            raise UserError(f"{path}: no HDU holds a table; an observing sequence has columns {', '.join(COLUMNS)}")
        number, names = max(lacking.items(), key=lambda item: len(set(COLUMNS) & set(item[1])))
        missing = next(name for name in COLUMNS if name not in names)
        raise UserError(f"{path}: column {missing!r} is missing (found {', '.join(sorted(names))} in HDU {number})")
    filled = {number: visits for number, visits in candidates.items() if len(visits.table)}
    if not filled:
        raise UserError(f"{path}: the table in HDU {next(iter(candidates))} has no rows: there are no visits to read")
    if len(filled) > 1:
        raise UserError(f"{path}: HDUs {', '.join(map(str, filled))} each hold a table of visits: keep one of them")
    return next(iter(filled.values()))


def _series(column: Table.Column, path: AnyPath, name: str) -> pd.Series:
    """Return a column with one value in each row; a masked value is missing, and NaN is a value."""
    values, mask = np.asarray(column), np.ma.getmaskarray(column)
    if values.ndim > 1:
        shape = " x ".join(map(str, values.shape[1:]))
        if values[0].size != 1:
            raise UserError(f"{path}: column {name!r} has {shape} values in each row, expected one")
        values, mask = values.reshape(len(values)), mask.reshape(len(mask))
    if values.dtype.kind not in "fiuSU":
        raise UserError(f"{path}: column {name!r} holds {values[0]!r} (type {values.dtype}), expected numbers or text")
    if values.dtype.kind in "SU":
        values = np.array([text.strip() for text in values.astype(str).tolist()], object)
    else:
        values = values.astype(values.dtype.newbyteorder("="))
    return pd.Series(values.astype(object) if mask.any() else values).mask(pd.Series(mask))


def _factor(text: str, unit: u.UnitBase, path: AnyPath, column: str) -> float:
    """Return the factor from the unit of a column of the file to ours."""
    text = text.strip()
    factor = factor_to((unit,), text, SPELLINGS) if text else 1.0
    if factor is None:
        raise UserError(
            f"{path}: column {column!r} is in {text!r} (TUNIT), which is not a unit of it: convert it to {unit}"
        )
    return factor
