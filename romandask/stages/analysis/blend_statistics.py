"""Blend statistics: the blend matrix, unrecognised blends by magnitude, and the colours and sizes of blends.

The statistics compare a `sharp` and a `blended` survey, by default Roman and Rubin. An unrecognised blend is a group
with one object of the blended survey and two or more objects of the sharp survey (Troxel et al. 2023, section 6).
Columns of tables are named after the default surveys and bands.
"""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd

from romandask.model.errors import UserError
from romandask.products.schemas import schema
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.stages.analysis.blend_pair import has_joint_analysis, joint
from romandask.stages.analysis.friends_of_friends import Matches, chance_of, matches_of
from romandask.stages.analysis.group_members import (
    REAL,
    GroupCounts,
    PairSample,
    Samples,
    complete_groups,
    count_groups,
    is_real,
)
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage, SurveyContext
from romandask.stages.truth.catalogs import truth_of

MAG_EDGES = np.arange(18.0, 28.01, 0.5)
"""Edges of the bins in magnitude, in the reference band of the blended survey (i of Rubin)."""
COLOUR_EDGES = np.arange(-3.0, 8.01, 0.25)
"""Edges of the bins in colour, mag: colour band of the blended minus that of the sharp survey (g - F184)."""
SIZE_EDGES = np.arange(0.0, 2.001, 0.05)
"""Edges of the bins in half-light radius, arcsec."""


@dataclass(frozen=True)
class Statistics:
    """The products of the statistics stages."""

    blends: TableProduct
    """Number of groups for each combination of object counts in the two surveys (schema: catalogs/blends.yaml)."""
    unrecognised: TableProduct
    """Unrecognised blends by magnitude (schema: catalogs/unrecognised.yaml)."""
    distributions: TableProduct
    """Colours and sizes of single objects and of unrecognised blends (schema: catalogs/distributions.yaml)."""
    chance: TableProduct
    """The table `unrecognised` after the blended survey was shifted, so that groups form by chance."""


def statistics(matched: Matches, shifted: Matches, samples: Samples, lengths: tuple[float, ...]) -> Statistics:
    """Return the lazy statistics of the groups of two surveys.

    Parameters
    ----------
    matched : Matches
        Groups of the objects of both surveys.
    shifted : Matches
        Groups after the objects of the blended survey were shifted.
    samples : Samples
        Samples of both surveys and the truth.
    lengths : tuple of float, arcsec
        Linking lengths for which statistics are computed.

    Returns
    -------
    Statistics
        Four tables, each with one unit.
    """
    unit_settings = {
        "lengths": lengths,
        "bands": [[sample.code, sample.reference_band, sample.colour_band] for sample in samples.both],
        "real": REAL,
        "edges": [MAG_EDGES.tolist(), COLOUR_EDGES.tolist(), SIZE_EDGES.tolist()],
    }

    def table(name: str, groups: Matches, maker: type[_Table], schema_name: str) -> TableProduct:
        tables = (sample.table for sample in samples.both)
        products = (groups.groups, groups.merged, *tables, samples.galaxies, samples.stars)
        upstream = tuple((product.stage, unit) for product in products for unit in product.names)
        return TableProduct(
            stage=f"statistics/{name}",
            units=(Unit("all", unit_settings, upstream),),
            make=maker(groups, samples, lengths),
            schema=schema(schema_name),
            bytes_per_unit=500 << 20,
        )

    return Statistics(
        blends=table("blends", matched, _Blends, "blends"),
        unrecognised=table("unrecognised", matched, _Unrecognised, "unrecognised"),
        distributions=table("distributions", matched, _Distributions, "distributions"),
        chance=table("chance", shifted, _Unrecognised, "unrecognised"),
    )


def matrix(blends: pd.DataFrame, length: float) -> pd.DataFrame:
    """Return the blend matrix for a linking length.

    Parameters
    ----------
    blends : DataFrame
        Schema: catalogs/blends.yaml.
    length : float, arcsec

    Returns
    -------
    DataFrame of int
        Number of groups by number of objects of the sharp survey (index `n_roman`) and of the blended survey (columns
        `n_rubin`).
    """
    chosen = blends[np.isclose(blends["linking_length"], length)]
    return chosen.pivot(index="n_roman", columns="n_rubin", values="groups").fillna(0).astype(int)


