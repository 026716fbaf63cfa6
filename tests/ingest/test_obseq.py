"""Observing sequences of every form that a FITS table can have."""

import numpy as np
import pytest
from astropy.io import fits

from romandask.ingest import obseq
from romandask.model.errors import UserError

DATA = {
    "date": [62000.5, 62000.6, 62000.7],
    "exptime": [140.25, 140.25, 107.5],
    "ra": [53.03, 359.5, 0.5],
    "dec": [-40.007, 1.0, 2.0],
    "pa": [0.0, 120.0, 240.0],
}
FILTERS = ["H158", "F184", "Y106"]
BANDS = ("Y106", "H158", "F184")


def columns(filters=FILTERS, **changed) -> list[fits.Column]:
    """Return the columns of a sequence; a changed one is an array, or a dictionary of the arguments of its column."""
    made = []
    for name, values in DATA.items():
        value = changed.get(name, values)
        given = value if isinstance(value, dict) else {"array": np.asarray(value)}
        made.append(fits.Column(**{"name": name, "format": "D", "array": np.asarray(values)} | given))
    return [*made, fits.Column("filter", "8A", array=np.array(filters))]


def write(path, made, *before) -> None:
    fits.HDUList([fits.PrimaryHDU(), *before, fits.BinTableHDU.from_columns(made)]).writeto(path)


def check(visits) -> None:
    """Check that the visits are those of DATA."""
    assert list(visits["band"]) == FILTERS
    for name, ours in zip(DATA, ("mjd", "exptime", "ra", "dec", "pa"), strict=True):
        np.testing.assert_allclose(visits[ours], DATA[name], rtol=1e-12, atol=1e-12, err_msg=name)


@pytest.mark.parametrize("name", ["fnames", "lowerf", "second", "nan"])
def test_samples_with_other_names_places_and_holes_have_the_four_bands(shared, name):
    visits = obseq.read(shared / f"odd_inputs/obseq/{name}.fits", bands=("Y106", "J129", "H158", "F184"))
    assert visits["band"][:12].value_counts().to_dict() == {"Y106": 3, "J129": 3, "H158": 3, "F184": 3}
    assert list(visits["visit"]) == list(range(len(visits)))
    assert visits[["mjd", "ra", "dec"]][:12].notna().all(axis=None)


def test_a_sample_without_rows_says_so(shared):
    with pytest.raises(UserError, match=r"norows\.fits: the table in HDU 1 has no rows"):
        obseq.read(shared / "odd_inputs/obseq/norows.fits")


def test_rows_of_filters_that_the_survey_does_not_use_may_hold_anything(tmp_path):
    write(tmp_path / "o.fits", columns(["H158", "PRISM", "K213"], ra=[53.0, np.nan, 1e9], date=[62000.0, 0.0, np.inf]))
    visits = obseq.read(tmp_path / "o.fits", bands=["H158"])
    assert list(visits["band"]) == ["H158", "PRISM", "K213"]
    with pytest.raises(UserError, match=r"column 'date', row 2: found inf"):
        obseq.read(tmp_path / "o.fits", bands=["H158", "K213"])


def test_the_table_is_found_by_its_columns(tmp_path):
    other = fits.BinTableHDU.from_columns([fits.Column("ra", "D", array=np.ones(2))])
    image = fits.ImageHDU(np.zeros((4, 4)))
    empty = fits.BinTableHDU(fits.BinTableHDU.from_columns(columns()).data[:0])
    write(tmp_path / "o.fits", columns(), other, image, empty)
    check(obseq.read(tmp_path / "o.fits"))
    write(tmp_path / "two.fits", columns(), fits.BinTableHDU.from_columns(columns()))
    with pytest.raises(UserError, match=r"two\.fits: HDUs 1, 2 each hold a table of visits"):
        obseq.read(tmp_path / "two.fits")
    write(tmp_path / "none.fits", columns()[:4], other)
    with pytest.raises(UserError, match=r"column 'pa' is missing \(found date, dec, exptime, ra in HDU 2\)"):
        obseq.read(tmp_path / "none.fits")
    fits.HDUList([fits.PrimaryHDU(), image]).writeto(tmp_path / "image.fits")
    with pytest.raises(UserError, match=r"image\.fits: no HDU holds a table"):
        obseq.read(tmp_path / "image.fits")


