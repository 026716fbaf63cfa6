"""Statistics of the groups: the blend matrix, unrecognised blends against magnitude, and what they do to measurements.

An unrecognised blend is a group with one object of Rubin and two or more of Roman (Troxel et al. 2023, section 6).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd

from romandask.products.hats import rows_around
from romandask.products.schemas import schema
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.stages.analysis.friends_of_friends import CODES, Matches, length_name

MAG_EDGES = np.arange(18.0, 28.01, 0.5)
"""Bins of i magnitude."""
COLOUR_EDGES = np.arange(-3.0, 8.01, 0.25)
"""Bins of g - F184."""
SIZE_EDGES = np.arange(0.0, 2.001, 0.05)
"""Bins of half-light radius, arcsec."""
SURVEYS = ("roman", "rubin")
REAL = 0.05
"""Share of a blend's true light in i that its second true object has at least for the blend to be real."""


@dataclass(frozen=True)
class Samples:
    """What the statistics know of the objects in groups."""

    tables: dict[str, TableProduct]
    """Samples by survey."""
    reference: dict[str, str]
    """Band by survey in which magnitudes are compared."""
    galaxies: TableProduct
    """Truth."""
    stars: TableProduct

    @property
    def colour(self) -> dict[str, str]:
        """Band by survey of the colour: g of Rubin less F184 of Roman, or what comes closest to them."""
        columns = {name: self.tables[name].schema.names for name in SURVEYS}
        wanted = {"roman": "F184", "rubin": "g"}
        return {name: band if f"{band}_mag" in columns[name] else self.reference[name] for name, band in wanted.items()}


@dataclass(frozen=True)
class Statistics:
    """The tables of the statistics stage."""

    blends: TableProduct
    """Counts of groups by numbers of objects of each survey."""
    unrecognised: TableProduct
    """Unrecognised blends by i magnitude."""
    distributions: TableProduct
    """Colours and sizes of Rubin's objects, of blends and of others."""
    chance: TableProduct
    """What `unrecognised` would be by chance alone."""


def statistics(found: Matches, shifted: Matches, samples: Samples, lengths: tuple[float, ...]) -> Statistics:
    """Return the lazy statistics of the groups of Roman and Rubin objects.

    Parameters
    ----------
    found, shifted : groups, and those of a sky in which Rubin's objects are moved
    """
    state = {
        "lengths": lengths,
        "bands": [samples.reference, samples.colour],
        "real": REAL,
        "edges": [MAG_EDGES.tolist(), COLOUR_EDGES.tolist(), SIZE_EDGES.tolist()],
    }

    def table(name: str, groups: Matches, kind: type[_Table], columns: str = "") -> TableProduct:
        products = (groups.groups, groups.merged, *samples.tables.values(), samples.galaxies, samples.stars)
        upstream = tuple((product.stage, unit) for product in products for unit in product.names)
        return TableProduct(
            stage=f"statistics/{name}",
            units=(Unit("all", state, upstream),),
            make=kind(groups, samples, lengths),
            schema=schema(columns or name),
            bytes_per_unit=500 << 20,
        )

    return Statistics(
        table("blends", found, _Blends),
        table("unrecognised", found, _Unrecognised),
        table("distributions", found, _Distributions),
        table("chance", shifted, _Unrecognised, "unrecognised"),
    )


def matrix(blends: pd.DataFrame, length: float) -> pd.DataFrame:
    """Return the blend matrix: numbers of groups, Roman objects in rows and Rubin objects in columns."""
    chosen = blends[np.isclose(blends["linking_length"], length)]
    return chosen.pivot(index="n_roman", columns="n_rubin", values="groups").fillna(0).astype(int)


