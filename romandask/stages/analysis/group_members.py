"""The objects of friends-of-friends groups, with their measurements and true counterparts."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np
import pandas as pd

from romandask.products.hats import rows_around
from romandask.products.tables import TableProduct
from romandask.stages.analysis.friends_of_friends import Matches, length_name
from romandask.stages.analysis.partitions import CODES

REAL = 0.05
"""Smallest share of the true light of a real blend, in the reference band of the blended survey, that its second
brightest true object has."""


@dataclass(frozen=True, kw_only=True)
class PairSample:
    """The sample of one of the two surveys, and its bands."""

    table: TableProduct
    """Sample of the survey (schema: catalogs/samples.yaml)."""
    code: int
    """Number of the survey, part of the keys of its objects."""
    reference_band: str
    """Band in which magnitudes are compared."""
    colour_band: str
    """Band of the colour between the two surveys."""


@dataclass(frozen=True, kw_only=True)
class Samples:
    """The samples of both surveys and the truth catalogs."""

    sharp: PairSample
    """Sample of the survey that resolves blends, by default Roman."""
    blended: PairSample
    """Sample of the survey whose blends are counted, by default Rubin."""
    galaxies: TableProduct
    """True galaxies (schema: catalogs/galaxies.yaml)."""
    stars: TableProduct
    """True stars (schema: catalogs/stars.yaml)."""

    @property
    def both(self) -> tuple[PairSample, PairSample]:
        """Samples of the sharp and of the blended survey."""
        return self.sharp, self.blended


def complete_groups(matched: Matches, samples: Samples) -> Iterator[pd.DataFrame]:
    """Yield the objects of both surveys, such that all objects of a group are in the same data frame.

    Parameters
    ----------
    matched : Matches
        Groups of the objects.
    samples : Samples
        Samples of both surveys and the truth.

    Yields
    ------
    DataFrame
        `blended` (True for an object of the blended survey), `group_<length>` for each linking length, `magnitude` in
        the reference band, `colour_magnitude` in the colour band, `half_light_radius` (arcsec), `counterpart` (a
        unique number of the true object; -1 for none) and `true_flux` (of the counterpart, in the reference band of
        the blended survey, nJy).
    """
    merged = matched.merged.load(0)["key"].to_numpy()
    crossing_parts = []
    for index, cell in enumerate(matched.groups.pixels or ()):
        groups = matched.groups.load(index)
        if not len(groups):
            continue
        frame = _with_measurements(groups, samples, cell, matched.groups.order or 0)
        # groups that cross borders are yielded together at the end
        crosses = np.isin(groups["key"].to_numpy(), merged)
        crossing_parts.append(frame[crosses])
        yield frame[~crosses]
    if crossing_parts:
        yield pd.concat(crossing_parts, ignore_index=True)


def _with_measurements(groups: pd.DataFrame, samples: Samples, cell: int, order: int) -> pd.DataFrame:
    """Return the objects of one partition with the columns of `complete_groups`."""
    band = samples.blended.reference_band
    parts = []
    for sample in samples.both:
        reference, colour = f"{sample.reference_band}_mag", f"{sample.colour_band}_mag"
        columns = ["objectId", reference, colour, "half_light_radius", "truth_id", "star"]
        rows = sample.table.rows_in(np.array([cell]), order, columns)
        values = {"magnitude": rows[reference].to_numpy(float), "colour_magnitude": rows[colour].to_numpy(float)}
        key = rows["objectId"].to_numpy(np.int64) * CODES + sample.code
        parts.append(rows[["half_light_radius", "truth_id", "star"]].assign(**values, key=key))
    frame = groups.merge(pd.concat(parts, ignore_index=True), on="key", validate="one_to_one")
    true = []
    for star, product, id_column in ((False, samples.galaxies, "galaxy_id"), (True, samples.stars, "id")):
        # the counterpart of an object may lie in the next partition
        rows = rows_around(product, cell, order, [id_column, f"flux_{band}"])
        flux = rows[f"flux_{band}"].to_numpy(float)
        true.append(pd.DataFrame({"truth_id": rows[id_column].to_numpy(np.int64), "star": star, "true_flux": flux}))
    frame = frame.merge(pd.concat(true).drop_duplicates(["truth_id", "star"]), on=["truth_id", "star"], how="left")
    # a star and a galaxy may have the same id, and ids may have 63 bits: stars have negative numbers from -2 on
    counterpart = np.where(frame["star"] & (frame["truth_id"] >= 0), -2 - frame["truth_id"], frame["truth_id"])
    names = [name for name in frame.columns if name.startswith("group_")]
    kept = [*names, "magnitude", "colour_magnitude", "half_light_radius", "true_flux"]
    return frame[kept].assign(counterpart=counterpart, blended=frame["key"].to_numpy() % CODES == samples.blended.code)


@dataclass(frozen=True)
class GroupCounts:
    """Numbers of objects in the m groups of n objects, for one linking length."""

    group: np.ndarray
    """Number of the group of each object, (n,), from 0."""
    sharp: np.ndarray
    """Number of objects of the sharp survey in each group, (m,)."""
    blended: np.ndarray
    """Number of objects of the blended survey in each group, (m,)."""

    @property
    def is_blend(self) -> np.ndarray:
        """True for groups that are unrecognised blends, (m,)."""
        return (self.blended == 1) & (self.sharp >= 2)


def count_groups(rows: pd.DataFrame, length: float) -> GroupCounts:
    """Return the groups of a data frame of `complete_groups` for a linking length, arcsec."""
    _, group = np.unique(rows[f"group_{length_name(length)}"].to_numpy(), return_inverse=True)
    blended, count = rows["blended"].to_numpy(), int(group.max(initial=-1)) + 1
    return GroupCounts(
        group=group,
        sharp=np.bincount(group[~blended], minlength=count),
        blended=np.bincount(group[blended], minlength=count),
    )


def is_real(rows: pd.DataFrame, groups: GroupCounts) -> np.ndarray:
    """Return True, (m,), for groups whose objects of the sharp survey have two or more true counterparts.

    The second brightest counterpart must have a share of at least `REAL` of the true light of the group. A group is
    therefore not real if its objects are parts of one galaxy, or if the blended survey could not detect the second.

    Parameters
    ----------
    rows : DataFrame
        Objects, as `complete_groups` yields them.
    groups : GroupCounts
        Their groups.
    """
    sharp = (~rows["blended"] & (rows["counterpart"] != -1)).to_numpy()
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
    group_is_real = np.zeros(len(groups.sharp), bool)
    group_is_real[second["group"]] = second["flux"].to_numpy() >= REAL * total[second["group"]]
    return group_is_real