class SurveyStatistics:
    """The statistics of the groups of a survey as tables in memory.

    The argument `linking_length` of its methods is one of `matches.linking_lengths`, arcsec, by default the first. They
    raise UserError if it is another length.

    Parameters
    ----------
    products : Statistics
        Products that the tables are read from.
    lengths : tuple of float, arcsec
        Linking lengths for which there are statistics.
    """

    def __init__(self, products: Statistics, lengths: tuple[float, ...]):
        self._products = products
        self._lengths = lengths

    def blends(self, linking_length: float | None = None) -> pd.DataFrame:
        """Return the blend matrix: the number of groups for each combination of object counts in the two surveys.

        Returns
        -------
        DataFrame of int
            Index `n_roman`: objects of the sharp survey. Columns `n_rubin`: objects of the blended survey.
        """
        return matrix(self._products.blends.all_rows(), self._length(linking_length))

    def unrecognised(self, linking_length: float | None = None) -> pd.DataFrame:
        """Return the number of unrecognised blends by magnitude (schema: catalogs/unrecognised.yaml)."""
        return self._table(self._products.unrecognised, linking_length)

    def chance(self, linking_length: float | None = None) -> pd.DataFrame:
        """Return the number of unrecognised blends that form by chance (schema: catalogs/unrecognised.yaml).

        They are counted after the objects of the blended survey were shifted by 13 arcsec.
        """
        return self._table(self._products.chance, linking_length)

    def distributions(self, linking_length: float | None = None) -> pd.DataFrame:
        """Return colours and sizes of unrecognised blends and single objects (schema: catalogs/distributions.yaml)."""
        return self._table(self._products.distributions, linking_length)

    def _table(self, product: TableProduct, length: float | None) -> pd.DataFrame:
        table = product.all_rows()
        return table[np.isclose(table["linking_length"], self._length(length))].reset_index(drop=True)

    def _length(self, length: float | None) -> float:
        length = self._lengths[0] if length is None else length
        if not np.isclose(length, self._lengths).any():
            raise UserError(f"linking length {length}: this survey has {', '.join(map(str, self._lengths))} arcsec")
        return length


@dataclass(frozen=True)
class _Table(ABC):
    """Makes the only unit of a statistics table."""

    matched: Matches
    samples: Samples
    lengths: tuple[float, ...]
    """Linking lengths, arcsec."""

    def parts(self) -> Iterator[tuple[float, pd.DataFrame, GroupCounts]]:
        """Yield linking length, objects and groups, for each part of the objects and each linking length."""
        for rows in complete_groups(self.matched, self.samples):
            for length in self.lengths:
                yield length, rows, count_groups(rows, length)

    @abstractmethod
    def __call__(self, index: int) -> pd.DataFrame:
        """Return the rows of the unit."""


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
        return pd.concat(counts).groupby(keys)["groups"].sum().reset_index()


class _Unrecognised(_Table):
    def __call__(self, index: int) -> pd.DataFrame:
        names = ("rubin_objects", "with_roman", "blends", "real", "alone")
        totals = {length: np.zeros((len(names), len(MAG_EDGES) - 1), np.int64) for length in self.lengths}
        for length, rows, groups in self.parts():
            blended = rows["blended"].to_numpy()
            group, magnitude = groups.group[blended], rows["magnitude"].to_numpy()[blended]
            is_blend, with_sharp = groups.is_blend, groups.sharp >= 1
            every = np.ones(len(groups.sharp), bool)
            selections = (every, with_sharp, is_blend, is_blend & is_real(rows, groups), ~with_sharp)
            for number, selected in enumerate(selections):
                totals[length][number] += np.histogram(magnitude[selected[group]], MAG_EDGES)[0]
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
            # the colour is measured against the brightest object of the sharp survey in the group
            brightest = (
                rows[~blended].assign(group=groups.group[~blended]).sort_values("magnitude").drop_duplicates("group")
            )
            sharp_magnitude = np.full(len(groups.sharp), np.nan)
            sharp_magnitude[brightest["group"]] = brightest["colour_magnitude"]
            group = groups.group[blended]
            values = {
                "colour": rows["colour_magnitude"].to_numpy()[blended] - sharp_magnitude[group],
                "size": rows["half_light_radius"].to_numpy(float)[blended],
            }
            is_single = (groups.blended[group] == 1) & (groups.sharp[group] == 1)
            for number, selected in enumerate((is_single, groups.is_blend[group])):
                for name, value in values.items():
                    totals[length, name][number] += np.histogram(value[selected], edges[name])[0]
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
    """Return the lazy statistics of the groups of a survey."""
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
    samples = Samples(sharp=sharp, blended=blended, galaxies=truth.galaxies, stars=truth.stars)
    lengths = context.pipeline.matches.linking_lengths
    products = statistics(context.once(matches_of), context.once(chance_of), samples, lengths)
    store = context.store
    if store is None:
        return products
    return Statistics(**{name: table.stored(store) for name, table in vars(products).items()})


def _stage(
    part: str, build: Callable[[Statistics], TableProduct], schema_name: str, summary: str, groups: str = "matches"
) -> Stage:
    return Stage(
        name=f"statistics/{part}",
        build=lambda context, _: build(context.once(statistics_of)),
        exists=has_joint_analysis,
        reads=(f"{groups}/groups", f"{groups}/merged", "samples", "truth/galaxies", "truth/stars"),
        units_known_after=UNITS_FROM_POINTINGS,
        unit="survey",
        summary=summary,
        tables={schema_name: f"statistics/{part}/"},
    )


STATISTICS = (
    _stage(
        "blends",
        lambda products: products.blends,
        schema_name="blends",
        summary="The blend matrix: the number of groups for each combination of object counts in the two surveys.",
    ),
    _stage(
        "unrecognised",
        lambda products: products.unrecognised,
        schema_name="unrecognised",
        summary="The number of unrecognised blends by magnitude, and how many of them are blends of two or more true "
        "objects.",
    ),
    _stage(
        "distributions",
        lambda products: products.distributions,
        schema_name="distributions",
        summary="The colours and sizes of unrecognised blends and of single objects.",
    ),
    _stage(
        "chance",
        lambda products: products.chance,
        schema_name="unrecognised",
        summary="The number of unrecognised blends by magnitude that form by chance, after the blended survey was "
        "shifted by 13 arcsec.",
        groups="chance",
    ),
)
