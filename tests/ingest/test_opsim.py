"""OpSim databases of every form: names of filters, texts, dates, holes, and dithered places."""

import sqlite3
import warnings

import numpy as np
import pandas as pd
import pytest

from romandask.ingest import opsim
from romandask.ingest.dithers import families
from romandask.instruments.rubin.site_sky import parallactic_angle
from romandask.model.errors import UserError

DATA = {
    "observationId": [7, 8, 9],
    "filter": ["g", "r", "y"],
    "observationStartMJD": [60980.1, 60980.2, 60980.3],
    "visitExposureTime": [30.0, 30.0, 29.2],
    "fieldRA": [53.0, 359.0, 0.5],
    "fieldDec": [-40.0, -30.0, -20.0],
    "rotSkyPos": [10.0, 20.0, 30.0],
    "seeingFwhm500": [0.7, 0.6, 0.8],
    "airmass": [1.0, 1.1, 1.2],
    "skyBrightness": [20.5, 21.5, 19.5],
}


def write(path, **changed) -> None:
    """Write a database of three visits, with some columns changed or added."""
    content = {name: pd.Series(values, dtype=object) for name, values in (DATA | changed).items()}
    with sqlite3.connect(path) as connection:
        pd.DataFrame(content).to_sql("observations", connection, index=False)
    connection.close()


@pytest.mark.parametrize(
    "names",
    [["LSST_g", "LSST_r", "LSST_y"], ["lsst_g", "lsst_r", "lsst_y"], ["G", "R", "Y"], ["g_6", "r_57", "y_10"]],
)
def test_filters_by_other_names(tmp_path, names):
    write(tmp_path / "o.db", filter=names)
    assert list(opsim.read(tmp_path / "o.db")["band"]) == ["g", "r", "y"]


def test_the_sample_with_prefixed_bands(shared):
    visits = opsim.read(shared / "odd_inputs/opsim/lsstband.db", bands=["g", "r", "i"])
    assert visits["band"].value_counts().to_dict() == {"g": 6, "r": 6, "i": 6}


def test_identifiers_as_text(shared, tmp_path):
    write(
        tmp_path / "o.db",
        observationId=["2025110100007", "2025110100008", "2025110100009"],
        fieldRA=["53", "359", "0.5"],
    )
    visits = opsim.read(tmp_path / "o.db")
    assert list(visits["visit"]) == [2025110100007, 2025110100008, 2025110100009]
    assert list(visits["ra"]) == [53.0, 359.0, 0.5]
    with pytest.raises(
        UserError, match=r"strid\.db: table observations, column 'observationId', row 0: found '2024_0'"
    ):
        opsim.read(shared / "odd_inputs/opsim/strid.db")


def test_rows_of_bands_that_are_not_used_may_hold_anything(tmp_path):
    write(
        tmp_path / "o.db", airmass=[1.0, None, np.nan], observationId=[7, "none", None], fieldDec=[-40.0, -300.0, "x"]
    )
    visits = opsim.read(tmp_path / "o.db", bands=["g"])
    assert list(visits["visit"]) == [7]
    assert visits["visit"].dtype == np.int64
    with pytest.raises(UserError, match=r"column 'observationId', row 1: found 'none', expected a number"):
        opsim.read(tmp_path / "o.db", bands=["g", "r"])


def test_a_missing_value_names_its_row(tmp_path):
    write(tmp_path / "o.db", airmass=[1.0, None, np.nan])
    with pytest.raises(UserError, match=r"column 'airmass' has 1 missing values in 2 rows, the first in row 1"):
        opsim.read(tmp_path / "o.db", bands=["g", "r"])


def test_julian_dates_become_mjd(tmp_path):
    write(tmp_path / "o.db", observationStartMJD=[2_460_980.6, 2_460_980.7, 2_460_980.8])
    np.testing.assert_allclose(opsim.read(tmp_path / "o.db")["mjd"], DATA["observationStartMJD"], atol=1e-8)


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"filter": ["g", "r", "x"]}, r"column 'filter' has 'x' in 1 of 3 rows, the first in row 2.*LSST_g"),
        ({"filter": ["g", "r", "r"]}, r"column 'filter' has no rows of y, but of r \(2 rows\), g \(1 rows\)"),
        ({"observationStartMJD": [60980.1, 2_460_980.7, 60980.3]}, r"column 'observationStartMJD' mixes Julian dates"),
        ({"observationStartMJD": [1.0, 2.0, 3.0]}, r"column 'observationStartMJD' has 1 in row 0"),
        ({"rotSkyPos": [1.0, np.inf, 2.0]}, r"column 'rotSkyPos', row 1: found inf"),
    ],
)
def test_errors_name_column_and_row(tmp_path, changed, message):
    write(tmp_path / "o.db", **changed)
    with pytest.raises(UserError, match=message):
        opsim.read(tmp_path / "o.db", bands=["g", "r", "y"])


