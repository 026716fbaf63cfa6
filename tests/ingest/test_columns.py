"""What a file says about its columns holds: missing values, units, shapes, and which of its tables is meant."""

from __future__ import annotations

import astropy.units as u
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from astropy.io import fits
from astropy.table import MaskedColumn, QTable, Table
from read_source import read_all

from romandask.ingest import table
from romandask.ingest.identifiers import MISSING
from romandask.ingest.units import factors
from romandask.model.errors import UserError

STAR = {"id": "id", "ra": "ra", "dec": "dec", "magnorm": "mag", "sed": "=blackbody_5800"}


def star_table(**changes) -> Table:
    """Return a table of three stars with some columns replaced."""
    content = {"id": [7, 8, 9], "ra": [10.0, 11.0, 12.0], "dec": [0.0, 1.0, 2.0], "mag": [20.0, 21.0, 22.0], **changes}
    return Table({name: value for name, value in content.items() if value is not None})


def read(path, columns=STAR, kind="star"):
    return read_all(table.open_source(path, columns, kind))


@pytest.mark.parametrize("suffix", ["fits", "parquet"])
def test_masked_values_are_missing_and_never_numbers(tmp_path, suffix):
    content = star_table(
        id=MaskedColumn(np.array([0, 8, 9], np.int64), mask=[True, False, False]),
        mag=MaskedColumn(np.array([20, 999999, 22], np.int32), mask=[False, True, False]),
        ra=MaskedColumn([10.0, 11.0, 99.0], mask=[False, False, True]),
    )
    content.write(tmp_path / f"t.{suffix}")
    frame = read(tmp_path / f"t.{suffix}")
    assert frame["reason"].tolist() == [MISSING, "magnorm is not a number", "position is not a number"]
    assert frame["id"].tolist() == [-1, 8, 9]


def test_the_null_value_of_an_unsigned_column_is_one_as_stored(tmp_path):
    column = fits.Column("id", "J", bzero=2**31, null=0, array=np.array([2**31, 8, 2**31 + 1], np.uint32))
    others = [fits.Column(name, "D", array=[1.0, 2.0, 3.0]) for name in ("ra", "dec", "mag")]
    fits.BinTableHDU.from_columns([column, *others]).writeto(tmp_path / "t.fits")
    assert read(tmp_path / "t.fits")["id"].tolist() == [-1, 8, 2**31 + 1]


@pytest.mark.parametrize("suffix", ["fits", "parquet"])
def test_units_are_converted(tmp_path, suffix):
    content = QTable(
        {
            "id": [7, 8],
            "ra": np.array([1.0, 2.0]) * u.hourangle if suffix == "parquet" else np.radians([15.0, 30.0]) * u.rad,
            "dec": np.array([60.0, 90.0]) * u.arcmin,
            "z": [0.5, 0.6],
            "m": [20.0, 21.0] * u.mag,
            "hlr": np.array([500.0, 600.0]) * u.mas,
        }
    )
    content.write(tmp_path / f"t.{suffix}")
    columns = {"id": "id", "ra": "ra", "dec": "dec", "redshift": "z", "disk_magnorm": "m", "size_disk_true": "hlr"}
    frame = read(tmp_path / f"t.{suffix}", {**columns, "disk_sed": "=flat"}, "galaxy")
    np.testing.assert_allclose(frame["ra"], [15, 30], rtol=1e-12)
    np.testing.assert_allclose(frame["dec"], [1, 1.5], rtol=1e-12)
    np.testing.assert_allclose(frame["size_disk_true"], [0.5, 0.6], rtol=1e-12)
    np.testing.assert_allclose(frame["size_minor_disk_true"], [0.5, 0.6], rtol=1e-12)


def test_the_unit_of_a_parquet_field_is_converted(tmp_path):
    fields = [pa.field("id", pa.int64()), pa.field("ra", pa.float64(), metadata={"unit": "radians"})]
    fields += [pa.field("dec", pa.float64(), metadata={"unit": "DEG"}), pa.field("mag", pa.float64())]
    values = [pa.array([1]), pa.array([np.pi]), pa.array([-3.0]), pa.array([20.0])]
    pq.write_table(pa.Table.from_arrays(values, schema=pa.schema(fields)), tmp_path / "t.parquet")
    frame = read(tmp_path / "t.parquet")
    assert frame[["ra", "dec"]].to_numpy().ravel().tolist() == [180.0, -3.0]


