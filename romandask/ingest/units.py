"""Units of the columns of files: those that a file gives are converted to romandask's, or refused."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence

import astropy.units as u
from astropy.units.function import FunctionUnitBase

from romandask.ingest.rows import FLOAT_COLUMNS, FLUX_COLUMNS
from romandask.model.errors import UserError
from romandask.storage.paths import AnyPath

_SPELLINGS = {"degrees": "deg", "radians": "rad", "radian": "rad", "arcseconds": "arcsec", "asec": "arcsec"}
"""Units by the spellings, in small letters, that astropy does not know."""
_NONE = ("", "-", "1", "none", "unitless", "dimensionless", "n/a")
"""Texts, in small letters, that mean "no unit"."""


def unit_of(name: str) -> u.UnitBase:
    """Return the unit of a column of the normal form."""
    if name in ("ra", "dec", "position_angle_unlensed"):
        return u.deg
    if name.startswith("size_"):
        return u.arcsec
    if name.endswith(("magnorm", "_av")) or name == "ref_mag":
        return u.mag
    if name in FLUX_COLUMNS:
        return u.s**-1 * u.cm**-2
    return u.dimensionless_unscaled


def factors(path: AnyPath, columns: dict[str, str], units: dict[str, str]) -> dict[str, float]:
    """Return the factors that convert columns to the units of the normal form, where they are not 1.

    Parameters
    ----------
    path : path
        File, for messages.
    columns : dict
        Column of the file, by column of the normal form.
    units : dict
        Unit that the file gives, by column of the file. A column without one has romandask's unit.

    Raises
    ------
    UserError
        If a unit is not known or is one of another quantity.
    """
    out = {}
    for name in (*FLOAT_COLUMNS, *FLUX_COLUMNS):
        text = units.get(columns.get(name, ""), "").strip()
        if text.lower() in _NONE:
            continue
        unit = unit_of(name)
        factor = factor_to((unit, unit * u.ph), text, _SPELLINGS)
        if factor is None:
            wanted = unit.to_string() or "no unit"
            raise UserError(
                f"{path}: column {columns[name]!r} (for {name}) has the unit {text!r}, expected {wanted} or a unit "
                "that astropy converts to it: convert the column, or correct its unit"
            )
        if factor != 1:
            out[name] = factor
    return out


def factor_to(wanted: Sequence[u.UnitBase], text: str, spellings: Mapping[str, str]) -> float | None:
    """Return the factor from the unit of a file to the first of some units that it is equivalent to.

    Parameters
    ----------
    wanted : sequence of Unit
        Units to convert to.
    text : str
        Unit as the file has it.
    spellings : mapping
        Units by the spellings, in small letters, that astropy does not know.

    Returns
    -------
    float or None
        The factor; None if there is none.
    """
    # astropy does not know 1/s/cm2, but 1/(s cm2)
    inverse = f"1/({text[2:].replace('/', ' ')})" if text.startswith("1/") else ""
    for spelling in (text, text.lower(), inverse, spellings.get(text.lower(), "")):
        try:
            with warnings.catch_warnings():
                # a unit with two slashes, for example
                warnings.simplefilter("ignore")
                unit = u.Unit(spelling)
        except (ValueError, TypeError):
            continue
        if isinstance(unit, FunctionUnitBase):
            return 1.0 if u.mag in wanted and unit == u.ABmag else None
        for other in wanted:
            if spelling and unit.is_equivalent(other):
                return float(unit.to(other))
    return None
