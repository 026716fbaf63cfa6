"""Visit tables in Parquet, read as OpSim databases."""

import numpy as np
import pandas as pd
import pytest

from romandask.ingest import opsim
from romandask.instruments.rubin.depth import effective_fwhm
from romandask.instruments.rubin.site_sky import sky_brightness
from romandask.model.errors import UserError

AIRMASS = np.array([1.0, 1.1, 1.3])
SEEING = np.array([0.7, 0.6, 0.9])
BANDS = ["g", "r", "y"]
MEASURED = [0.822 * effective_fwhm(band, s, x) + 0.052 for band, s, x in zip(BANDS, SEEING, AIRMASS, strict=True)]
DATA = {
    "visitId": [2025110100007, 2025110100008, 2025110100009],
    "physical_filter": ["g_6", "r_57", "y_10"],
    "band": BANDS,
    "ra": [53.0, 359.0, 0.5],
    "dec": [-40.0, -30.0, -20.0],
    "skyRotation": [10.0, 20.0, 30.0],
    "airmass": AIRMASS,
    "expTime": [30.0, 30.0, 30.0],
    "obsStartMJD": [60980.1, 60980.2, 60980.3],
    "seeing": MEASURED,
    "skyBrightness": [20.5, 21.5, 19.5],
}


def write(path, *skip, **changed) -> None:
    pd.DataFrame(DATA | changed).drop(columns=list(skip)).to_parquet(path)


def test_a_visit_table_gives_the_visits_of_an_opsim_database(tmp_path):
    write(tmp_path / "v.parquet")
    visits = opsim.read(tmp_path / "v.parquet", bands=BANDS)
    assert list(visits.columns) == list(opsim.COLUMNS)
    assert list(visits["visit"]) == DATA["visitId"]
    assert list(visits["band"]) == BANDS
    names = {"mjd": "obsStartMJD", "exptime": "expTime", "ra": "ra", "dec": "dec", "pa": "skyRotation"}
    for ours, theirs in (names | {"airmass": "airmass", "sky_brightness": "skyBrightness"}).items():
        np.testing.assert_array_equal(visits[ours], DATA[theirs])
    np.testing.assert_allclose(visits["seeing"], SEEING)


def test_quantities_of_other_names_are_derived(tmp_path):
    distance = np.degrees(np.arccos(1 / AIRMASS))
    middle = np.array(DATA["obsStartMJD"]) + 15 / 86400
    write(
        tmp_path / "v.pq",
        "airmass",
        "obsStartMJD",
        "band",
        "skyBrightness",
        zenithDistance=distance,
        expMidptMJD=middle,
    )
    with pytest.warns(UserWarning, match="the brightness of the sky is modelled"):
        visits = opsim.read(tmp_path / "v.pq")
    np.testing.assert_allclose(visits["airmass"], AIRMASS)
    np.testing.assert_allclose(visits["mjd"], DATA["obsStartMJD"], atol=1e-9)
    np.testing.assert_allclose(visits["seeing"], SEEING)
    expected = [sky_brightness(row.band, row.ra, row.dec, row.mjd) for row in visits.itertuples()]
    np.testing.assert_allclose(visits["sky_brightness"], expected)


def test_opsim_names_in_parquet_and_holes_in_other_bands(tmp_path):
    table = pd.DataFrame(DATA).assign(seeingFwhm500=SEEING, band=["LSST_g", "r", "y"])
    table.loc[1, ["ra", "airmass"]] = np.nan
    table["visitId"] = pd.array([DATA["visitId"][0], None, DATA["visitId"][2]], dtype="Int64")
    table.to_parquet(tmp_path / "v.parquet")
    visits = opsim.read(tmp_path / "v.parquet", bands=["g", "y"])
    assert list(visits["visit"]) == [DATA["visitId"][0], DATA["visitId"][2]]
    assert list(visits["seeing"]) == [0.7, 0.9]
    with pytest.raises(
        UserError, match=r"v\.parquet: column 'visitId' has 1 missing values in 3 rows, the first in row 1"
    ):
        opsim.read(tmp_path / "v.parquet")


@pytest.mark.parametrize(
    ("skip", "changed", "message"),
    [
        (["seeing"], {}, r"v\.parquet lacks column 'seeingFwhm500' .* or 'seeing' \(found visitId"),
        ([], {"detector": [1, 2, 3]}, r"v\.parquet: has a column 'detector'.*table of visits"),
        (
            [],
            {"seeing": [0.7, 0.2, 0.7]},
            r"column 'seeing', row 1: the PSF is narrower than the telescope's alone",
        ),
        ([], {"airmass": [1.0, 0.5, 1.0]}, r"column 'airmass' has 0\.5 in row 1"),
    ],
)
def test_errors_name_the_column(tmp_path, skip, changed, message):
    write(tmp_path / "v.parquet", *skip, **changed)
    with pytest.raises(UserError, match=message):
        opsim.read(tmp_path / "v.parquet")


def test_a_table_that_is_cut_or_has_no_rows(tmp_path):
    write(tmp_path / "v.parquet")
    content = (tmp_path / "v.parquet").read_bytes()
    (tmp_path / "cut.parquet").write_bytes(content[:-100])
    with pytest.raises(UserError, match=r"cut\.parquet: not a complete Parquet file"):
        opsim.read(tmp_path / "cut.parquet")
    pd.DataFrame(DATA).iloc[:0].to_parquet(tmp_path / "none.parquet")
    with pytest.raises(UserError, match=r"none\.parquet has no rows"):
        opsim.read(tmp_path / "none.parquet")
