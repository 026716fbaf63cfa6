"""Matches: friends of friends over the objects of all surveys, for several linking lengths, over any partitions.

Every partition labels its own objects and lists the links that cross its border; the labels that these links touch are
merged; every partition is relabelled. The groups equal those of one piece, whatever the partitions.
"""

from __future__ import annotations

from dataclasses import dataclass

import cdshealpix.nested as healpix
import numpy as np
import pandas as pd

from romandask.kernels.groups import label, links, merge, relabel
from romandask.model.config import MatchSettings
from romandask.model.errors import UserError
from romandask.model.sky import Region, cells_in_cone, unit_vectors
from romandask.runtime.products import TableProduct
from romandask.runtime.schemas import schema
from romandask.runtime.store import Store
from romandask.runtime.units import Unit


@dataclass(frozen=True)
class Matches:
    """The stages of friends of friends, in order."""

    local: TableProduct
    """Objects with the labels of their own partition."""
    crossing: TableProduct
    """Links between partitions."""
    merged: TableProduct
    """Labels that become others; one unit a linking length."""
    groups: TableProduct
    """Objects with their groups."""


def matches(
    objects: dict[str, TableProduct], settings: MatchSettings, region: Region, store: Store | None = None
) -> Matches:
    """Return the lazy groups of the object tables of several surveys.

    Parameters
    ----------
    objects : object tables by survey name; the order gives each survey its code in `key`
    store : where the stages before the last are read, where they are stored
    """
    cells = tuple(map(int, region.cells(settings.order)))
    state = {"settings": settings.model_dump(), "surveys": list(objects)}
    around = {cell: _neighbours(cell, settings) for cell in cells}
    sources = []
    for cell in cells:
        inputs = []
        for product in objects.values():
            pixels = _pixels(product, around[cell], settings.order)
            inputs += [
                (product.stage, unit.name)
                for unit, pixel in zip(product.units, product.pixels or (), strict=True)
                if pixel in pixels
            ]
        sources.append(tuple(inputs))
    names = [f"{settings.order}-{cell}" for cell in cells]
    units = tuple(
        Unit(name, {**state, "cell": cell}, inputs) for name, cell, inputs in zip(names, cells, sources, strict=True)
    )
    common = (objects, settings, cells, around)
    lengths = settings.linking_lengths
    columns = tuple(map(length_name, lengths))
    size = 500 << 20
    local = TableProduct(
        "matches/local", units, _Local(*common), schema("local", columns), bytes_per_unit=size, store=store
    )
    crossing = TableProduct(
        "matches/crossing", units, _Crossing(*common), schema("crossing"), bytes_per_unit=size, store=store
    )
    upstream = tuple((product.stage, unit.name) for product in (local, crossing) for unit in product.units)
    merged = TableProduct(
        "matches/merged",
        tuple(Unit(name, {**state, "length": name}, upstream) for name in columns),
        _Merge(local, crossing, lengths),
        schema("merged"),
        bytes_per_unit=size,
        store=store,
    )
    groups = TableProduct(
        "matches/groups",
        tuple(
            Unit(
                name,
                {**state, "cell": cell},
                (("matches/local", name), *(("matches/merged", column) for column in columns)),
            )
            for name, cell in zip(names, cells, strict=True)
        ),
        _Relabel(local, merged, columns),
        schema("groups", columns),
        cells,
        settings.order,
        size,
        store=store,
    )
    return Matches(local, crossing, merged, groups)


def length_name(length: float) -> str:
    """Return the name of a linking length in columns: in mas, 1.0 arcsec is 1000mas."""
    return f"{round(length * 1000)}mas"


@dataclass(frozen=True)
class _Partition:
    objects: dict[str, TableProduct]
    settings: MatchSettings
    cells: tuple[int, ...]
    around: dict[int, set[int]]

    def rows(self, index: int) -> tuple[pd.DataFrame, np.ndarray]:
        """Return the objects in and around a partition, sorted by key, and which are its own."""
        cell = self.cells[index]
        parts = []
        shift = 2 * (29 - self.settings.order)
        for code, (survey, product) in enumerate(self.objects.items()):
            wanted = _pixels(product, self.around[cell], self.settings.order)
            for k, pixel in enumerate(product.pixels or ()):
                if pixel not in wanted:
                    continue
                frame = product.load(k)[["objectId", "coord_ra", "coord_dec", "_healpix_29"]]
                here = np.isin(frame["_healpix_29"].to_numpy() >> shift, list(self.around[cell]))
                key = frame["objectId"].to_numpy() * 8 + code
                parts.append(frame.assign(key=key, survey=survey)[here])
        frame = pd.concat(parts, ignore_index=True) if parts else schema("groups").empty_table().to_pandas()
        frame = frame.sort_values("key", ignore_index=True)
        return frame, frame["_healpix_29"].to_numpy() >> shift == cell

    def pairs(self, index: int) -> tuple[pd.DataFrame, np.ndarray, np.ndarray, np.ndarray]:
        """Return rows, which are its own, the pairs within the largest linking length, and their separations."""
        frame, own = self.rows(index)
        found, gap = links(unit_vectors(frame["coord_ra"], frame["coord_dec"]), max(self.settings.linking_lengths))
        return frame, own, found, gap