def whole_groups(found: Matches, samples: Samples) -> Iterator[pd.DataFrame]:
    """Yield the objects of all groups, some at a time, no group in two parts.

    Columns: rubin (True, or False for Roman), a column group_<length> a linking length, magnitude in the reference
    band and in that of the colour (`other`), half_light_radius, counterpart (a number that tells true objects apart;
    -1 for none) and true_flux, that of the counterpart in Rubin's reference band, nJy.
    """
    merged = found.merged.load(0)["key"].to_numpy()
    aside = []
    for index, cell in enumerate(found.groups.pixels or ()):
        groups = found.groups.load(index)
        if not len(groups):
            continue
        frame = _described(groups, samples, cell, found.groups.order or 0)
        # a group that crosses a border is with all others that do
        crossing = np.isin(groups["key"].to_numpy(), merged)
        aside.append(frame[crossing])
        yield frame[~crossing]
    if aside:
        yield pd.concat(aside, ignore_index=True)


def _described(groups: pd.DataFrame, samples: Samples, cell: int, order: int) -> pd.DataFrame:
    """Return the rows of `whole_groups` of one partition."""
    band = samples.reference["rubin"]
    parts = []
    for code, (name, table) in enumerate(samples.tables.items()):
        magnitude, other = (f"{bands[name]}_mag" for bands in (samples.reference, samples.colour))
        columns = ["objectId", magnitude, other, "half_light_radius", "truth_id", "star"]
        rows = table.rows_in(np.array([cell]), order, columns)
        values = {"magnitude": rows[magnitude].to_numpy(float), "other": rows[other].to_numpy(float)}
        key = rows["objectId"].to_numpy(np.int64) * CODES + code
        parts.append(rows[["half_light_radius", "truth_id", "star"]].assign(**values, key=key))
    frame = groups.merge(pd.concat(parts, ignore_index=True), on="key", validate="one_to_one")
    true = []
    for star, product, number in ((False, samples.galaxies, "galaxy_id"), (True, samples.stars, "id")):
        # a counterpart may lie beyond the border
        rows = rows_around(product, cell, order, [number, f"flux_{band}"])
        flux = rows[f"flux_{band}"].to_numpy(float)
        true.append(pd.DataFrame({"truth_id": rows[number].to_numpy(np.int64), "star": star, "true_flux": flux}))
    frame = frame.merge(pd.concat(true).drop_duplicates(["truth_id", "star"]), on=["truth_id", "star"], how="left")
    # a star and a galaxy may have one number
    counterpart = np.where(frame["truth_id"] >= 0, frame["truth_id"] * 2 + frame["star"], -1)
    names = [name for name in frame.columns if name.startswith("group_")]
    kept = [*names, "magnitude", "other", "half_light_radius", "true_flux"]
    return frame[kept].assign(counterpart=counterpart, rubin=frame["key"].to_numpy() % CODES == 1)


@dataclass(frozen=True)
class Counted:
    """Groups of one linking length: of each object (n,) its group's number and, by group (m,), numbers of objects."""

    group: np.ndarray
    roman: np.ndarray
    rubin: np.ndarray

    @property
    def blend(self) -> np.ndarray:
        """(m,) True for unrecognised blends."""
        return (self.rubin == 1) & (self.roman >= 2)


def counted(rows: pd.DataFrame, length: float) -> Counted:
    """Return the groups of some rows of `whole_groups`."""
    _, group = np.unique(rows[f"group_{length_name(length)}"].to_numpy(), return_inverse=True)
    rubin, count = rows["rubin"].to_numpy(), int(group.max(initial=-1)) + 1
    return Counted(group, np.bincount(group[~rubin], minlength=count), np.bincount(group[rubin], minlength=count))


def real(rows: pd.DataFrame, groups: Counted) -> np.ndarray:
    """True (m,) for groups whose Roman objects are two or more true ones, the second with a share of the light.

    Where two objects are parts of one galaxy, or the second is nothing that Rubin could see, there is no blend.
    """
    roman = (~rows["rubin"] & (rows["counterpart"] >= 0)).to_numpy()
    members = (
        pd.DataFrame(
            {
                "group": groups.group[roman],
                "counterpart": rows["counterpart"].to_numpy()[roman],
                "flux": np.nan_to_num(rows["true_flux"].to_numpy(float)[roman]),
            }
        )
        .drop_duplicates(["group", "counterpart"])
        .sort_values(["group", "flux"], ascending=[True, False])
    )
    total = np.bincount(members["group"], members["flux"], len(groups.roman))
    second = members[members.groupby("group").cumcount() == 1]
    found = np.zeros(len(groups.roman), bool)
    found[second["group"]] = second["flux"].to_numpy() >= REAL * total[second["group"]]
    return found


