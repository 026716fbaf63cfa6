"""Statistics of the groups: the blend matrix, unrecognised blends against magnitude, and what they do to measurements.

An unrecognised blend is a group with one object of Rubin and two or more of Roman (Troxel et al. 2023, section 6).
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd

from romandask.products.hats import rows_around
from romandask.products.schemas import schema
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.stages.analysis.blend_pair import has_joint_analysis, joint
from romandask.stages.analysis.friends_of_friends import Matches, chance_of, length_name, matches_of
from romandask.stages.analysis.partitions import CODES
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage, SurveyContext
from romandask.stages.truth.catalogs import truth_of

MAG_EDGES = np.arange(18.0, 28.01, 0.5)
"""Bins of i magnitude."""
COLOUR_EDGES = np.arange(-3.0, 8.01, 0.25)
"""Bins of g - F184."""
SIZE_EDGES = np.arange(0.0, 2.001, 0.05)
"""Bins of half-light radius, arcsec."""
REAL = 0.05
"""Share of a blend's true light in i that its second true object has at least for the blend to be real."""


@dataclass(frozen=True, kw_only=True)
class PairSample:
    """What the statistics know of the objects of one survey."""

    table: TableProduct
    """Its sample."""
    code: int
    """Number of the survey in the keys of objects."""
    reference_band: str
    """Band in which magnitudes are compared."""
    colour_band: str
    """Band of the colour between the two surveys."""


@dataclass(frozen=True, kw_only=True)
class Samples:
    """What the statistics know of the objects in groups."""

    sharp: PairSample
    """The survey whose several objects are one of the other: Roman."""
    blended: PairSample
    """The survey whose blends are counted: Rubin."""
    galaxies: TableProduct
    """Truth."""
    stars: TableProduct

    @property
    def both(self) -> tuple[PairSample, PairSample]:
        """The two surveys."""
        return self.sharp, self.blended


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
        "bands": [[one.code, one.reference_band, one.colour_band] for one in samples.both],
        "real": REAL,
        "edges": [MAG_EDGES.tolist(), COLOUR_EDGES.tolist(), SIZE_EDGES.tolist()],
    }

    def table(name: str, groups: Matches, kind: type[_Table], columns: str = "") -> TableProduct:
        products = (groups.groups, groups.merged, *(one.table for one in samples.both), samples.galaxies, samples.stars)
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

    Columns: blended (True for an object of the blended survey), a column group_<length> a linking length, magnitude in
    the reference band and in that of the colour (`other`), half_light_radius, counterpart (a number that tells true
    objects apart; -1 for none) and true_flux, that of the counterpart in the blended survey's reference band, nJy.
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
    band = samples.blended.reference_band
    parts = []
    for one in samples.both:
        magnitude, other = f"{one.reference_band}_mag", f"{one.colour_band}_mag"
        columns = ["objectId", magnitude, other, "half_light_radius", "truth_id", "star"]
        rows = one.table.rows_in(np.array([cell]), order, columns)
        values = {"magnitude": rows[magnitude].to_numpy(float), "other": rows[other].to_numpy(float)}
        key = rows["objectId"].to_numpy(np.int64) * CODES + one.code
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
    return frame[kept].assign(counterpart=counterpart, blended=frame["key"].to_numpy() % CODES == samples.blended.code)


@dataclass(frozen=True)
class Counted:
    """Groups of one linking length: of each object (n,) its group's number and, by group (m,), numbers of objects."""

    group: np.ndarray
    sharp: np.ndarray
    blended: np.ndarray

    @property
    def blend(self) -> np.ndarray:
        """(m,) True for unrecognised blends."""
        return (self.blended == 1) & (self.sharp >= 2)


def counted(rows: pd.DataFrame, length: float) -> Counted:
    """Return the groups of some rows of `whole_groups`."""
    _, group = np.unique(rows[f"group_{length_name(length)}"].to_numpy(), return_inverse=True)
    blended, count = rows["blended"].to_numpy(), int(group.max(initial=-1)) + 1
    return Counted(group, np.bincount(group[~blended], minlength=count), np.bincount(group[blended], minlength=count))


