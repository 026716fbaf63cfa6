"""Samples and statistics of blends, for objects with known groups, counterparts and fluxes."""

import numpy as np
import pandas as pd
import pyarrow as pa
import pytest

from romandask.engine.graph import UnitGraph
from romandask.kernels.measurement.counts import counts_limit
from romandask.model.settings import MatchSettings
from romandask.model.sky import Region
from romandask.products.hats import with_spatial_index
from romandask.products.schemas import schema
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.stages.analysis.blend_statistics import matrix, statistics
from romandask.stages.analysis.friends_of_friends import SHIFT, matches
from romandask.stages.analysis.group_members import PairSample, Samples
from romandask.stages.analysis.samples import limits, samples
from romandask.storage.store import Store

REGION, ORDER = Region(59.99, 60.01, -30.01, -29.99), 12
ROMAN, RUBIN = ("H158", "F184"), ("g", "i")


def njy(magnitude):
    return 10 ** (0.4 * (31.4 - np.asarray(magnitude, float)))


def on_sky(frame: pd.DataFrame):
    return 60 + frame["x"] / 3600 / np.cos(np.radians(30)), -30 + frame["y"] / 3600


def catalog(stage: str, frame: pd.DataFrame, columns: pa.Schema, position=("coord_ra", "coord_dec")) -> TableProduct:
    """Return a HATS catalog in memory; missing columns are zero."""
    blank = columns.empty_table().to_pandas()
    full = frame.assign(**{name: np.zeros(len(frame)) for name in blank.columns if name not in frame})
    full = with_spatial_index(full, *position)
    cells = tuple(map(int, REGION.cells(ORDER)))
    owner = full["_healpix_29"].to_numpy() >> 2 * (29 - ORDER)
    parts = [full[owner == cell].reset_index(drop=True) for cell in cells]
    assert sum(map(len, parts)) == len(frame)
    units = tuple(Unit(str(cell), cell, (("detections/x", "tile"),)) for cell in cells)
    return TableProduct(stage=stage, units=units, make=lambda k: parts[k], schema=columns, pixels=cells, order=ORDER)


def survey_of(rows: list[dict], bands: tuple[str, ...], name: str) -> tuple[TableProduct, TableProduct]:
    """Return objects and counterparts from rows of x, y (arcsec from the centre), magnitudes, truth_id and flags."""
    frame = pd.DataFrame(rows)
    frame["objectId"] = np.arange(len(frame)) + 1
    columns = {f"{band}_kronFlux": njy(frame[band]) for band in bands} | {f"{band}_extinction": 0.1 for band in bands}
    frame = frame.assign(
        coord_ra=60 + frame["x"] / 3600 / np.cos(np.radians(30)),
        coord_dec=-30 + frame["y"] / 3600,
        tile="tile",
        patch="r0c0",
        **columns,
    )
    table = frame[["objectId", "truth_id"]].assign(star=False)
    matched = TableProduct(
        stage="truth_match/" + name,
        units=(Unit("tile", 0),),
        make=lambda k: _filled(table),
        schema=schema("truth_match"),
    )
    return catalog(f"objects/{name}", frame, schema("objects", bands)), matched


def _filled(table: pd.DataFrame) -> pd.DataFrame:
    return table.assign(**{n: np.zeros(len(table)) for n in schema("truth_match").names if n not in table})


@pytest.fixture(scope="module")
def sky():
    """Rubin objects 12 arcsec apart: single, real blends, galaxies in two pieces, and without Roman objects."""
    roman, rubin, galaxies = [], [], []
    positions = [(12.0 * i, 12.0 * j) for i in range(-2, 3) for j in range(-2, 3)]
    for number, (x, y) in enumerate(positions):
        kind = number % 4
        number *= 10
        rubin.append(
            {
                "x": x,
                "y": y,
                "g": 24.5 if kind == 1 else 25.0,
                "i": 23.1,
                "truth_id": number,
                "flags": 0,
                "half_light_radius": 0.6 + 0.2 * (kind == 1),
            }
        )
        galaxies.append({"galaxy_id": number, "x": x, "y": y, "flux_i": njy(23.0)})
        if kind == 3:
            continue
        roman.append({"x": x + 0.1, "y": y, "H158": 22.1, "F184": 22.0, "truth_id": number, "flags": 1})
        if kind in (1, 2):
            roman.append(
                {"x": x - 0.6, "y": y, "H158": 24.1, "F184": 23.0, "truth_id": number + (kind == 1), "flags": 0}
            )
            galaxies.append({"galaxy_id": number + 1, "x": x - 0.6, "y": y, "flux_i": njy(24.0)})
    # flagged, without a counterpart, and too faint: not in the clean sample
    roman += [{"x": 3.0, "y": 3.0, "H158": 22.0, "F184": 22.0, "truth_id": 1, "flags": 2}]
    roman += [{"x": 3.0, "y": 5.0, "H158": 22.0, "F184": 22.0, "truth_id": -1, "flags": 0}]
    roman += [{"x": 3.0, "y": 7.0, "H158": 26.0, "F184": 22.0, "truth_id": 1, "flags": 0}]
    frame = pd.DataFrame(galaxies)
    ra, dec = on_sky(frame)
    frame = frame.assign(ra=ra, dec=dec)

    def columns(number: str) -> pa.Schema:
        kinds = {number: pa.int64(), "_healpix_29": pa.int64()}
        return pa.schema([*kinds.items(), *((name, pa.float64()) for name in ("ra", "dec", "flux_i"))])

    truth = catalog("truth/galaxies", frame, columns("galaxy_id"), ("ra", "dec"))
    stars = catalog("truth/stars", frame.iloc[:0].assign(id=[]), columns("id"), ("ra", "dec"))
    return survey_of(roman, ROMAN, "roman"), survey_of(rubin, RUBIN, "rubin"), truth, stars


