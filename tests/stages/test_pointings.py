"""Pointings: real observing sequences, generated plans, and the selection of exposures that touch tiles."""

import shutil
import sqlite3
from pathlib import Path

import numpy as np
import pytest
from astropy.io import fits

from romandask.ingest import obseq, opsim
from romandask.instruments.exposure import exposure_of, footprint
from romandask.instruments.roman.roman import Roman, RomanPointings, RomanSettings
from romandask.instruments.roman.sun import best_roll
from romandask.instruments.rubin.focal_plane import detector_centres
from romandask.instruments.rubin.rubin import Rubin, RubinPointings, RubinSettings
from romandask.model.errors import UserError
from romandask.model.settings import CoaddSettings
from romandask.model.sky import Region, touching_pairs
from romandask.stages.pointings import corners_of, pointings

REGION = Region(53.0151, 53.0484, -40.0133, -40.0006)
GRID = CoaddSettings(pixels=1000, overlap=100).grid()
TILES = GRID.covering(REGION)


def test_the_real_obseq_reads(shared):
    visits = obseq.read(shared / "roman_obseq/Roman_WAS_obseq_11_1_23.fits")
    assert len(visits) == 16956
    assert set(visits["band"]) == {"Y106", "J129", "H158", "F184", "K213", "W146"}
    assert (visits["visit"] == np.arange(16956)).all()
    assert visits["ra"].between(0, 360).all()


def test_rolls_of_the_real_obseq_lie_within_fifteen_degrees_of_the_best(shared):
    visits = obseq.read(shared / "roman_obseq/Roman_WAS_obseq_11_1_23.fits").iloc[::300]
    off = [(row.pa - best_roll(row.ra, row.dec, row.mjd) + 180) % 360 - 180 for row in visits.itertuples()]
    assert np.abs(off).max() < 15.5


def test_exposures_from_the_real_obseq_cover_a_region(shared):
    visits = obseq.read(shared / "roman_obseq/Roman_WAS_obseq_11_1_23.fits")
    busy = visits[visits["band"] == "H158"].iloc[400]
    region = Region(busy.ra - 0.01, busy.ra + 0.01, busy.dec - 0.005, busy.dec + 0.005)
    roman = Roman(RomanSettings(bands=("H158",)))
    settings = RomanPointings(source="obseq", path="roman_obseq/Roman_WAS_obseq_11_1_23.fits")
    table = pointings(roman, settings, shared, region, GRID.covering(region), GRID.side, 1)
    assert len(table) >= 4
    assert set(table["visit"]) <= set(visits["visit"])
    assert (
        touching_pairs(corners_of(table), np.stack([t.corners(GRID.side) for t in GRID.covering(region)]))[0].max()
        == len(table) - 1
    )


@pytest.mark.parametrize("keep", [100, 3000, 300_000])
def test_a_truncated_obseq_is_one_clear_error(shared, tmp_path, keep):
    path = tmp_path / "cut.fits"
    path.write_bytes((shared / "roman_obseq/Roman_WAS_obseq_11_1_23.fits").read_bytes()[:keep])
    with pytest.raises(UserError, match=rf"cut\.fits: not a complete FITS table \({keep} bytes"):
        obseq.read(path)


def test_an_obseq_with_a_missing_column_or_a_nan(tmp_path):
    columns = {name: [1.0, 2.0] for name in ("exptime", "ra", "dec", "pa")} | {"date": [62000.0, 62001.0]}
    path = tmp_path / "o.fits"

    def write(skip=None, **changed):
        made = [
            fits.Column(name, "D", array=changed.get(name, values)) for name, values in columns.items() if name != skip
        ]
        made += [fits.Column("filter", "4A", array=["H158", "F184"])]
        fits.BinTableHDU.from_columns(made).writeto(path, overwrite=True)

    write(skip="pa")
    with pytest.raises(UserError, match=r"o\.fits: column 'pa' is missing"):
        obseq.read(path)
    write(dec=[1.0, np.nan])
    with pytest.raises(UserError, match=r"column 'dec', row 1: found nan"):
        obseq.read(path)
    write()
    assert list(obseq.read(path)["band"]) == ["H158", "F184"]
    with pytest.raises(UserError, match="no such file"):
        obseq.read(tmp_path / "none.fits")


