"""Friends of friends against brute force, for several partitions."""

import numpy as np
import pandas as pd
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from romandask.engine.graph import UnitGraph
from romandask.kernels.measurement.groups import forest, label, links
from romandask.model.errors import UserError
from romandask.model.settings import MatchSettings
from romandask.model.sky import ARCSEC, Region, unit_vectors
from romandask.products.hats import with_spatial_index
from romandask.products.schemas import schema
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.stages.analysis.friends_of_friends import SHIFT, Matches, group_of, length_name, matches
from romandask.storage.store import Store

REGION = Region(359.99, 0.01, -0.01, 0.01)


def brute_force(vectors: np.ndarray, length: float) -> list[set[int]]:
    """Return the groups found by following links from object to object, with all pairs of angles."""
    gap = np.degrees(np.arccos(np.clip(vectors @ vectors.T, -1, 1))) * 3600
    near = gap <= length
    left, groups = set(range(len(vectors))), []
    while left:
        group, edge = set(), {left.pop()}
        while edge:
            group |= edge
            edge = set(np.flatnonzero(near[list(edge)].any(axis=0)).tolist()) - group
        left -= group
        groups.append(group)
    return groups


def as_sets(labels) -> set[frozenset]:
    labels = np.asarray(labels)
    return {frozenset(np.flatnonzero(labels == value).tolist()) for value in np.unique(labels)}


@settings(max_examples=40, deadline=None)
@given(st.integers(0, 10_000), st.integers(1, 60))
def test_groups_equal_brute_force(seed, count):
    random = np.random.default_rng(seed)
    vectors = unit_vectors(random.uniform(0, 6, count) / 3600, 70 + random.uniform(0, 6, count) / 3600)
    pairs, gap = links(vectors, 1.0)
    assert (gap <= 1.0 + 1e-9).all()
    assert len({frozenset(pair) for pair in pairs.tolist()}) == len(pairs), "no pair twice"
    into, joined = forest(count, pairs, gap)
    assert (into <= np.arange(count)).all()
    # the groups of every shorter length follow from the same forest
    for length in (1.0, 0.6, 0.25):
        found = label(into, joined, length)
        assert as_sets(found) == {frozenset(group) for group in brute_force(vectors, length)}
        assert (found <= np.arange(count)).all(), "a group is named after its first row"


def test_a_link_is_an_angle_not_a_difference_of_coordinates():
    vectors = unit_vectors([359.9999, 0.0001, 0.0], [89.9999, 89.9999, 89.9999])
    pairs, _ = links(vectors, 1.0)
    assert len(pairs) == 3, "three points around RA 0 at the pole lie within an arcsecond"
    assert len(links(unit_vectors([0.0, 1.001 / 3600], [0.0, 0.0]), 1.0)[0]) == 0
    pairs, gap = links(unit_vectors([0.0, 0.999 / 3600], [0.0, 0.0]), 1.0)
    assert gap[0] * ARCSEC == pytest.approx(0.999 * ARCSEC)


def table(name: str, frame: pd.DataFrame, order: int) -> TableProduct:
    """Return an object table with HEALPix partitions of any order."""
    columns = schema("objects", ("i",))
    blank = columns.empty_table().to_pandas()
    missing = {
        name: np.full(len(frame), "" if name in ("tile", "patch") else 0) for name in blank.columns if name not in frame
    }
    full = frame.assign(**missing)
    full = with_spatial_index(full, "coord_ra", "coord_dec")
    cells = tuple(map(int, REGION.cells(order)))
    owner = full["_healpix_29"].to_numpy() >> 2 * (29 - order)
    parts = [full[owner == cell].reset_index(drop=True) for cell in cells]
    assert sum(map(len, parts)) == len(frame)
    return TableProduct(
        stage=f"objects/{name}",
        units=tuple(Unit(str(c), c) for c in cells),
        make=lambda k: parts[k],
        schema=columns,
        pixels=cells,
        order=order,
    )


def codes_of(products) -> dict[str, int]:
    return {name: code for code, name in enumerate(products)}


