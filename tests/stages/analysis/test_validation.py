"""Depths and residuals of simulated objects with known noise, and Milky Way extinction in a band."""

import galsim
import numpy as np
import pandas as pd
import pytest
from astropy import units as u
from dust_extinction.parameter_averages import F19

from romandask.instruments.roman.roman import Roman, RomanSettings
from romandask.kernels.universe.dust import Dust, extinction
from romandask.report import figures
from romandask.stages.analysis.validation import colours_of, depths, residuals, with_truth

SIGMA = 20.0
"""Rms noise of every flux, nJy."""
OFFSET = 0.1
"""Magnitudes by which measured fluxes are too bright."""


@pytest.fixture(scope="module")
def joined() -> pd.DataFrame:
    random = np.random.default_rng(1)
    n = 40_000
    true = 10 ** (0.4 * (31.4 - random.uniform(20, 28, n)))
    frame = {"flags": (random.random(n) < 0.25).astype(int), "star": np.zeros(n, bool)}
    for band in ("Y106", "H158"):
        frame[f"flux_{band}"] = true
        for flux in ("kronFlux", "psfFlux"):
            frame[f"{band}_{flux}"] = true * 10 ** (0.4 * OFFSET) + random.normal(0, SIGMA, n)
            frame[f"{band}_{flux}Err"] = np.full(n, SIGMA)
    return pd.DataFrame(frame)


def test_depth_is_the_magnitude_of_five_times_the_noise(joined):
    assert depths(joined, ("H158",))["H158"] == pytest.approx(31.4 - 2.5 * np.log10(5 * SIGMA), abs=1e-6)
    bright = joined[joined["H158_psfFlux"] > 1000]
    assert np.isnan(depths(bright, ("H158",))["H158"])


def test_residuals_are_the_offset_and_the_noise_that_went_in(joined):
    table = residuals(joined, ("Y106", "H158"))
    assert table["objects"].sum() == 2 * len(joined)
    assert table["flagged"].to_numpy() == pytest.approx(0.25, abs=0.05)
    for _, row in table[table["magnitude"] < 27.5].iterrows():
        flux = 10 ** (0.4 * (31.4 - row["magnitude"]))
        assert row["bias"] == pytest.approx(-OFFSET, abs=0.01 + 0.12 * SIGMA / flux)
        # half a bin of magnitude changes a flux by a quarter
        assert row["scatter"] == pytest.approx(1.0857 * SIGMA / flux / 10 ** (0.4 * OFFSET), rel=0.3)
        assert row["pull"] == pytest.approx(flux * (10 ** (0.4 * OFFSET) - 1) / SIGMA, rel=0.1, abs=0.1)
    # the pulls of faint objects are those of the noise; an offset in magnitude widens those of bright objects
    faint = table[table["magnitude"] > 25]
    assert faint["pull_scatter"].to_numpy() == pytest.approx(1, abs=0.07)


def test_fluxes_that_are_not_positive_count_as_faint():
    frame = pd.DataFrame(
        {
            "flags": 0,
            "flux_H158": np.full(5, 100.0),
            "H158_kronFlux": [-5.0, -1.0, 0.0, 100.0, 100.0],
            "H158_kronFluxErr": np.full(5, 50.0),
        }
    )
    row = residuals(frame, ("H158",)).iloc[0]
    assert np.isnan(row["bias"])
    assert row["pull"] == pytest.approx(-2)


def test_objects_are_joined_with_their_own_counterparts_only():
    objects = pd.DataFrame({"objectId": [1, 2, 3, 4], "H158_kronFlux": [1.0, 2.0, 3.0, 4.0]})
    # a galaxy and a star may have the same number
    matched = pd.DataFrame(
        {
            "objectId": [1, 2, 3, 4],
            "truth_id": [7, 7, -1, 8],
            "star": [False, True, False, False],
            "candidates": 1,
        }
    )
    summary = pd.DataFrame(
        {
            "truth_id": [7, 7, 9],
            "star": [False, True, False],
            "ra": 0.0,
            "dec": 0.0,
            "redshift": [0.5, 0.0, 1.0],
            "objectId": [1, 2, 0],
            "separation": 0.1,
            "objects": 1,
            "flux_H158": [10.0, 20.0, 30.0],
        }
    )
    found = with_truth(objects, matched, summary)
    assert found[["objectId", "flux_H158"]].to_numpy().tolist() == [[1, 10], [2, 20]]


def test_colours_are_those_of_objects_bright_in_both_bands(joined):
    true, measured = colours_of(joined, "Y106", "H158")
    assert len(true) == len(measured) < len(joined)
    assert np.abs(true).max() < 1e-9
    assert np.median(measured) == pytest.approx(0, abs=0.005)


def test_pictures_of_a_survey_without_objects_are_drawn(joined):
    none = joined.iloc[:0]
    for frame in (joined, none):
        assert figures.residuals({"roman": residuals(frame, ("Y106", "H158"))})[:4] == b"\x89PNG"
        assert figures.colour_histograms({"Y106 - H158": colours_of(frame, "Y106", "H158")})[:4] == b"\x89PNG"


@pytest.mark.parametrize("band", ["Y106", "F184"])
def test_extinction_is_that_of_f19_through_galsims_bandpass(band):
    roman = Roman(RomanSettings(bands=(band,)))
    av, rv = np.array([0.0, 0.3, 2.0]), np.array([3.1, 3.1, 4.0])
    found = extinction(roman.bandpass(band), Dust(av, rv))
    bandpass = galsim.roman.getBandpasses()[band]
    wave = np.linspace(bandpass.blue_limit, bandpass.red_limit, 4000)
    photons = bandpass(wave) / wave
    for k in range(3):
        left = 10 ** (-0.4 * av[k] * F19(Rv=rv[k])((1e3 / wave) / u.micron))
        assert found[k] == pytest.approx(-2.5 * np.log10((photons * left).sum() / photons.sum()), abs=2e-4)
    assert abs(found[0]) < 1e-12