def made(sky, settings: MatchSettings, folder):
    """Make samples and statistics stage by stage; each stage reads the stored products of earlier ones."""
    roman, rubin, truth, stars = sky
    store, tables = Store(folder), {}

    def stored(product: TableProduct) -> TableProduct:
        UnitGraph.of(product, store).compute(scheduler="sync")
        return product.stored(store)

    for name, tables_of, bands, band in (("roman", roman, ROMAN, "H158"), ("rubin", rubin, RUBIN, "i")):
        limit = stored(limits(*tables_of, settings, band))
        tables[name] = stored(samples(*tables_of, limit, settings, bands, band))
    groups = []
    for prefix, shift in (("matches", {}), ("chance", {"rubin": SHIFT})):
        groups.append(matches(tables, {"roman": 0, "rubin": 1}, settings, REGION, store, prefix, shift))
        for product in vars(groups[-1]).values():
            stored(product)
    sharp = PairSample(table=tables["roman"], code=0, reference_band="H158", colour_band="F184")
    blended = PairSample(table=tables["rubin"], code=1, reference_band="i", colour_band="g" if "g" in RUBIN else "i")
    known = Samples(sharp=sharp, blended=blended, galaxies=truth, stars=stars)
    return tables, statistics(*groups, known, settings.linking_lengths)


CUT = MatchSettings(linking_lengths=(1.0, 0.5), limits={"H158": 25.0, "i": 25.0}, order=ORDER)


@pytest.fixture(scope="module")
def cut(sky, tmp_path_factory):
    return made(sky, CUT, tmp_path_factory.mktemp("cut"))


def test_clean_objects_are_unflagged_matched_and_bright(sky, cut, tmp_path):
    tables, _ = cut
    roman = tables["roman"].all_rows()
    assert len(roman) == 25 - 6 + 6 + 6
    dereddened = np.where(roman["H158_mag"] < 23, 22.0, 24.0)
    assert roman["H158_mag"].to_numpy() == pytest.approx(dereddened, abs=1e-4)
    everything, _ = made(sky, MatchSettings(sample="all", order=ORDER), tmp_path)
    assert len(everything["roman"].all_rows()) == len(roman) + 3


def test_blends_are_counted_and_those_of_two_true_objects_are_real(cut):
    _, found = cut
    kinds = np.bincount(np.arange(25) % 4)
    counts = matrix(found.blends.all_rows(), 1.0)
    assert counts.loc[1, 1] == kinds[0]
    assert counts.loc[2, 1] == kinds[1] + kinds[2]
    assert counts.loc[0, 1] == kinds[3]
    short = matrix(found.blends.all_rows(), 0.5)
    assert short.loc[1, 1] == 25 - kinds[3]
    assert short.loc[1, 0] == kinds[1] + kinds[2]
    table = found.unrecognised.all_rows()
    row = table[np.isclose(table["linking_length"], 1.0) & (table["rubin_objects"] > 0)].iloc[0]
    assert row["i_mag_low"] == 23.0
    assert row["rubin_objects"] == 25
    assert row["with_roman"] == 25 - kinds[3]
    assert row["blends"] == kinds[1] + kinds[2]
    # a galaxy in two pieces is not a blend of two galaxies
    assert row["real"] == kinds[1]
    assert row["alone"] == kinds[3]
    share = row["blends"] / 25
    assert row["fraction"] == pytest.approx(share)
    assert row["error"] == pytest.approx(np.sqrt(share * (1 - share) / 25))


def test_shifted_objects_have_no_chance_links(cut):
    """The shift of 13 arcsec is a little more than the spacing of the objects, so no pair is within an arcsecond."""
    _, found = cut
    chance = found.chance.all_rows()
    assert chance["rubin_objects"].sum() == 2 * 25
    assert chance["with_roman"].sum() == 0


def test_colours_and_sizes_of_blends_and_single_objects(cut):
    _, found = cut
    table = found.distributions.all_rows()
    table = table[np.isclose(table["linking_length"], 1.0)]
    kinds = np.bincount(np.arange(25) % 4)
    for quantity, single, blend in (("colour", 25.0 - 21.9, 24.5 - 21.9), ("size", 0.6, 0.8)):
        rows = table[table["quantity"] == quantity]
        at_single = rows[(rows["low"] <= single + 1e-3) & (rows["high"] > single + 1e-3)].iloc[0]
        assert at_single["singles"] == kinds[0]
        at_blend = rows[(rows["low"] <= blend + 1e-3) & (rows["high"] > blend + 1e-3)].iloc[0]
        assert at_blend["blends"] == kinds[1]


@pytest.mark.parametrize("middle", [24.2, 25.1])
def test_the_limit_is_where_counts_fall_to_four_fifths(middle):
    """A power law times a logistic completeness, whose magnitude of 80% is known."""
    edges = np.arange(16.0, 30.001, 0.1)
    magnitude = (edges[1:] + edges[:-1]) / 2
    complete = 1 / (1 + np.exp((magnitude - middle) / 0.25))
    expected = middle + 0.25 * np.log(1 / 0.8 - 1)
    counts = np.random.default_rng(4).poisson(3.0 * 10 ** (0.35 * (magnitude - 20) + 1.5) * complete)
    limit, slope = counts_limit(counts, edges)
    assert limit == pytest.approx(expected, abs=0.12)
    assert slope == pytest.approx(0.35, abs=0.03)


def test_too_few_objects_have_no_limit():
    edges = np.arange(16.0, 30.001, 0.1)
    limit, slope = counts_limit(np.random.default_rng(4).poisson(0.3, len(edges) - 1), edges)
    assert np.isinf(limit)
    assert np.isnan(slope)
