"""Photon rates against GalSim's own SED and Bandpass arithmetic."""

from pathlib import Path

import galsim
import galsim.roman
import numpy as np
import pytest

from romandask.formats.spectra import read_folder, templates
from romandask.kernels.bandpasses import galsim_roman_bandpasses, roman_bandpass, rubin_bandpass
from romandask.kernels.photometry import njy, node_photons, transmission
from romandask.model.spectra import LibrarySpectra, TophatSpectra

NAMES = ("CWW_E", "CWW_Sbc", "CWW_Scd", "CWW_Im")
AT_500 = galsim.Bandpass(galsim.LookupTable([499.95, 500.05], [1.0, 1.0], interpolant="linear"), "nm").withZeropoint(
    "AB"
)


@pytest.fixture(scope="module")
def library():
    return templates(NAMES, (3000, 6000))


def galsim_rate(name, magnorm, redshift, bandpass, area, dust=None):
    sed = galsim.SED(f"{name}_ext_more.sed", "Ang", "flambda").withMagnitude(magnorm, AT_500).atRedshift(redshift)
    if dust is not None:
        wave = np.linspace(300, 2200, 4000)
        table = galsim.LookupTable(wave, dust(wave), interpolant="linear")
        sed = sed * galsim.SED(table, "nm", "1")
    return sed.calculateFlux(bandpass) * area


def rates(library, rows, bandpass, **dust):
    sed, magnorm, redshift = (np.array(column) for column in zip(*rows, strict=True))
    none = np.zeros(len(rows))
    values = {"internal_av": none, "internal_rv": none, "mw_av": none, "mw_rv": none} | dust
    return node_photons(magnorm, LibrarySpectra(library, sed), redshift, *values.values(), bandpass)


@pytest.mark.parametrize("band", ["Y106", "H158", "F184", "u", "r", "y"])
def test_rates_agree_with_galsim(library, band):
    if len(band) > 1:
        bandpass, area = roman_bandpass(band, 5), galsim.roman.collecting_area
        reference = galsim_roman_bandpasses()[band]
    else:
        bandpass, area, reference = rubin_bandpass(band, 5, 3e5), 3e5, galsim.Bandpass(f"LSST_{band}.dat", "nm")
    rows = [(sed, 24.0 + sed, redshift) for sed in range(4) for redshift in (0.05, 0.7, 1.9)]
    rows = [row for row in rows if not (row[0] == 0 and row[2] > 1 and band == "u")]
    measured = rates(library, rows, bandpass).sum(axis=1)
    expected = [galsim_rate(NAMES[sed], magnorm, z, reference, area) for sed, magnorm, z in rows]
    np.testing.assert_allclose(-2.5 * np.log10(measured / expected), 0, atol=1e-3)


def test_dust_acts_in_its_own_frame(library):
    bandpass = rubin_bandpass("g", 5, 3e5)
    reference = galsim.Bandpass("LSST_g.dat", "nm")
    one = np.ones(1)
    milky_way = rates(library, [(2, 24.0, 0.8)], bandpass, mw_av=0.4 * one, mw_rv=3.1 * one).sum()
    expected = galsim_rate(
        NAMES[2],
        24.0,
        0.8,
        reference,
        3e5,
        lambda wave: transmission("F19", wave[None], np.array([0.4]), np.array([3.1]))[0],
    )
    assert -2.5 * np.log10(milky_way / expected) == pytest.approx(0, abs=3e-3)
    internal = rates(library, [(2, 24.0, 0.8)], bandpass, internal_av=0.4 * one, internal_rv=3.1 * one).sum()
    expected = galsim_rate(
        NAMES[2], 24.0, 0.8, reference, 3e5,
        lambda wave: transmission("CCM", wave[None] / 1.8, np.array([0.4]), np.array([3.1]))[0],
    )  # fmt: skip
    assert -2.5 * np.log10(internal / expected) == pytest.approx(0, abs=3e-3)
    assert internal < milky_way, "rest-frame dust is seen at shorter wavelengths, where it takes more"