def test_the_real_opsim_reads_and_its_faults_are_named(shared, tmp_path):
    visits = opsim.read(shared / "opsim/small_opsim_9683.db")
    assert len(visits) == 73
    assert visits["band"].value_counts().to_dict() == {"i": 20, "r": 16, "z": 15, "y": 13, "g": 7, "u": 2}
    assert visits["mjd"].is_monotonic_increasing
    (tmp_path / "text.db").write_text("not a database, though long enough to be looked at" * 40)
    with pytest.raises(UserError, match=r"text\.db: not a readable SQLite database"):
        opsim.read(tmp_path / "text.db")
    sqlite3.connect(tmp_path / "empty.db").close()
    with pytest.raises(UserError, match="no table 'observations'"):
        opsim.read(tmp_path / "empty.db")
    shutil.copy(shared / "opsim/small_opsim_9683.db", tmp_path / "less.db")
    (tmp_path / "less.db").chmod(0o644)
    with sqlite3.connect(tmp_path / "less.db") as connection:
        connection.execute("ALTER TABLE observations DROP COLUMN airmass")
    connection.close()
    with pytest.raises(UserError, match="lacks column 'airmass'"):
        opsim.read(tmp_path / "less.db")


def test_the_plan_covers_the_region_and_keeps_to_the_sun():
    roman = Roman(RomanSettings())
    visits = roman.plan(REGION, 0)
    for row in visits.iloc[::40].itertuples():
        assert abs((row.pa - best_roll(row.ra, row.dec, row.mjd) + 180) % 360 - 180) < 15
    table = pointings(roman, RomanPointings(), Path("."), REGION, TILES, GRID.side, 0)
    points = np.array(
        [[[a, d], [a + 1e-6, d], [a, d + 1e-6]] for a in (53.02, 53.03, 53.045) for d in (-40.012, -40.002)]
    )
    for band in roman.bands:
        found, _ = touching_pairs(points, corners_of(table[table["band"] == band]))
        assert (np.bincount(found, minlength=len(points)) >= 3).all()
    turned = np.abs((table["pa"].max() - table["pa"].min() + 180) % 360 - 180)
    assert turned > 100, "two passes, one leading and one trailing"


def test_a_footprint_of_the_table_is_that_of_the_header():
    roman = Roman(RomanSettings(bands=("H158",)))
    table = pointings(roman, RomanPointings(), Path("."), REGION, TILES, GRID.side, 0)
    for row in range(0, len(table), 3):
        expected = footprint(roman.header(exposure_of(table.iloc[row])), roman.shape)
        np.testing.assert_allclose(corners_of(table)[row], expected, atol=1e-9)


def test_the_cadence_visits_a_point_as_often_as_asked():
    rubin = Rubin(RubinSettings())
    table = pointings(rubin, RubinPointings(), Path("."), REGION, TILES, GRID.side, 3)
    point = np.array([[[53.03, -40.005], [53.03001, -40.005], [53.03, -40.00499]]])
    for band, expected in RubinPointings().visits.items():
        count = len(touching_pairs(point, corners_of(table[table["band"] == band]))[0])
        assert count == pytest.approx(expected, abs=5 * np.sqrt(expected))
    assert 0.5 < table["seeing"].median() < 0.75
    assert len(detector_centres()) == 189


def test_a_region_without_pointings_is_refused(shared):
    roman = Roman(RomanSettings(bands=("H158",)))
    settings = RomanPointings(source="obseq", path="roman_obseq/Roman_WAS_obseq_11_1_23.fits")
    with pytest.raises(UserError, match=r"no exposure of roman in H158 touches the region around ra 53\.0"):
        pointings(roman, settings, shared, REGION, TILES, GRID.side, 0)
