"""Dithered places of Rubin's visits: further columns of an OpSim database, in families such as descDitheredRA.

A family is what the names of its columns have in common: descDithered for descDitheredRA, descDitheredDec and, if it is
there, descDitheredRotTelPos.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping

import numpy as np
import pandas as pd

from romandask.instruments.rubin.site_sky import parallactic_angle
from romandask.model.sky import unit_vectors

UNDITHERED = "field"
"""Family of the columns fieldRA and fieldDec, the places that the scheduler chose."""
NEAR = 10.0
"""Largest distance of a dithered place from that of the scheduler, degrees."""
SAME = 1e-4
"""Distance within which two places are the same, degrees."""
_PARTS = {
    "rotator": re.compile(r"_?[Rr]ot(?:ation)?TelPos_?|_?rottelpos_?"),
    "pa": re.compile(r"_?[Rr]otSkyPos_?|_?rotskypos_?"),
    "ra": re.compile(r"_?(?:RA|Ra)(?![a-z])_?|_ra(?![A-Za-z])|(?<![A-Za-z])ra_"),
    "dec": re.compile(r"_?(?:DEC|Dec)(?![a-z])_?|_dec(?![A-Za-z])|(?<![A-Za-z])dec_"),
}
"""What is left out of the name of a column to have that of its family, by our column; `rotator` is an angle too."""


def families(columns: Iterable[str]) -> dict[str, dict[str, str]]:
    """Return the families of dithered places among the columns of a table.

    Parameters
    ----------
    columns : iterable of str
        Names of columns.

    Returns
    -------
    dict
        For each family, the name of its column by ra, dec and, if there are such columns, rotator and pa.
    """
    found: dict[str, dict[str, str]] = {}
    for column in columns:
        if "dither" not in column.lower():
            continue
        for part, pattern in _PARTS.items():
            if pattern.search(column):
                found.setdefault(pattern.sub("", column, count=1), {}).setdefault(part, column)
                break
    return {name: parts for name, parts in found.items() if {"ra", "dec"} <= set(parts)}


def places(visits: pd.DataFrame, family: Mapping[str, pd.Series]) -> pd.DataFrame | None:
    """Return the visits at the places of a family, or None if these are not within `NEAR` of the visits' places.

    Some families are in radians where all other columns are in degrees. The unit is the one in which the places are
    nearer to those of the scheduler. A rotator angle becomes the position angle of the camera with the parallactic
    angle of the dithered place.

    Parameters
    ----------
    visits : DataFrame
        Columns mjd, ra, dec and pa (degrees).
    family : mapping
        Numbers of the family's columns, by ra, dec, rotator and pa.
    """
    distances = {}
    for factor in (1.0, 180 / np.pi):
        ra, dec = family["ra"].to_numpy(float) * factor, family["dec"].to_numpy(float) * factor
        if np.isfinite(ra).all() and (np.abs(dec) <= 90).all():
            apart = np.linalg.norm(unit_vectors(ra, dec) - unit_vectors(visits["ra"], visits["dec"]), axis=-1)
            distances[factor] = float(np.degrees(2 * np.arcsin(np.clip(apart / 2, 0, 1))).max(initial=0))
    if not distances or min(distances.values()) > NEAR:
        return None
    factor = min(distances, key=lambda known: distances[known])
    angles = {name: values.astype(float) * factor for name, values in family.items()}
    moved = visits.assign(ra=angles["ra"] % 360, dec=angles["dec"])
    if "pa" in angles:
        return moved.assign(pa=angles["pa"] % 360)
    if "rotator" in angles:
        zenith = parallactic_angle(moved["ra"], moved["dec"], moved["mjd"])
        return moved.assign(pa=(angles["rotator"] - zenith) % 360)
    return moved


def differ(visits: pd.DataFrame, moved: pd.DataFrame) -> bool:
    """Return whether two tables of the same visits have other places or position angles."""
    apart = np.linalg.norm(unit_vectors(visits["ra"], visits["dec"]) - unit_vectors(moved["ra"], moved["dec"]), axis=-1)
    turned = np.abs((visits["pa"] - moved["pa"] + 180) % 360 - 180)
    return bool((apart > np.radians(SAME)).any() or (turned > 1).any())