def test_dust_laws_have_their_known_values():
    """A(V) = 1 at V; CCM at B gives R_V = 3.1 within a per cent or two of 1.32 (Cardelli et al. 1989)."""
    one, rv = np.ones(1), np.full(1, 3.1)
    for law in ("CCM", "F19"):
        assert -2.5 * np.log10(transmission(law, np.array([[549.5]]), one, rv))[0, 0] == pytest.approx(1.0, abs=0.02)
        assert -2.5 * np.log10(transmission(law, np.array([[440.0]]), one, rv))[0, 0] == pytest.approx(1.32, abs=0.03)
    with pytest.raises(ValueError, match="R_V below"):
        transmission("CCM", np.array([[500.0]]), one, 0.5 * one)


def test_a_flat_spectrum_has_its_ab_magnitude():
    # bins hold f_lambda constant: many narrow ones make a flat f_nu
    edges = np.exp(np.linspace(np.log(200), np.log(2500), 600))
    flat = TophatSpectra(np.full((1, 599), 7.0), edges)
    none = np.zeros(1)
    for band in ("H158", "Y106"):
        bandpass = roman_bandpass(band, 5)
        rate = node_photons(np.full(1, 22.0), flat, none, none, none, none, none, bandpass).sum()
        assert 31.4 - 2.5 * np.log10(njy(rate, bandpass)) == pytest.approx(22.0, abs=2e-2)


def test_tophat_spectra_agree_with_galsim():
    random = np.random.default_rng(5)
    edges = np.array([100, 150, 250, 350, 450, 480, 510, 560, 640, 760, 900, 1200, 1700, 2100.0])
    values = random.uniform(1, 3, (3, len(edges) - 1))
    redshift = np.array([0.1, 0.5, 1.2])
    none = np.zeros(3)
    bandpass, reference = rubin_bandpass("r", 5, 1.0), galsim.Bandpass("LSST_r.dat", "nm")
    measured = node_photons(np.full(3, 20.0), TophatSpectra(values, edges), redshift, none, none, none, none, bandpass)
    flambda = values * (1 / edges[:-1] - 1 / edges[1:]) / np.diff(edges)
    speed = 2.99792458e17  # nm / s
    for row in range(3):
        wave = np.stack([edges[:-1], edges[1:] - 1e-6], 1).ravel()
        # f_lambda in erg/s/cm2/nm of a source whose f_nu in the bin of 500 nm is that of magnorm 20
        absolute = np.repeat(flambda[row], 2) / values[row, 5] * 3.631e-20 * 10**-8 * speed
        sed = galsim.SED(galsim.LookupTable(wave, absolute, interpolant="linear"), "nm", "flambda")
        expected = sed.atRedshift(redshift[row]).calculateFlux(reference)
        assert measured[row].sum() == pytest.approx(expected, rel=2e-3)


def test_no_light_is_no_photons(library):
    rows = [(0, np.inf, 0.5), (0, np.nan, 0.5), (0, 20.0, 0.5)]
    found = rates(library, rows, roman_bandpass("H158", 5)).sum(axis=1)
    assert found[0] == 0
    assert found[1] == 0
    assert found[2] > 0


def test_spectra_from_a_folder_give_reasons_for_what_is_missing(shared):
    good = "starSED/kurucz/km10_4750.fits_g00_4790.gz"
    library, reasons = read_folder(shared / "seds", [good, "starSED/kurucz/none.gz", "../opsim/small_opsim_9683.db"])
    assert library.names == (good,)
    assert "not in the library" in reasons["starSED/kurucz/none.gz"]
    assert "out of the library" in reasons["../opsim/small_opsim_9683.db"]
    assert Path(good).name.startswith("km10")
    at_500 = library.evaluate(np.array([0]), np.array([[500.0]]))
    assert at_500[0, 0] == pytest.approx(1.0, abs=5e-3)