@dataclass(frozen=True)
class _Table(ABC):
    found: Matches
    samples: Samples
    lengths: tuple[float, ...]

    def parts(self) -> Iterator[tuple[float, pd.DataFrame, Counted]]:
        """Yield, for every part of the groups and each linking length, rows and their groups."""
        for rows in whole_groups(self.found, self.samples):
            for length in self.lengths:
                yield length, rows, counted(rows, length)

    @abstractmethod
    def __call__(self, index: int) -> pd.DataFrame:
        """Return the rows of the one unit."""


class _Blends(_Table):
    def __call__(self, index: int) -> pd.DataFrame:
        counts = [
            pd.DataFrame({"linking_length": length, "n_roman": groups.roman, "n_rubin": groups.rubin})
            .value_counts()
            .rename("groups")
            .reset_index()
            for length, _, groups in self.parts()
        ]
        if not counts:
            return pd.DataFrame(columns=schema("blends").names)
        keys = ["linking_length", "n_roman", "n_rubin"]
        return pd.concat(counts).groupby(keys, as_index=False)["groups"].sum()


class _Unrecognised(_Table):
    def __call__(self, index: int) -> pd.DataFrame:
        names = ("rubin_objects", "with_roman", "blends", "real", "alone")
        totals = {length: np.zeros((len(names), len(MAG_EDGES) - 1), np.int64) for length in self.lengths}
        for length, rows, groups in self.parts():
            rubin = rows["rubin"].to_numpy()
            group, magnitude = groups.group[rubin], rows["magnitude"].to_numpy()[rubin]
            blend, seen = groups.blend, groups.roman >= 1
            for number, chosen in enumerate((seen | True, seen, blend, blend & real(rows, groups), ~seen)):
                totals[length][number] += np.histogram(magnitude[chosen[group]], MAG_EDGES)[0]
        parts = []
        for length, total in totals.items():
            counts = dict(zip(names, total, strict=True))
            objects = counts["rubin_objects"]
            with np.errstate(invalid="ignore", divide="ignore"):
                fraction = counts["blends"] / objects
                error = np.sqrt(fraction * (1 - fraction) / objects)
            parts.append(
                pd.DataFrame(
                    {
                        "linking_length": length,
                        "i_mag_low": MAG_EDGES[:-1],
                        "i_mag_high": MAG_EDGES[1:],
                        **counts,
                        "fraction": fraction,
                        "error": error,
                    }
                )
            )
        return pd.concat(parts, ignore_index=True)


class _Distributions(_Table):
    def __call__(self, index: int) -> pd.DataFrame:
        edges = {"colour": COLOUR_EDGES, "size": SIZE_EDGES}
        totals = {
            (length, name): np.zeros((2, len(edges[name]) - 1), np.int64) for length in self.lengths for name in edges
        }
        for length, rows, groups in self.parts():
            rubin = rows["rubin"].to_numpy()
            # of Roman's objects in a group the brightest
            bright = rows[~rubin].assign(group=groups.group[~rubin]).sort_values("magnitude").drop_duplicates("group")
            red = np.full(len(groups.roman), np.nan)
            red[bright["group"]] = bright["other"]
            group = groups.group[rubin]
            values = {
                "colour": rows["other"].to_numpy()[rubin] - red[group],
                "size": rows["half_light_radius"].to_numpy(float)[rubin],
            }
            one = groups.rubin[group] == 1
            for number, chosen in enumerate((one & (groups.roman[group] == 1), groups.blend[group])):
                for name, value in values.items():
                    totals[length, name][number] += np.histogram(value[chosen], edges[name])[0]
        return pd.concat(
            [
                pd.DataFrame(
                    {
                        "linking_length": length,
                        "quantity": name,
                        "low": edges[name][:-1],
                        "high": edges[name][1:],
                        "singles": total[0],
                        "blends": total[1],
                    }
                )
                for (length, name), total in totals.items()
            ],
            ignore_index=True,
        )