class _Local(_Partition):
    def __call__(self, index: int) -> pd.DataFrame:
        frame, own, found, gap = self.pairs(index)
        place = np.cumsum(own) - 1
        inside = own[found].all(axis=1)
        mine = frame[own].reset_index(drop=True)
        for length in self.settings.linking_lengths:
            pairs = place[found[inside & (gap <= length)]]
            mine[f"label_{length_name(length)}"] = label(mine["key"].to_numpy(), pairs)
        return mine


class _Crossing(_Partition):
    def __call__(self, index: int) -> pd.DataFrame:
        frame, own, found, gap = self.pairs(index)
        keys = frame["key"].to_numpy()
        # each crossing link is listed once, by the partition of its smaller key
        across = own[found[:, 0]] != own[found[:, 1]]
        low = np.where(keys[found[:, 0]] < keys[found[:, 1]], 0, 1)
        mine = across & own[np.take_along_axis(found, low[:, None], axis=1)[:, 0]]
        ends = np.sort(keys[found[mine]], axis=1)
        return pd.DataFrame({"key_1": ends[:, 0], "key_2": ends[:, 1], "separation": gap[mine]}).sort_values(
            ["key_1", "key_2"]
        )


@dataclass(frozen=True)
class _Merge:
    local: TableProduct
    crossing: TableProduct
    lengths: tuple[float, ...]

    def __call__(self, index: int) -> pd.DataFrame:
        length = self.lengths[index]
        edges = self.crossing.all_rows()
        edges = edges[edges["separation"] <= length]
        touched = np.unique(edges[["key_1", "key_2"]].to_numpy())
        keys, labels = [], []
        for k in range(len(self.local.units)):
            frame = self.local.load(k)
            frame = frame[np.isin(frame["key"].to_numpy(), touched)]
            keys.append(frame["key"].to_numpy())
            labels.append(frame[f"label_{length_name(length)}"].to_numpy())
        key, found = np.concatenate(keys), np.concatenate(labels)
        order = np.argsort(key)
        key, found = key[order], found[order]
        first, second = (found[np.searchsorted(key, edges[name].to_numpy())] for name in ("key_1", "key_2"))
        before, after = merge(first, second)
        return pd.DataFrame({"label": before, "group": after})


@dataclass(frozen=True)
class _Relabel:
    local: TableProduct
    merged: TableProduct
    columns: tuple[str, ...]

    def __call__(self, index: int) -> pd.DataFrame:
        frame = self.local.load(index)
        for k, column in enumerate(self.columns):
            table = self.merged.load(k)
            frame[f"group_{column}"] = relabel(
                frame[f"label_{column}"].to_numpy(), table["label"].to_numpy(), table["group"].to_numpy()
            )
        return frame.sort_values(["_healpix_29", "key"], ignore_index=True)


def _neighbours(cell: int, settings: MatchSettings) -> set[int]:
    """Return the cell and those that its margin, as wide as the largest linking length, may reach."""
    # the cone holds every cell within a third of a cell of this one, whatever its shape
    if max(settings.linking_lengths) > 3600 * 18 / 2**settings.order:
        raise UserError("matches.linking_lengths exceed the HEALPix cells of matches.order: lower matches.order")
    lon, lat = _centre(cell, settings.order)
    radius = np.degrees(1.8 * np.sqrt(4 * np.pi / (12 * 4**settings.order)))
    return set(map(int, cells_in_cone(lon, lat, radius, settings.order)))


def _pixels(product: TableProduct, cells: set[int], order: int) -> set[int]:
    """Return the partitions of a catalog, of whatever order, that overlap some cells."""
    own = product.order or 0
    if own <= order:
        return {cell >> (2 * (order - own)) for cell in cells}
    step = 2 * (own - order)
    return {pixel for pixel in product.pixels or () if pixel >> step in cells}


def _centre(cell: int, order: int) -> tuple[float, float]:
    lon, lat = healpix.healpix_to_lonlat(np.array([cell], np.uint64), order)
    return float(lon.to_value("deg")[0]), float(lat.to_value("deg")[0])