def real(rows: pd.DataFrame, groups: Counted) -> np.ndarray:
    """True (m,) for groups whose Roman objects are two or more true ones, the second with a share of the light.

    Where two objects are parts of one galaxy, or the second is nothing that Rubin could see, there is no blend.
    """
    sharp = (~rows["blended"] & (rows["counterpart"] >= 0)).to_numpy()
    members = (
        pd.DataFrame(
            {
                "group": groups.group[sharp],
                "counterpart": rows["counterpart"].to_numpy()[sharp],
                "flux": np.nan_to_num(rows["true_flux"].to_numpy(float)[sharp]),
            }
        )
        .drop_duplicates(["group", "counterpart"])
        .sort_values(["group", "flux"], ascending=[True, False])
    )
    total = np.bincount(members["group"], members["flux"], len(groups.sharp))
    second = members[members.groupby("group").cumcount() == 1]
    found = np.zeros(len(groups.sharp), bool)
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
            pd.DataFrame({"linking_length": length, "n_roman": groups.sharp, "n_rubin": groups.blended})
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
            blended = rows["blended"].to_numpy()
            group, magnitude = groups.group[blended], rows["magnitude"].to_numpy()[blended]
            blend, seen = groups.blend, groups.sharp >= 1
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
            blended = rows["blended"].to_numpy()
            # of Roman's objects in a group the brightest
            bright = (
                rows[~blended].assign(group=groups.group[~blended]).sort_values("magnitude").drop_duplicates("group")
            )
            red = np.full(len(groups.sharp), np.nan)
            red[bright["group"]] = bright["other"]
            group = groups.group[blended]
            values = {
                "colour": rows["other"].to_numpy()[blended] - red[group],
                "size": rows["half_light_radius"].to_numpy(float)[blended],
            }
            one = groups.blended[group] == 1
            for number, chosen in enumerate((one & (groups.sharp[group] == 1), groups.blend[group])):
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


def statistics_of(context: SurveyContext) -> Statistics:
    """Return the tables of the statistics of a survey's groups."""
    truth = context.once(truth_of)
    pair = context.once(joint)
    sharp, blended = (
        PairSample(
            table=context.output(f"samples/{name}"),
            code=context.instruments[name].code,
            reference_band=context.instruments[name].reference_band,
            colour_band=context.instruments[name].colour_band,
        )
        for name in (pair.sharp, pair.blended)
    )
    known = Samples(sharp=sharp, blended=blended, galaxies=truth.galaxies, stars=truth.stars)
    lengths = context.pipeline.matches.linking_lengths
    found = statistics(context.once(matches_of), context.once(chance_of), known, lengths)
    store = context.store
    return found if store is None else Statistics(*(table.stored(store) for table in vars(found).values()))


def _stage(part: str, build: Callable[[Statistics], TableProduct], kind: str, schema_: str, summary: str) -> Stage:
    return Stage(
        name=f"statistics/{part}",
        build=lambda context, _: build(context.once(statistics_of)),
        exists=has_joint_analysis,
        reads=(f"{kind}/groups", f"{kind}/merged", "samples", "truth/galaxies", "truth/stars"),
        units_known_after=UNITS_FROM_POINTINGS,
        unit="survey",
        summary=summary,
        tables={schema_: f"statistics/{part}/"},
    )


STATISTICS = (
    _stage("blends", lambda s: s.blends, "matches", "blends", "Blend matrix: groups by numbers of objects."),
    _stage(
        "unrecognised",
        lambda s: s.unrecognised,
        "matches",
        "unrecognised",
        "Unrecognised blends by magnitude, and how many of them are real.",
    ),
    _stage(
        "distributions",
        lambda s: s.distributions,
        "matches",
        "distributions",
        "Colours and sizes of blends and of single objects.",
    ),
    _stage("chance", lambda s: s.chance, "chance", "unrecognised", "Unrecognised blends that chance makes."),
)
