"""Names of filters, in files and in settings."""

import pytest

from romandask.instruments.roman.bands import BANDS as ROMAN_BANDS
from romandask.instruments.roman.roman import RomanPointings, RomanSettings
from romandask.instruments.rubin.bands import BANDS as RUBIN_BANDS
from romandask.instruments.rubin.rubin import RubinPointings, RubinSettings
from romandask.model.filters import ROMAN, RUBIN, any_band
from romandask.model.settings import DifferenceSettings, MatchSettings

OFFICIAL = "F062 F087 F106 F129 F146 F158 F184 F213".split()
OURS = "R062 Z087 Y106 J129 W146 H158 F184 K213".split()


@pytest.mark.parametrize(("official", "ours"), list(zip(OFFICIAL, OURS, strict=True)))
def test_every_name_of_a_roman_filter_is_its_band(official, ours):
    for name in (official, ours, ours[0]):
        for written in (name, name.lower(), f" {name} ", f"WFI_{name}", f"roman-{name.lower()}"):
            assert ROMAN.find(written) == ours, written


@pytest.mark.parametrize("band", "ugrizy")
def test_every_name_of_a_rubin_filter_is_its_band(band):
    upper = band.upper()
    names = [band, upper, f"LSST_{band}", f"lsst_{band}", f"lsst{band}", f"LSST-{upper}", f"{band}_57", f"{band}_06"]
    for name in [*names, f"{band}_sim_1.4", f"LSSTCam_{band}", f"lsst2023-{band}", f"ComCam_{band}", f"{band}-band"]:
        assert RUBIN.find(name) == band, name


def test_names_that_are_no_band():
    for name in ("H159", "F1580", "", "X", "LSST", "g", "F15"):
        assert ROMAN.find(name) is None, name
    for name in ("LSST", "x", "57", "_57", "F158", "gg", "lsst_", "r2"):
        assert RUBIN.find(name) is None, name
    assert all(ROMAN.is_other(name) for name in ("PRISM", "Grism_0thOrder", "dark"))
    assert not any(names.is_other(name) for names in (ROMAN, RUBIN) for name in ("H158", "x", ""))


def test_the_bands_of_the_instruments_are_names_of_themselves():
    assert [ROMAN.find(band) for band in ROMAN_BANDS] == list(ROMAN_BANDS)
    assert [RUBIN.find(band) for band in RUBIN_BANDS] == list(RUBIN_BANDS)
    assert {name: band.optical_element for name, band in ROMAN_BANDS.items()} == {
        ours: official for official, ours in zip(OFFICIAL, OURS, strict=True) if ours in ROMAN_BANDS
    }
    assert RUBIN.find("VIS", ["VIS"]) == "VIS"


def test_a_name_of_two_telescopes_stays_where_either_may_be_meant():
    assert any_band("F106") == "Y106"
    assert any_band("LSST_y") == "y"
    assert any_band("y") == "y"
    assert any_band("VIS") == "VIS"
    assert any_band("Y") == "Y"


def test_settings_take_every_name_and_keep_the_bands():
    roman = RomanSettings(bands=("F106", "h158"), pointings=RomanPointings(dithers={"F106": (1,), "H": (2,)}))
    assert roman.bands == ("Y106", "H158")
    assert roman.pointings.dithers == {"Y106": (1,), "H158": (2,)}
    rubin = RubinSettings(bands=("LSST_g", "Y"), pointings=RubinPointings(visits={"g_57": 3, "Y": 4}))
    assert rubin.bands == ("g", "y")
    assert rubin.pointings.visits == {"g": 3, "y": 4}
    assert MatchSettings(limits={"F158": 25, "LSST_i": 24}).limits == {"H158": 25, "i": 24}
    differences = DifferenceSettings(template="F106", science="LSST_y")
    assert (differences.template, differences.science) == ("Y106", "y")


@pytest.mark.parametrize(
    ("make", "message"),
    [
        (lambda: RomanSettings(bands=("H158", "F158")), "H158 is there twice"),
        (lambda: RomanSettings(bands=("H159",)), r"'Y106'.* or 'F184' \(found 'H159'\)"),
        (lambda: RubinSettings(bands=("F158",)), r"'u'.* or 'y' \(found 'F158'\)"),
        (lambda: RomanPointings(dithers={"H159": (1,)}), "found 'H159'"),
        (lambda: RubinPointings(visits={"g": 1, "LSST_g": 2}), "g is there twice, the second time as 'LSST_g'"),
        (lambda: MatchSettings(limits={"H158": 25, "h158": 2}), "H158 is there twice"),
    ],
)
def test_unknown_and_repeated_names_in_settings_are_refused(make, message):
    with pytest.raises(ValueError, match=message):
        make()
