"""Parquet and FITS tables are read into the normal form through a column map."""

from __future__ import annotations

import gzip

import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from astropy.table import Table
from read_source import assert_same_rows, read_all

from romandask.ingest import table
from romandask.model.errors import UserError

MAP = {
    "id": "gid",
    "ra": "RA",
    "dec": "DEC",
    "redshift": "z",
    "disk_magnorm": "m",
    "size_disk_true": "hlr",
    "disk_sed": "spectrum",
    "MW_rv": 3.1,
    "lsst_flux_i": "fi",
}


def galaxies(count: int = 1000) -> pd.DataFrame:
    """Return a table of galaxies with the column names of `MAP`, two bad rows and a repeated identifier."""
    rng = np.random.default_rng(3)
    frame = pd.DataFrame(
        {
            "gid": np.arange(count) + 2**60,
            "RA": rng.uniform(0, 360, count),
            "DEC": rng.uniform(-90, 90, count),
            "z": rng.uniform(0, 2, count).astype(np.float32),
            "m": rng.uniform(20, 25, count),
            "hlr": 0.3,
            "spectrum": "b.sed  ",
            "fi": 1.0,
        }
    )
    frame.loc[3, "RA"] = np.nan
    frame.loc[700, "gid"] = frame.loc[2, "gid"]
    frame.loc[5, "hlr"] = -1
    return frame


def test_parquet_and_fits_tables_with_the_same_content_give_the_same_rows(tmp_path):
    frame = galaxies()
    pq.write_table(pa.Table.from_pandas(frame), tmp_path / "t.parquet", row_group_size=300)
    Table.from_pandas(frame).write(tmp_path / "t.fits")
    first = read_all(table.open_source(tmp_path / "t.parquet", MAP, "galaxy"))
    second = read_all(table.open_source(tmp_path / "t.fits", MAP, "galaxy"))
    assert_same_rows(first, second, "source")
    for name in ("t.parquet", "t.fits"):
        source = table.open_source(tmp_path / name, MAP, "galaxy", rows=64)
        assert_same_rows(read_all(source), first, "source")
        assert source.count() == 1000
    assert first["reason"][[2, 3, 5, 700]].tolist() == [
        "",
        "position is not a number",
        "size is negative or not a number",
        "",
    ]
    assert (first["reason"] != "").sum() == 2
    assert first["id"][0] == 2**60
    assert (first["disk_sed"] == "b.sed").all()
    assert first["size_minor_disk_true"][0] == first["size_disk_true"][0]
    assert (first[["MW_rv", "MW_av", "shear_1", "bulge_magnorm"]].iloc[0] == [3.1, 0, 0, np.inf]).all()
    (tmp_path / "folder/Norder=1").mkdir(parents=True)
    (tmp_path / "folder/_metadata.parquet").write_bytes(b"")
    for part in (0, 1):
        rows = frame.iloc[500 * part : 500 * (part + 1)]
        pq.write_table(pa.Table.from_pandas(rows), tmp_path / f"folder/Norder=1/Npix={part}.parquet")
    parts = table.open_source(tmp_path / "folder", MAP, "galaxy")
    assert len({batch.name for batch in parts.batches()}) == 2
    np.testing.assert_array_equal(read_all(parts)["ra"], first["ra"])


def test_stars_may_have_a_reference_magnitude_and_one_spectrum_for_all(tmp_path):
    frame = pd.DataFrame({"id": ["17", "18", "x"], "ra": [1.0, 2, 3], "dec": 0.0, "i": [20.0, np.nan, 21]})
    pq.write_table(pa.Table.from_pandas(frame), tmp_path / "s.parquet")
    columns = {"id": "id", "ra": "ra", "dec": "dec", "sed": "=blackbody_5800", "ref_mag": "i", "ref_band": "=lsst_i"}
    stars = read_all(table.open_source(tmp_path / "s.parquet", columns, "star"))
    assert stars["id"].tolist() == [17, 18, -1]
    assert stars["sed"].tolist() == ["blackbody_5800"] * 3
    assert stars["reason"].tolist() == ["", "magnorm is not a number", "id 'x' is not an integer"]


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"shear1": "m"}, r"names 'shear1', which romandask does not have: meant 'shear_1'\?"),
        ({"redshift": None}, r"of a galaxy lacks redshift \(found gid, RA"),
        ({"disk_magnorm": None}, "lacks one of bulge_magnorm, disk_magnorm, knots_magnorm"),
        ({"disk_sed": None, "size_disk_true": None}, "lacks size_disk_true; disk_sed"),
        ({"knots_magnorm": "m"}, "lacks n_knots"),
        ({"ra": "Ra"}, r"column 'Ra' \(for ra\) is missing \(found .*\); meant 'RA'\?"),
        ({"ra": "spectrum"}, r"column 'spectrum' \(for ra\) holds text: expected number"),
        ({"disk_sed": "m"}, r"column 'm' \(for disk_sed\) holds number: expected text"),
        ({"disk_sed": 3}, "gives disk_sed as 3: expected a name after ="),
        ({"ra": "=x"}, "gives ra as '=x': expected a number"),
    ],
)
def test_opening_a_table_reports_mistakes_in_the_column_map(tmp_path, change, message):
    pq.write_table(pa.Table.from_pandas(galaxies(10)), tmp_path / "t.parquet")
    columns = {name: value for name, value in (MAP | change).items() if value is not None}
    with pytest.raises(UserError, match=message):
        table.open_source(tmp_path / "t.parquet", columns, "galaxy")


def test_opening_reports_files_that_are_not_complete_tables(tmp_path):
    Table.from_pandas(galaxies()).write(tmp_path / "t.fits")
    complete = (tmp_path / "t.fits").read_bytes()
    (tmp_path / "t.fits").write_bytes(complete[: len(complete) // 2])
    with pytest.raises(UserError, match=r"t\.fits: not a complete FITS file"):
        table.open_source(tmp_path / "t.fits", MAP, "galaxy")
    (tmp_path / "t.fits.gz").write_bytes(gzip.compress(complete))
    with pytest.raises(UserError, match=r"neither a Parquet nor a FITS file .*: unpack it"):
        table.open_source(tmp_path / "t.fits.gz", MAP, "galaxy")
    with pytest.raises(UserError, match="no such file or folder"):
        table.open_source(tmp_path / "none", MAP, "galaxy")
    (tmp_path / "empty").mkdir()
    with pytest.raises(UserError, match=r"holds no \.parquet file"):
        table.open_source(tmp_path / "empty", MAP, "galaxy")
    with pytest.raises(UserError, match="kind 'quasar' is not known"):
        table.open_source(tmp_path, MAP, "quasar")