@pytest.mark.parametrize("unit", ["1/s/cm2", "ph / (s cm2)", "s-1 cm-2", "ph/s/cm2", ""])
def test_spellings_of_the_unit_of_fluxes(tmp_path, unit):
    assert factors(tmp_path, {"lsst_flux_u": "f"}, {"f": unit}) == {}
    assert factors(tmp_path, {"lsst_flux_u": "f", "magnorm": "m"}, {"f": "1/s/m2", "m": "mag(AB)"}) == {
        "lsst_flux_u": pytest.approx(1e-4)
    }


@pytest.mark.parametrize(
    ("name", "unit", "words"),
    [
        ("ra", "Jy", r"column 'ra' \(for ra\) has the unit 'Jy', expected deg or a unit that"),
        ("ra", "h", "expected deg"),
        ("dec", "furlong", "has the unit 'furlong', expected deg"),
        ("mag", "nJy", "expected mag"),
    ],
)
def test_a_unit_of_another_quantity_is_refused(tmp_path, name, unit, words):
    content = star_table()
    content.write(tmp_path / "t.fits")
    with fits.open(tmp_path / "t.fits", mode="update") as hdus:
        hdus[1].header[f"TUNIT{content.colnames.index(name) + 1}"] = unit
    with pytest.raises(UserError, match=words):
        read(tmp_path / "t.fits")


def test_columns_of_one_value_a_row_are_read_and_other_shapes_refused(tmp_path):
    content = star_table(id=np.array([[7], [8], [9]]), ra=np.array([[10.0], [11.0], [12.0]]))
    content["name"] = np.array([["a"], ["b "], ["longer"]])
    content.write(tmp_path / "t.fits")
    frame = read(tmp_path / "t.fits", STAR | {"sed": "name"})
    assert frame[["id", "ra", "sed"]].to_numpy().tolist() == [[7, 10, "a"], [8, 11, "b"], [9, 12, "longer"]]
    lists = pa.array([[10.0], [11.0], None], pa.list_(pa.float64(), 1))
    pq.write_table(
        pa.table({**{n: star_table()[n] for n in ("id", "dec", "mag")}, "ra": lists}), tmp_path / "t.parquet"
    )
    assert read(tmp_path / "t.parquet")["reason"].tolist() == ["", "", "position is not a number"]
    for number, (values, words) in enumerate(
        [
            (np.zeros((3, 2)), "holds arrays of 2 numbers: expected number"),
            (np.array([True, False, True]), "holds truth values"),
            (np.array([1j, 2, 3]), "holds complex numbers"),
            (np.array(["10", "11", "x"]), "holds text: expected number"),
            (np.array([["10", "11"]] * 3), "holds arrays of texts: expected number"),
        ]
    ):
        star_table(ra=values).write(tmp_path / f"{number}.fits")
        with pytest.raises(UserError, match=rf"{number}\.fits: column 'ra' \(for ra\) {words}"):
            read(tmp_path / f"{number}.fits")
    pq.write_table(pa.table({**dict(star_table().columns), "ra": [[1.0, 2.0]] * 3}), tmp_path / "l.parquet")
    with pytest.raises(UserError, match="column 'ra' .* holds lists: expected number"):
        read(tmp_path / "l.parquet")


def test_the_table_that_has_the_columns_is_read(tmp_path):
    empty, other = fits.PrimaryHDU(), fits.table_to_hdu(Table({"a": [1]}))
    objects = fits.table_to_hdu(star_table())
    fits.HDUList([empty, other, objects]).writeto(tmp_path / "second.fits")
    assert read(tmp_path / "second.fits")["id"].tolist() == [7, 8, 9]
    objects.name = "LDAC_OBJECTS"
    header = fits.table_to_hdu(star_table(id=[1, 2, 3]))
    header.name = "LDAC_IMHEAD"
    fits.HDUList([empty, header, objects]).writeto(tmp_path / "ldac.fits")
    assert read(tmp_path / "ldac.fits")["id"].tolist() == [7, 8, 9]
    fits.HDUList([empty, header, fits.table_to_hdu(star_table())]).writeto(tmp_path / "two.fits")
    with pytest.raises(
        UserError, match=r"two\.fits: holds 2 tables with the columns of the map \(HDU 1 LDAC_IMHEAD, HDU 2"
    ):
        read(tmp_path / "two.fits")
    fits.HDUList([empty, other, fits.table_to_hdu(star_table(dec=None))]).writeto(tmp_path / "none.fits")
    with pytest.raises(UserError, match=r"column 'dec' \(for dec\) is missing \(found id, ra, mag\)"):
        read(tmp_path / "none.fits")
    fits.HDUList([empty, fits.ImageHDU(np.zeros((2, 2)))]).writeto(tmp_path / "image.fits")
    with pytest.raises(UserError, match=r"holds no binary table \(found PrimaryHDU, ImageHDU\)"):
        read(tmp_path / "image.fits")


