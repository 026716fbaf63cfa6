"""Matches: friends of friends over the objects of all surveys, for any linking length, over any partitions.

Every partition grows the minimum spanning forest of its own objects and lists the links that cross its border; the
forests that these links touch are grown together; every partition names its groups. The groups equal those of one
piece, whatever the partitions; shorter linking lengths than the longest are the same forest, cut.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any

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
from romandask.stages.stage import UNITS_FROM_POINTINGS, Stage, SurveyContext
from romandask.storage.store import Store

SHIFT = 13.0
"""Arcsec by which a survey is moved to count what chance makes."""
CODES = 8
"""A key is this many times the objectId, and the code of the survey."""


@dataclass(frozen=True)
class Matches:
    """The stages of friends of friends, in order."""

    local: TableProduct
    """Objects with the forest of their own partition."""
    crossing: TableProduct
    """Links between partitions."""
    merged: TableProduct
    """The forest of the groups that cross borders."""
    groups: TableProduct
    """Objects with the whole forest and their groups."""


def matches(
    objects: dict[str, TableProduct],
    codes: dict[str, int],
    settings: MatchSettings,
    region: Region,
    store: Store | None = None,
    kind: str = "matches",
    shift: Mapping[str, float] = MappingProxyType({}),
) -> Matches:
    """Return the lazy groups of the object tables of several surveys.

    Parameters
    ----------
    objects : dict of str to TableProduct
        Tables by survey name, with objectId, coord_ra, coord_dec.
    codes : dict of str to int
        Number of each survey, below `CODES`: the part of a key that tells surveys apart.
    settings : MatchSettings
    region : Region
    store : Store or None
        Where the stages before the last are read, where they are stored.
    kind : str
        First part of the names of the products.
    shift : mapping of str to float
        Arcsec by which the objects of a survey are moved: what is linked then is linked by chance.

    Raises
    ------
    UserError
        If a linking length is longer than what is looked at around a partition.
    """
    most = RIM - SHIFT
    if max(settings.linking_lengths) > most:
        raise UserError(f"matches.linking_lengths: {max(settings.linking_lengths):g} arcsec, {most:g} at most")
    cells = tuple(map(int, region.cells(settings.order)))
    lengths = settings.linking_lengths
    columns = tuple(map(length_name, lengths))
    state = {
        "longest": max(lengths),
        "order": settings.order,
        "surveys": {name: codes[name] for name in objects},
        "shift": dict(shift),
    }
    names = [f"{settings.order}-{cell}" for cell in cells]
    size = 300 << 20
    parts = _Partitions(
        objects=objects,
        codes={name: codes[name] for name in objects},
        longest=max(lengths),
        order=settings.order,
        cells=cells,
        shift=dict(shift),
    )
    local = TableProduct(
        stage=f"{kind}/local",
        units=tuple(Unit(name, state, parts.inputs(cell)) for name, cell in zip(names, cells, strict=True)),
        make=_Local(parts),
        schema=schema("local"),
        pixels=cells,
        order=settings.order,
        bytes_per_unit=size,
        store=store,
    )
    crossing = TableProduct(
        stage=f"{kind}/crossing",
        units=tuple(Unit(name, state, parts.inputs(cell, True)) for name, cell in zip(names, cells, strict=True)),
        make=_Crossing(parts),
        schema=schema("crossing"),
        bytes_per_unit=size,
        store=store,
    )
    upstream = tuple((product.stage, unit.name) for product in (local, crossing) for unit in product.units)
    merged = TableProduct(
        stage=f"{kind}/merged",
        units=(Unit("all", state, upstream),),
        make=_Merge(local, crossing),
        schema=schema("merged"),
        bytes_per_unit=size,
        store=store,
    )
    groups = TableProduct(
        stage=f"{kind}/groups",
        units=tuple(
            Unit(name, {**state, "lengths": lengths}, ((local.stage, name), (merged.stage, "all"))) for name in names
        ),
        make=_Name(local, merged, {codes[name]: name for name in objects}, lengths),
        schema=schema("groups", columns),
        pixels=cells,
        order=settings.order,
        bytes_per_unit=size,
        store=store,
    )
    return Matches(local, crossing, merged, groups)


def length_name(length: float) -> str:
    """Return the name of a linking length in columns: in mas, 1.0 arcsec is 1000mas."""
    return f"{round(length * 1000)}mas"


def group_of(groups: pd.DataFrame, merged: pd.DataFrame, length: float) -> np.ndarray:
    """Return the smallest key of the group of each object of a partition.

    Parameters
    ----------
    groups : rows with key, into, joined (matches/local or matches/groups)
    merged : the table matches/merged
    length : arcsec, no longer than the longest linking length of the survey
    """
    # the rows of groups that cross borders stand in `merged`, wherever their objects are
    own = groups.loc[~np.isin(groups["key"].to_numpy(), merged["key"].to_numpy()), ["key", "into", "joined"]]
    every = pd.concat([own, merged[["key", "into", "joined"]]] if len(merged) else [own]).sort_values("key")
    key = every["key"].to_numpy()
    first = label(np.searchsorted(key, every["into"].to_numpy()), every["joined"].to_numpy(), length)
    return key[first[np.searchsorted(key, groups["key"].to_numpy())]]


@dataclass(frozen=True, kw_only=True)
class _Partitions:
    """The objects of several catalogs, cut anew."""

    objects: dict[str, TableProduct]
    codes: dict[str, int]
    longest: float
    order: int
    cells: tuple[int, ...]
    shift: dict[str, float]
    """Arcsec, by survey."""

    def inputs(self, cell: int, around: bool = False) -> tuple[tuple[str, str], ...]:
        """Return the units that hold the objects of a cell, and around it."""
        return tuple(
            (product.stage, product.names[k])
            for product in self.objects.values()
            for k in sorted(
                {
                    *product.touching_cells(np.array([cell]), self.order),
                    *(product.touching_cells(rim(cell, self.order), RIM_ORDER) if around else ()),
                }
            )
        )

    def rows(self, cells: np.ndarray, order: int) -> pd.DataFrame:
        """Return the objects of some cells, by key, with columns key, coord_ra, coord_dec and _healpix_29."""
        parts = []
        for name, product in self.objects.items():
            frame = product.rows_in(cells, order, ["objectId", "coord_ra", "coord_dec"])
            if shift := self.shift.get(name, 0.0):
                # towards the equator: nowhere over a pole
                dec = frame["coord_dec"]
                frame["coord_dec"] = dec - np.where(dec > 0, 1, -1) * shift / 3600
            parts.append(frame.assign(key=frame["objectId"].to_numpy(np.int64) * CODES + self.codes[name]))
        return pd.concat(parts, ignore_index=True).sort_values("key", ignore_index=True).drop(columns="objectId")

    def own(self, index: int) -> pd.DataFrame:
        """Return the objects of a partition."""
        return self.rows(np.array([self.cells[index]]), self.order)


@dataclass(frozen=True)
class _Local:
    parts: _Partitions

    def __call__(self, index: int) -> pd.DataFrame:
        frame = self.parts.own(index)
        found = links(unit_vectors(frame["coord_ra"], frame["coord_dec"]), self.parts.longest)
        into, joined = forest(len(frame), *found)
        frame = frame.assign(into=frame["key"].to_numpy()[into], joined=joined)
        return frame.sort_values(["_healpix_29", "key"], ignore_index=True)


@dataclass(frozen=True)
class _Crossing:
    parts: _Partitions

    def __call__(self, index: int) -> pd.DataFrame:
        own, outside = (
            self.parts.rows(cells(self.parts.cells[index], self.parts.order), RIM_ORDER) for cells in (inner_rim, rim)
        )
        vectors = [unit_vectors(frame["coord_ra"], frame["coord_dec"]) for frame in (own, outside)]
        keys = np.concatenate([own["key"].to_numpy(), outside["key"].to_numpy()])
        pairs, gap = links(np.concatenate(vectors), self.parts.longest)
        inside = pairs < len(own)
        across = inside[:, 0] != inside[:, 1]
        pairs, gap = pairs[across], gap[across]
        mine = np.where(inside[across, 0], pairs[:, 0], pairs[:, 1])
        other = np.where(inside[across, 0], pairs[:, 1], pairs[:, 0])
        # both partitions meet a link: it is listed by that of its smaller key
        first = keys[mine] < keys[other]
        ends = {"key_1": keys[mine][first], "key_2": keys[other][first], "separation": gap[first]}
        return pd.DataFrame(ends).sort_values(["key_1", "key_2"])


@dataclass(frozen=True)
class _Merge:
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
                # all of a group that a link touches: its forest may grow otherwise
                group = label(np.searchsorted(key, frame["into"].to_numpy()), frame["joined"].to_numpy(), np.inf)
                touched = np.zeros(len(key), bool)
                touched[group[np.isin(key, ends)]] = True
                parts.append(frame[touched[group]])
        if not parts:
            return pd.DataFrame({"key": np.empty(0, np.int64), "into": np.empty(0, np.int64), "joined": np.empty(0)})
        rows = pd.concat(parts).sort_values("key", ignore_index=True)
        key = rows["key"].to_numpy()
        grown = np.isfinite(rows["joined"].to_numpy())
        first = np.concatenate([key[grown], edges["key_1"].to_numpy()])
        second = np.concatenate([rows["into"].to_numpy()[grown], edges["key_2"].to_numpy()])
        gap = np.concatenate([rows["joined"].to_numpy()[grown], edges["separation"].to_numpy()])
        into, joined = forest(len(key), np.stack([np.searchsorted(key, first), np.searchsorted(key, second)], 1), gap)
        return pd.DataFrame({"key": key, "into": key[into], "joined": joined})


@dataclass(frozen=True)
class _Name:
    local: TableProduct
    merged: TableProduct
    surveys: dict[int, str]
    """By code."""
    lengths: tuple[float, ...]

    def __call__(self, index: int) -> pd.DataFrame:
        frame, merged = self.local.load(index), self.merged.load(0)
        key = frame["key"].to_numpy()
        place = np.minimum(np.searchsorted(merged["key"].to_numpy(), key), max(len(merged) - 1, 0))
        if len(merged):
            known = merged["key"].to_numpy()[place] == key
            for name in ("into", "joined"):
                frame[name] = np.where(known, merged[name].to_numpy()[place], frame[name].to_numpy())
        names = np.array([self.surveys.get(code, "") for code in range(CODES)], object)
        frame["survey"] = names[key % CODES]
        frame["objectId"] = key // CODES
        for length in self.lengths:
            frame[f"group_{length_name(length)}"] = group_of(frame, merged, length)
        return frame


@dataclass(frozen=True)
class BlendPair:
    """The two surveys between which unrecognised blends are counted."""

    sharp: str
    """Survey whose several objects are one of the other."""
    blended: str


def blend_pair(context: SurveyContext) -> BlendPair | None:
    """Return the two surveys whose blends are counted; None where a survey has only one of them.

    They are those of `matches.surveys`; else the instruments that declare the parts `sharp` and `blended`.

    Raises
    ------
    UserError
        If `matches.surveys` names no two instruments of the pipeline.
    """
    wanted, instruments = context.pipeline.matches.surveys, context.instruments
    if wanted is not None:
        if set(wanted) - set(instruments) or wanted[0] == wanted[1]:
            raise UserError(
                f"matches.surveys: {', '.join(wanted)}: two different ones of {', '.join(instruments)} are needed"
            )
        return BlendPair(*wanted)
    by_role = {one.blend_role: name for name, one in instruments.items() if one.blend_role is not None}
    return BlendPair(by_role["sharp"], by_role["blended"]) if {"sharp", "blended"} <= set(by_role) else None


def joint(context: SurveyContext) -> BlendPair:
    """Return the two surveys whose blends are counted.

    Raises
    ------
    UserError
        If the survey does not have both.
    """
    pair = context.once(blend_pair)
    if pair is None:
        raise UserError(f"blends need a sharp and a blended survey; this one has {', '.join(context.instruments)}")
    return pair


def has_joint_analysis(context: SurveyContext, survey: str) -> bool:
    """Return whether a survey has both instruments whose blends are counted."""
    return context.once(blend_pair) is not None


def matches_of(context: SurveyContext) -> Matches:
    """Return the stages of friends of friends over the samples."""
    return _joined(context, "matches", {})


def chance_of(context: SurveyContext) -> Matches:
    """Return the same of a sky in which the blended survey is moved: its groups are by chance."""
    return _joined(context, "chance", {context.once(joint).blended: SHIFT})


def _joined(context: SurveyContext, kind: str, shift: dict[str, float]) -> Matches:
    pair = context.once(joint)
    tables = {name: context.output(f"samples/{name}") for name in (pair.sharp, pair.blended)}
    codes = {name: context.instruments[name].code for name in tables}
    return matches(tables, codes, context.pipeline.matches, context.region, context.store, kind, shift)


def _stages(kind: str, products: Callable[[SurveyContext], Matches], about: str) -> tuple[Stage, ...]:
    def stage(part: str, build: Callable[[Matches], TableProduct], reads: tuple[str, ...], **more: Any) -> Stage:
        return Stage(
            name=f"{kind}/{part}",
            build=lambda context, _: build(context.once(products)),
            exists=has_joint_analysis,
            reads=reads,
            units_known_after=UNITS_FROM_POINTINGS,
            shrink_with="raise matches.order",
            tables={part: f"{kind}/{part}/"},
            **more,
        )

    return (
        stage(
            "local",
            lambda found: found.local,
            ("samples",),
            unit="HEALPix cell",
            summary=f"Minimum spanning forest of the objects of a cell{about}.",
        ),
        stage(
            "crossing",
            lambda found: found.crossing,
            ("samples",),
            unit="HEALPix cell",
            summary=f"Links of its objects with those outside{about}.",
        ),
        stage(
            "merged",
            lambda found: found.merged,
            (f"{kind}/local", f"{kind}/crossing"),
            unit="survey",
            summary=f"The forest of the groups that cross cells{about}.",
        ),
        stage(
            "groups",
            lambda found: found.groups,
            (f"{kind}/local", f"{kind}/merged"),
            unit="HEALPix cell",
            summary="Friends of friends over the samples of both surveys, whatever the partitions; every shorter "
            f"linking length is a cut of the forest{about}.",
            sky=("coord_ra", "coord_dec"),
        ),
    )


MATCHES = _stages("matches", matches_of, "")
CHANCE = _stages("chance", chance_of, ", one survey moved: what chance makes")
