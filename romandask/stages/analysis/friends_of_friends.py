"""Matches: friends-of-friends groups of the objects of two or more surveys, computed partition by partition.

1. `local`: each partition computes the minimum spanning forest of its own objects.
2. `crossing`: each partition lists the links between its objects and the objects of other partitions.
3. `merged`: one unit computes the forest of all groups that have such a link.
4. `groups`: each partition assigns its objects to groups.

The groups do not depend on the partitions. The groups of any linking length shorter than the longest follow from the
same forest: its links that are longer are cut.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType

import dask.dataframe as dd
import numpy as np
import pandas as pd

from romandask.kernels.measurement.groups import forest, label, links
from romandask.model.errors import UserError
from romandask.model.settings import MatchSettings
from romandask.model.sky import Region, unit_vectors
from romandask.products.hats import RIM, RIM_ORDER, inner_rim, rim
from romandask.products.schemas import schema
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.stages.analysis.blend_pair import has_joint_analysis, joint
from romandask.stages.analysis.partitions import CODES, Partitions
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage, SurveyContext
from romandask.storage.store import Store

SHIFT = 13.0
"""Distance in declination, arcsec, by which one survey is shifted to count groups that form by chance."""


@dataclass(frozen=True)
class Matches:
    """The products of the friends-of-friends stages, in order."""

    local: TableProduct
    """Objects, with the minimum spanning forest of their own partition."""
    crossing: TableProduct
    """Links between objects of different partitions."""
    merged: TableProduct
    """Minimum spanning forest of the groups that cross borders of partitions."""
    groups: TableProduct
    """Objects, with the complete forest and the group of each linking length."""


def matches(
    objects: dict[str, TableProduct],
    codes: dict[str, int],
    settings: MatchSettings,
    region: Region,
    store: Store | None = None,
    prefix: str = "matches",
    shift: Mapping[str, float] = MappingProxyType({}),
) -> Matches:
    """Return the lazy friends-of-friends groups of the object tables of several surveys.

    Parameters
    ----------
    objects : dict of str to TableProduct
        HATS catalogs by survey name, with columns objectId, coord_ra and coord_dec.
    codes : dict of str to int
        Unique number of each survey, smaller than `CODES`; it is part of the keys of the objects.
    settings : MatchSettings
        Section `matches` of the pipeline.
    region : Region
        Region that is divided into partitions.
    store : Store, optional
        Store from which stored units are read; by default everything is made.
    prefix : str
        First part of the names of the products.
    shift : mapping of str to float, arcsec
        Distance in declination, at most `SHIFT`, by which the objects of a survey are shifted, so that links between
        surveys are chance coincidences. Surveys that are not named are not shifted.

    Raises
    ------
    UserError
        If a linking length is longer than 5 arcsec, the part of the ring of cells around a partition that the shift
        leaves.
    """
    longest, longest_allowed = max(settings.linking_lengths), RIM - SHIFT
    if longest > longest_allowed:
        raise UserError(f"matches.linking_lengths: {longest:g} arcsec, {longest_allowed:g} at most")
    cells = tuple(map(int, region.cells(settings.order)))
    lengths = settings.linking_lengths
    columns = tuple(map(length_name, lengths))
    unit_settings = {
        "longest": longest,
        "order": settings.order,
        "surveys": {name: codes[name] for name in objects},
        "shift": dict(shift),
    }
    names = [f"{settings.order}-{cell}" for cell in cells]
    bytes_per_unit = 300 << 20
    partitions = Partitions(
        objects=objects,
        codes={name: codes[name] for name in objects},
        longest=longest,
        order=settings.order,
        cells=cells,
        shift=dict(shift),
    )
    local = TableProduct(
        stage=f"{prefix}/local",
        units=tuple(
            Unit(name, unit_settings, partitions.inputs(cell)) for name, cell in zip(names, cells, strict=True)
        ),
        make=_Local(partitions),
        schema=schema("local"),
        pixels=cells,
        order=settings.order,
        bytes_per_unit=bytes_per_unit,
        store=store,
    )
    crossing = TableProduct(
        stage=f"{prefix}/crossing",
        units=tuple(
            Unit(name, unit_settings, partitions.inputs(cell, with_ring=True))
            for name, cell in zip(names, cells, strict=True)
        ),
        make=_Crossing(partitions),
        schema=schema("crossing"),
        bytes_per_unit=bytes_per_unit,
        store=store,
    )
    upstream = tuple((product.stage, unit.name) for product in (local, crossing) for unit in product.units)
    merged = TableProduct(
        stage=f"{prefix}/merged",
        units=(Unit("all", unit_settings, upstream),),
        make=_Merge(local, crossing),
        schema=schema("merged"),
        bytes_per_unit=bytes_per_unit,
        store=store,
    )
    groups = TableProduct(
        stage=f"{prefix}/groups",
        units=tuple(
            Unit(name, {**unit_settings, "lengths": lengths}, ((local.stage, name), (merged.stage, "all")))
            for name in names
        ),
        make=_AssignGroups(local, merged, {codes[name]: name for name in objects}, lengths),
        schema=schema("groups", columns),
        pixels=cells,
        order=settings.order,
        bytes_per_unit=bytes_per_unit,
        store=store,
    )
    return Matches(local, crossing, merged, groups)


def length_name(length: float) -> str:
    """Return a linking length, arcsec, as columns name it: `1000mas` for 1.0 arcsec."""
    return f"{round(length * 1000)}mas"


def group_of(groups: pd.DataFrame, merged: pd.DataFrame, length: float) -> np.ndarray:
    """Return the smallest key of the group of each object of a partition, shape (n,).

    Parameters
    ----------
    groups : DataFrame
        The n objects, with columns key, into and joined, of the product `local` or `groups`.
    merged : DataFrame
        All rows of the product `merged`.
    length : float, arcsec
        Linking length, no longer than the longest of `matches.linking_lengths`.
    """
    # `merged` has the rows of all groups that cross borders, in whatever partition their objects are
    own = groups.loc[~np.isin(groups["key"].to_numpy(), merged["key"].to_numpy()), ["key", "into", "joined"]]
    forest_rows = pd.concat([own, merged[["key", "into", "joined"]]] if len(merged) else [own]).sort_values("key")
    key = forest_rows["key"].to_numpy()
    first = label(np.searchsorted(key, forest_rows["into"].to_numpy()), forest_rows["joined"].to_numpy(), length)
    return key[first[np.searchsorted(key, groups["key"].to_numpy())]]


def cut_groups(products: Matches, length: float) -> dd.DataFrame:
    """Return the lazy table `products.groups` with a column `group`, the group of each object (see `group_of`)."""
    frame = products.groups.frame
    meta = frame._meta.assign(group=np.empty(0, np.int64))
    return frame.map_partitions(_with_group, products.merged.load(0), length, meta=meta)


def _with_group(groups: pd.DataFrame, merged: pd.DataFrame, length: float) -> pd.DataFrame:
    return groups.assign(group=group_of(groups, merged, length))


@dataclass(frozen=True)
class _Local:
    """Makes the forest of the objects of one partition."""

    partitions: Partitions

    def __call__(self, index: int) -> pd.DataFrame:
        frame = self.partitions.own(index)
        pairs, separation = links(unit_vectors(frame["coord_ra"], frame["coord_dec"]), self.partitions.longest)
        into, joined = forest(len(frame), pairs, separation)
        frame = frame.assign(into=frame["key"].to_numpy()[into], joined=joined)
        return frame.sort_values(["_healpix_29", "key"], ignore_index=True)


@dataclass(frozen=True)
class _Crossing:
    """Makes the links between the objects of one partition and the objects around it."""

    partitions: Partitions

    def __call__(self, index: int) -> pd.DataFrame:
        cell, order = self.partitions.cells[index], self.partitions.order
        own, outside = (self.partitions.rows(ring(cell, order), RIM_ORDER) for ring in (inner_rim, rim))
        vectors = [unit_vectors(frame["coord_ra"], frame["coord_dec"]) for frame in (own, outside)]
        keys = np.concatenate([own["key"].to_numpy(), outside["key"].to_numpy()])
        pairs, separation = links(np.concatenate(vectors), self.partitions.longest)
        inside = pairs < len(own)
        crosses = inside[:, 0] != inside[:, 1]
        pairs, separation = pairs[crosses], separation[crosses]
        inner = np.where(inside[crosses, 0], pairs[:, 0], pairs[:, 1])
        outer = np.where(inside[crosses, 0], pairs[:, 1], pairs[:, 0])
        # both partitions find a link; the partition of the smaller key lists it
        listed = keys[inner] < keys[outer]
        ends = {"key_1": keys[inner][listed], "key_2": keys[outer][listed], "separation": separation[listed]}
        return pd.DataFrame(ends).sort_values(["key_1", "key_2"])


@dataclass(frozen=True)
class _Merge:
    """Makes the forest of all groups that have a link between partitions."""

    local: TableProduct
    crossing: TableProduct

    def __call__(self, index: int) -> pd.DataFrame:
        edges = self.crossing.all_rows()
        ends = np.unique(edges[["key_1", "key_2"]].to_numpy())
        parts = []
        for k in range(len(self.local.units)):
            frame = self.local.select(k, ["key", "into", "joined"]).sort_values("key", ignore_index=True)
            key = frame["key"].to_numpy()
            if len(key) and ends.searchsorted(key[-1], "right") > ends.searchsorted(key[0]):
                # all rows of a group that has a crossing link, because the link may change its forest
                group = label(np.searchsorted(key, frame["into"].to_numpy()), frame["joined"].to_numpy(), np.inf)
                touched = np.zeros(len(key), bool)
                touched[group[np.isin(key, ends)]] = True
                parts.append(frame[touched[group]])
        if not parts:
            return pd.DataFrame({"key": np.empty(0, np.int64), "into": np.empty(0, np.int64), "joined": np.empty(0)})
        rows = pd.concat(parts).sort_values("key", ignore_index=True)
        key = rows["key"].to_numpy()
        linked = np.isfinite(rows["joined"].to_numpy())
        first = np.concatenate([key[linked], edges["key_1"].to_numpy()])
        second = np.concatenate([rows["into"].to_numpy()[linked], edges["key_2"].to_numpy()])
        separation = np.concatenate([rows["joined"].to_numpy()[linked], edges["separation"].to_numpy()])
        pairs = np.stack([np.searchsorted(key, first), np.searchsorted(key, second)], 1)
        into, joined = forest(len(key), pairs, separation)
        return pd.DataFrame({"key": key, "into": key[into], "joined": joined})


@dataclass(frozen=True)
class _AssignGroups:
    """Makes the groups of the objects of one partition."""

    local: TableProduct
    merged: TableProduct
    surveys: dict[int, str]
    """Survey names by code."""
    lengths: tuple[float, ...]
    """Linking lengths, arcsec."""

    def __call__(self, index: int) -> pd.DataFrame:
        frame, merged = self.local.load(index), self.merged.load(0)
        key = frame["key"].to_numpy()
        row = np.minimum(np.searchsorted(merged["key"].to_numpy(), key), max(len(merged) - 1, 0))
        if len(merged):
            is_merged = merged["key"].to_numpy()[row] == key
            for name in ("into", "joined"):
                frame[name] = np.where(is_merged, merged[name].to_numpy()[row], frame[name].to_numpy())
        names = np.array([self.surveys.get(code, "") for code in range(CODES)], object)
        frame["survey"] = names[key % CODES]
        frame["objectId"] = key // CODES
        for length in self.lengths:
            frame[f"group_{length_name(length)}"] = group_of(frame, merged, length)
        return frame


def matches_of(context: SurveyContext) -> Matches:
    """Return the lazy groups of the samples of the sharp and the blended survey."""
    return _matches(context, "matches", {})


def chance_of(context: SurveyContext) -> Matches:
    """Return the lazy groups after the blended survey was shifted, so that its links with the other are by chance."""
    return _matches(context, "chance", {context.once(joint).blended: SHIFT})


def _matches(context: SurveyContext, prefix: str, shift: dict[str, float]) -> Matches:
    pair = context.once(joint)
    tables = {name: context.output(f"samples/{name}") for name in (pair.sharp, pair.blended)}
    codes = {name: context.instruments[name].code for name in tables}
    return matches(tables, codes, context.pipeline.matches, context.region, context.store, prefix, shift)


def _stages(prefix: str, products: Callable[[SurveyContext], Matches], condition: str) -> tuple[Stage, ...]:
    """Return the stages `local`, `crossing`, `merged` and `groups`; `condition` ends their summaries."""

    def stage(
        part: str,
        build: Callable[[Matches], TableProduct],
        reads: tuple[str, ...],
        unit: str,
        summary: str,
        sky: tuple[str, str] | None = None,
    ) -> Stage:
        return Stage(
            name=f"{prefix}/{part}",
            build=lambda context, _: build(context.once(products)),
            exists=has_joint_analysis,
            reads=reads,
            units_known_after=UNITS_FROM_POINTINGS,
            unit=unit,
            summary=f"{summary}{condition}.",
            sky=sky,
            shrink_with="raise matches.order",
            tables={part: f"{prefix}/{part}/"},
        )

    return (
        stage(
            "local",
            lambda products: products.local,
            reads=("samples",),
            unit="HEALPix cell",
            summary="The minimum spanning forest of the objects of a cell",
        ),
        stage(
            "crossing",
            lambda products: products.crossing,
            reads=("samples",),
            unit="HEALPix cell",
            summary="The links between the objects of a cell and objects outside it",
        ),
        stage(
            "merged",
            lambda products: products.merged,
            reads=(f"{prefix}/local", f"{prefix}/crossing"),
            unit="survey",
            summary="The minimum spanning forest of the groups that cross borders of cells",
        ),
        stage(
            "groups",
            lambda products: products.groups,
            reads=(f"{prefix}/local", f"{prefix}/merged"),
            unit="HEALPix cell",
            summary="The friends-of-friends groups of the objects of both samples, which do not depend on the cells",
            sky=("coord_ra", "coord_dec"),
        ),
    )


MATCHES = _stages("matches", matches_of, "")
CHANCE = _stages("chance", chance_of, ", after the blended survey was shifted by 13 arcsec")