def test_an_infinite_flux_of_the_source_is_quarantined(tmp_path):
    star_table(f=[1.0, np.inf, np.nan]).write(tmp_path / "t.fits")
    frame = read(tmp_path / "t.fits", STAR | {"lsst_flux_r": "f"})
    assert frame["reason"].tolist() == ["", "a flux of the source is infinite", ""]


def test_right_ascensions_are_brought_into_a_circle_and_impossible_positions_quarantined(tmp_path):
    positions = {-30.0: 330.0, 360.0: 0.0, 0.0: 0.0, -1e-20: 0.0, 400.0: 400.0}
    content = Table({"id": np.arange(5), "ra": list(positions), "dec": np.zeros(5), "mag": np.full(5, 20.0)})
    content["dec"][1] = -90.5
    content.write(tmp_path / "t.fits")
    frame = read(tmp_path / "t.fits")
    assert frame["ra"].tolist() == list(positions.values())
    assert frame["reason"].tolist() == [
        "",
        "declination is beyond -90 to 90 degrees",
        "",
        "",
        "right ascension is beyond -360 to 360 degrees",
    ]


def test_a_hats_folder_is_its_partitions_alone(tmp_path):
    def write(path, ids):
        path.parent.mkdir(parents=True, exist_ok=True)
        star_table(id=ids).write(path)

    write(tmp_path / "hats/catalog/dataset/Norder=1/Dir=0/Npix=3.parquet", [1, 2, 3])
    write(tmp_path / "hats/catalog/dataset/Norder=2/Dir=0/Npix=4/part0.parquet", [4, 5, 6])
    write(tmp_path / "hats/catalog/dataset/data_thumbnail.parquet", [1, 4, 5])
    write(tmp_path / "hats/margin/dataset/Norder=1/Dir=0/Npix=4.parquet", [1, 2, 3])
    (tmp_path / "hats/catalog/hats.properties").write_text("#HATS\ndataproduct_type=object\n")
    (tmp_path / "hats/margin/hats.properties").write_text("dataproduct_type = margin\n")
    for name in ("hats", "hats/catalog"):
        assert read(tmp_path / name)["id"].tolist() == [1, 2, 3, 4, 5, 6]
    (tmp_path / "hats/collection.properties").write_text("obs_collection=x\nhats_primary_table_url=catalog\n")
    assert read(tmp_path / "hats")["id"].tolist() == [1, 2, 3, 4, 5, 6]
    with pytest.raises(UserError, match="is the margin of a HATS catalog, which repeats its rows: name the catalog"):
        read(tmp_path / "hats/margin")
    (tmp_path / "hats/collection.properties").write_text("hats_primary_table_url=other\n")
    with pytest.raises(UserError, match="names the catalog 'other', which is not there"):
        read(tmp_path / "hats")


@pytest.mark.parametrize(
    ("name", "rows", "reasons"),
    [
        ("gaia_str.parquet", 12, []),
        ("tnull.fits", 12, [MISSING] * 2),
        ("masked.fits", 12, [MISSING] * 2 + ["magnorm is not a number"]),
        ("maskedint.fits", 12, ["magnorm is not a number"]),
        ("rad.fits", 12, []),
        ("vector1.fits", 12, []),
        ("ldac.fits", 12, []),
        ("hats", 12, []),
    ],
)
def test_odd_samples_are_read(shared, name, rows, reasons):
    frame = read(shared / "odd_inputs/table" / name)
    assert len(frame) == rows
    assert sorted(frame.loc[frame["reason"] != "", "reason"]) == reasons
    assert frame["ra"].between(150, 150.2).all()