def test_a_database_without_visits(tmp_path):
    with sqlite3.connect(tmp_path / "o.db") as connection:
        pd.DataFrame(DATA).iloc[:0].to_sql("observations", connection, index=False)
    connection.close()
    with pytest.raises(UserError, match="table observations has no rows"):
        opsim.read(tmp_path / "o.db")


def test_families_of_dithers_are_found_by_their_names():
    names = (
        "fieldRA moonRA moonDec randomDitherRa descDitheredRA descDitheredDec descDitheredRotTelPos ditheredRA "
        "ditheredDec randomDitherFieldPerVisitRa randomDitherFieldPerVisitDec fieldRA_dithered fieldDec_dithered "
        "dithered_ra dithered_dec ditheredRotSkyPos"
    )
    found = families(names.split())
    assert list(found) == ["descDithered", "dithered", "randomDitherFieldPerVisit", "fielddithered"]
    assert found["descDithered"] == {
        "ra": "descDitheredRA",
        "dec": "descDitheredDec",
        "rotator": "descDitheredRotTelPos",
    }
    assert found["dithered"] == {"ra": "ditheredRA", "dec": "ditheredDec", "pa": "ditheredRotSkyPos"}


@pytest.mark.parametrize("unit", ["degrees", "radians"])
def test_dithered_places_are_those_of_the_setting(tmp_path, unit):
    ra, dec, rotator = np.array([53.5, 0.5, 359.5]), np.array([-40.2, -29.5, -20.0]), np.array([5.0, -50.0, 80.0])
    convert = np.radians if unit == "radians" else np.asarray
    dithers = {
        "aDitheredRA": convert(ra),
        "aDitheredDec": convert(dec),
        "bDitherRA": convert(ra),
        "bDitherDec": convert(dec),
    }
    write(tmp_path / "o.db", **dithers, aDitheredRotTelPos=convert(rotator))
    with pytest.warns(UserWarning, match=r"at fieldRA, fieldDec, .* aDithered, bDither; .*rubin\.pointings\.dither"):
        plain = opsim.read(tmp_path / "o.db")
    assert list(plain["ra"]) == DATA["fieldRA"]
    pd.testing.assert_frame_equal(opsim.read(tmp_path / "o.db", dither="field"), plain)
    first = opsim.read(tmp_path / "o.db", dither="aDithered")
    np.testing.assert_allclose(first[["ra", "dec"]].T, [ra, dec])
    zenith = parallactic_angle(ra, dec, first["mjd"])
    np.testing.assert_allclose(first["pa"], (rotator - zenith) % 360)
    second = opsim.read(tmp_path / "o.db", dither="bDither")
    np.testing.assert_allclose(second[["ra", "dec"]].T, [ra, dec])
    assert list(second["pa"]) == DATA["rotSkyPos"]
    with pytest.raises(UserError, match=r"no columns cDitherRA and cDitherDec: choose aDithered or bDither or field"):
        opsim.read(tmp_path / "o.db", dither="cDither")


def test_the_sample_with_dithered_places(shared):
    path = shared / "odd_inputs/opsim/dithered.db"
    with pytest.warns(UserWarning, match="descDithered"):
        plain = opsim.read(path)
    moved = opsim.read(path, dither="descDithered")
    connection = sqlite3.connect(path)
    expected = pd.read_sql_query("SELECT * FROM observations ORDER BY observationStartMJD", connection)
    connection.close()
    np.testing.assert_allclose(moved["ra"], np.degrees(expected["descDitheredRA"]))
    np.testing.assert_allclose(moved["dec"], np.degrees(expected["descDitheredDec"]))
    # OpSim's own angles: rotSkyPos = rotTelPos - paraAngle
    turned = moved["pa"] - plain["pa"] - (np.degrees(expected["descDitheredRotTelPos"]) - expected["rotTelPos"])
    assert np.abs((turned + 180) % 360 - 180).max() < 1


def test_dithers_that_are_no_places_or_the_same_places_are_not_offered(tmp_path):
    write(
        tmp_path / "o.db",
        xDitherRA=[99.0] * 3,
        xDitherDec=[99.0] * 3,
        yDitherRA=DATA["fieldRA"],
        yDitherDec=DATA["fieldDec"],
    )
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        opsim.read(tmp_path / "o.db")
    with pytest.raises(UserError, match=r"'xDitherRA' and 'xDitherDec' are not near the fields"):
        opsim.read(tmp_path / "o.db", dither="xDither")