def stored_matches(products, settings: MatchSettings, folder, prefix: str = "matches", **shift: float) -> Matches:
    """Make groups stage by stage; each stage reads the stored products of earlier ones."""
    store = Store(folder)
    made = matches(products, codes_of(products), settings, REGION, store, prefix, shift)
    for product in (made.local, made.crossing, made.merged, made.groups):
        UnitGraph.of(product, store).compute(scheduler="sync")
    return made


@pytest.fixture(scope="module")
def clumped():
    random = np.random.default_rng(8)

    def frame(count):
        centre = random.uniform(-30, 30, (2, 150))
        member = random.integers(0, 150, count)
        ra, dec = centre[:, member] + random.normal(0, 0.6, (2, count))
        return pd.DataFrame(
            {
                "objectId": np.arange(count) + 7,
                "coord_ra": (ra / 3600) % 360,
                "coord_dec": dec / 3600,
                "i_kronFlux": 500.0,
            }
        )

    return frame(500), frame(260)


@pytest.mark.parametrize(("object_order", "match_order"), [(10, 10), (12, 11), (11, 12)])
def test_groups_do_not_depend_on_partitions(clumped, object_order, match_order, tmp_path):
    roman, rubin = clumped
    products = {"roman": table("roman", roman, object_order), "rubin": table("rubin", rubin, object_order)}
    lengths = (1.0, 0.5)
    made = stored_matches(products, MatchSettings(linking_lengths=lengths, order=match_order), tmp_path)
    if match_order > 10:
        assert len(made.crossing.all_rows()) > 5, "some groups cross partitions"
    found = made.groups.all_rows()
    assert len(found) == 760
    assert found["key"].is_unique
    vectors = unit_vectors(found["coord_ra"], found["coord_dec"])
    for length in lengths:
        column = f"group_{length_name(length)}"
        assert as_sets(found[column]) == {frozenset(group) for group in brute_force(vectors, length)}
        smallest = found.groupby(column)["key"].min()
        assert (smallest.index == smallest).all(), "a group is named after its smallest key"
    for length in (0.8, 0.3):
        parts = [made.groups.load(k) for k in range(len(made.groups.units))]
        group = np.concatenate([group_of(part, made.merged.load(0), length) for part in parts])
        assert as_sets(group) == {frozenset(group) for group in brute_force(vectors, length)}


def test_groups_of_a_shifted_survey_equal_brute_force(clumped, tmp_path):
    """The shift is larger than a clump; links are those of the shifted positions."""
    roman, rubin = clumped
    products = {"roman": table("roman", roman, 11), "rubin": table("rubin", rubin, 11)}
    made = stored_matches(products, MatchSettings(order=12), tmp_path, "chance", rubin=SHIFT)
    found = made.groups.all_rows()
    dec = np.concatenate(
        [roman["coord_dec"], rubin["coord_dec"] - np.where(rubin["coord_dec"] > 0, 1, -1) * SHIFT / 3600]
    )
    key = np.concatenate([roman["objectId"] * 8, rubin["objectId"] * 8 + 1])
    vectors = unit_vectors(np.concatenate([roman["coord_ra"], rubin["coord_ra"]]), dec)
    order = np.argsort(key)
    expected = {frozenset(key[order][list(group)]) for group in brute_force(vectors[order], 1.0)}
    groups = found.groupby("group_1000mas")["key"].agg(frozenset)
    assert set(groups) == expected


def test_no_objects_are_no_groups(tmp_path):
    empty = pd.DataFrame({"objectId": [], "coord_ra": [], "coord_dec": []}).astype({"objectId": np.int64})
    products = {"roman": table("roman", empty, 10), "rubin": table("rubin", empty, 10)}
    made = stored_matches(products, MatchSettings(order=10), tmp_path)
    assert len(made.groups.all_rows()) == 0


def test_links_longer_than_the_ring_around_a_partition_are_refused():
    products = {"roman": table("roman", pd.DataFrame({"objectId": [1], "coord_ra": [0.0], "coord_dec": [0.0]}), 10)}
    with pytest.raises(UserError, match=r"linking_lengths: 60 arcsec, 5 at most"):
        matches(products, codes_of(products), MatchSettings(linking_lengths=(60.0,), order=12), REGION)