def test_names_of_columns_in_any_case_and_columns_of_one_value(tmp_path):
    changed = {name: {"name": name.upper(), "format": "1D"} for name in DATA}
    write(tmp_path / "o.fits", columns(**changed))
    check(obseq.read(tmp_path / "o.fits"))
    changed = {
        name: {"array": np.reshape(values, (3, 1)), "format": "D", "dim": "(1)"} for name, values in DATA.items()
    }
    write(tmp_path / "v.fits", columns(**changed))
    check(obseq.read(tmp_path / "v.fits"))
    write(tmp_path / "w.fits", columns(ra={"format": "2D", "array": np.ones((3, 2))}))
    with pytest.raises(UserError, match=r"w\.fits: column 'ra' has 2 values in each row, expected one"):
        obseq.read(tmp_path / "w.fits")


def test_units_of_the_file_are_converted(tmp_path):
    changed = {
        "date": {"unit": "MJD"},
        "exptime": {"unit": "min", "array": np.array(DATA["exptime"]) / 60},
        "ra": {"unit": "hourangle", "array": np.array(DATA["ra"]) / 15},
        "dec": {"unit": "rad", "array": np.radians(DATA["dec"])},
        "pa": {"unit": "Degrees"},
    }
    write(tmp_path / "o.fits", columns(**changed))
    check(obseq.read(tmp_path / "o.fits"))


@pytest.mark.parametrize(("name", "unit"), [("ra", "s"), ("ra", "furlong"), ("exptime", "deg"), ("date", "m")])
def test_units_that_cannot_be_converted_are_refused(tmp_path, name, unit):
    write(tmp_path / "o.fits", columns(**{name: {"unit": unit}}))
    with pytest.raises(UserError, match=rf"o\.fits: column '{name}' is in '{unit}' \(TUNIT\)"):
        obseq.read(tmp_path / "o.fits")


def test_julian_dates_become_mjd(tmp_path):
    write(tmp_path / "o.fits", columns(date=np.array(DATA["date"]) + 2_400_000.5))
    np.testing.assert_allclose(obseq.read(tmp_path / "o.fits")["mjd"], DATA["date"], atol=1e-8)
    write(tmp_path / "mixed.fits", columns(date=[2_462_000.5, 62000.5, 62000.5]))
    with pytest.raises(UserError, match=r"column 'date' mixes Julian dates \(2462000\.500 in row 0\)"):
        obseq.read(tmp_path / "mixed.fits")


def test_right_ascensions_are_brought_to_0_to_360(tmp_path):
    write(tmp_path / "o.fits", columns(ra=[-10.0, 370.0, 360.0]))
    np.testing.assert_allclose(obseq.read(tmp_path / "o.fits")["ra"], [350.0, 10.0, 0.0])


def test_numbers_in_texts_and_in_integers_are_read(tmp_path):
    write(tmp_path / "o.fits", columns(ra={"format": "8A", "array": np.array([" 53.03", "359.5", "0.5"])}))
    check(obseq.read(tmp_path / "o.fits"))
    write(tmp_path / "i.fits", columns(pa={"format": "J", "array": np.array([0, 120, 240]), "null": -99}))
    check(obseq.read(tmp_path / "i.fits"))


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        (
            {"ra": {"format": "8A", "array": np.array(["03:32:12"] * 3)}},
            r"column 'ra', row 0: found '03:32:12', expected",
        ),
        (
            {"pa": {"format": "J", "array": np.array([0, -99, 2]), "null": -99}},
            r"column 'pa' has 1 missing .* in row 1",
        ),
        ({"dec": [1.0, 2.0, np.nan]}, r"column 'dec', row 2: found nan"),
        ({"pa": [1.0, np.inf, 2.0]}, r"column 'pa', row 1: found inf"),
        ({"exptime": {"format": "L", "array": np.array([True] * 3)}}, r"column 'exptime' holds .* \(type bool\)"),
        ({"filters": ["H158", "", "F184"]}, r"column 'filter', row 1: the name of the filter is empty"),
        (
            {"filters": ["H158", "F-184", "Y106"]},
            r"column 'filter' has 'F-184' in 1 of 3 rows, the first in row 1.*F158",
        ),
        (
            {"filters": ["H158", "K213", "F106"]},
            r"column 'filter' has no rows of F184, but of H158 \(1 rows\), K213 \(1 rows\), F106",
        ),
    ],
)
def test_errors_name_column_and_row(tmp_path, changed, message):
    write(tmp_path / "o.fits", columns(**changed))
    with pytest.raises(UserError, match=rf"o\.fits: {message}"):
        obseq.read(tmp_path / "o.fits", bands=BANDS)
