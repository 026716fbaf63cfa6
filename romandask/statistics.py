"""Statistics of the groups: the blend matrix, and unrecognised blends against magnitude."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import pandas as pd

from romandask.matches import length_name
from romandask.model.spectra import ab_magnitude
from romandask.runtime.products import TableProduct
from romandask.runtime.schemas import schema
from romandask.runtime.units import Unit

MAG_EDGES = np.arange(18.0, 28.01, 0.5)
"""Bins of i magnitude."""
SURVEYS = ("roman", "rubin")


@dataclass(frozen=True)
class Statistics:
    """The tables of the statistics stage."""

    blends: TableProduct
    """Counts of groups by numbers of objects of each survey."""
    unrecognised: TableProduct
    """Unrecognised blends by i magnitude."""


def statistics(
    groups: TableProduct, rubin: TableProduct, lengths: tuple[float, ...], magnitude_band: str = "i"
) -> Statistics:
    """Return the lazy statistics of the groups of Roman and Rubin objects."""
    upstream = tuple((product.stage, unit.name) for product in (groups, rubin) for unit in product.units)
    unit = (Unit("all", {"lengths": lengths, "band": magnitude_band, "edges": MAG_EDGES.tolist()}, upstream),)
    makers: dict[str, Callable[[int], pd.DataFrame]] = {
        "blends": _Blends(groups, lengths),
        "unrecognised": _Unrecognised(groups, rubin, lengths, magnitude_band),
    }
    tables = {
        name: TableProduct(f"statistics/{name}", unit, maker, schema(name), bytes_per_unit=500 << 20)
        for name, maker in makers.items()
    }
    return Statistics(**tables)


def group_counts(groups: TableProduct, length: float) -> pd.DataFrame:
    """Return the numbers of Roman and Rubin objects of every group, by its label: a sum over partitions."""
    column = f"group_{length_name(length)}"
    total = pd.DataFrame(columns=SURVEYS, dtype=np.int64)
    for index in range(len(groups.units)):
        frame = groups.load(index)
        if len(frame):
            part = pd.crosstab(frame[column], frame["survey"]).reindex(columns=SURVEYS, fill_value=0)
            total = total.add(part, fill_value=0)
    return total.astype(np.int64)


def matrix(blends: pd.DataFrame, length: float) -> pd.DataFrame:
    """Return the blend matrix: numbers of groups, Roman objects in rows and Rubin objects in columns."""
    chosen = blends[np.isclose(blends["linking_length"], length)]
    return chosen.pivot(index="n_roman", columns="n_rubin", values="groups").fillna(0).astype(int)


@dataclass(frozen=True)
class _Blends:
    groups: TableProduct
    lengths: tuple[float, ...]

    def __call__(self, index: int) -> pd.DataFrame:
        parts = []
        for length in self.lengths:
            counts = group_counts(self.groups, length).value_counts(sort=False).sort_index()
            frame = counts.rename("groups").reset_index().rename(columns={"roman": "n_roman", "rubin": "n_rubin"})
            parts.append(frame.assign(linking_length=length))
        return pd.concat(parts, ignore_index=True)


@dataclass(frozen=True)
class _Unrecognised:
    groups: TableProduct
    rubin: TableProduct
    lengths: tuple[float, ...]
    band: str

    def __call__(self, index: int) -> pd.DataFrame:
        flux = pd.concat(
            [self.rubin.load(k)[["objectId", f"{self.band}_kronFlux"]] for k in range(len(self.rubin.units))]
        )
        magnitude = pd.Series(ab_magnitude(flux[f"{self.band}_kronFlux"]), index=flux["objectId"].to_numpy())
        parts = []
        for length in self.lengths:
            counts = group_counts(self.groups, length)
            column = f"group_{length_name(length)}"
            members = pd.concat(
                [self.groups.load(k)[["survey", "objectId", column]] for k in range(len(self.groups.units))]
            )
            members = members[members["survey"] == "rubin"]
            of_group = counts.loc[members[column]]
            seen = of_group["roman"].to_numpy() >= 1
            blend = (of_group["roman"].to_numpy() >= 2) & (of_group["rubin"].to_numpy() == 1)
            mags = magnitude.loc[members["objectId"]].to_numpy()
            objects, blends = (np.histogram(mags[chosen], MAG_EDGES)[0] for chosen in (seen, blend))
            with np.errstate(invalid="ignore"):
                fraction = np.where(objects > 0, blends / np.maximum(objects, 1), np.nan)
            parts.append(
                pd.DataFrame(
                    {
                        "linking_length": length,
                        "i_mag_low": MAG_EDGES[:-1],
                        "i_mag_high": MAG_EDGES[1:],
                        "rubin_objects": objects,
                        "blends": blends,
                        "fraction": fraction,
                    }
                )
            )
        return pd.concat(parts, ignore_index=True)
