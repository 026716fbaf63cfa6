"""Synthetic photometry compared with GalSim's SED and Bandpass classes."""

from pathlib import Path

import astropy.units as u
import galsim
import galsim.roman
import numpy as np
import pytest
from dust_extinction.parameter_averages import CCM89, F19

from romandask.ingest.spectra import blackbodies, galaxy_templates, joined, read_folder
from romandask.kernels.universe.bandpasses import galsim_roman_bandpasses, roman_bandpass, rubin_bandpass
from romandask.kernels.universe.dust import ALL_DUST, INTERNAL_DUST, NO_DUST, Dust, no_dust, transmission
from romandask.kernels.universe.flux_table import flux_table
from romandask.kernels.universe.synthetic_photometry import band_photons, njy, node_photons
from romandask.model.spectra import LibrarySpectra, SpectrumLibrary, TophatSpectra

NAMES = ("CWW_E", "CWW_Sbc", "CWW_Scd", "CWW_Im")
AT_500 = galsim.Bandpass(galsim.LookupTable([499.95, 500.05], [1.0, 1.0], interpolant="linear"), "nm").withZeropoint(
    "AB"
)


@pytest.fixture(scope="module")
def library():
    return joined(galaxy_templates(NAMES, 1), blackbodies((3000, 6000)))


def galsim_rate(name, magnorm, redshift, bandpass, area, dust=None):
    sed = galsim.SED(f"{name}_ext_more.sed", "Ang", "flambda").withMagnitude(magnorm, AT_500).atRedshift(redshift)
    # GalSim integrates by trapezoids over the samples of spectrum and bandpass: without the dense samples of this table
    # its error is 5e-4 mag
    wave = np.linspace(300, 2200, 8000)
    table = galsim.LookupTable(wave, np.ones_like(wave) if dust is None else dust(wave), interpolant="linear")
    sed = sed * galsim.SED(table, "nm", "1")
    return sed.calculateFlux(bandpass) * area


def rates(library, rows, bandpass, internal=None, milky_way=None):
    sed, magnorm, redshift = (np.array(column) for column in zip(*rows, strict=True))
    dust_free = no_dust(len(rows))
    return node_photons(
        magnorm, LibrarySpectra(library, sed), redshift, internal or dust_free, milky_way or dust_free, bandpass
    )


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
    np.testing.assert_allclose(-2.5 * np.log10(measured / expected), 0, atol=1.5e-4)


def test_dust_acts_in_the_rest_frame_or_the_observed_frame(library):
    bandpass, reference = rubin_bandpass("g", 5, 3e5), galsim.Bandpass("LSST_g.dat", "nm")
    dust = Dust(np.full(1, 0.4), np.full(1, 2.7))
    milky_way = rates(library, [(2, 24.0, 0.8)], bandpass, milky_way=dust).sum()
    expected_milky_way = galsim_rate(
        NAMES[2], 24.0, 0.8, reference, 3e5, lambda wave: transmission("F19", wave, 0.4, 2.7)
    )
    assert -2.5 * np.log10(milky_way / expected_milky_way) == pytest.approx(0, abs=2e-4)
    internal = rates(library, [(2, 24.0, 0.8)], bandpass, internal=dust).sum()
    expected_internal = galsim_rate(
        NAMES[2], 24.0, 0.8, reference, 3e5, lambda wave: transmission("CCM", wave / 1.8, 0.4, 2.7)
    )
    assert -2.5 * np.log10(internal / expected_internal) == pytest.approx(0, abs=2e-4)
    assert internal < milky_way, "rest-frame dust acts at shorter wavelengths, where extinction is stronger"


def test_internal_dust_can_act_in_the_observed_frame_as_in_the_paper(library):
    bandpass, reference = rubin_bandpass("g", 5, 3e5), galsim.Bandpass("LSST_g.dat", "nm")
    dust = Dust(np.full(1, 0.4), np.full(1, 3.1))
    spectra = LibrarySpectra(library, np.array([1]))
    rate = node_photons(np.array([24.0]), spectra, np.array([0.8]), dust, no_dust(1), bandpass, "observed").sum()
    expected = galsim_rate(NAMES[1], 24.0, 0.8, reference, 3e5, lambda wave: transmission("CCM", wave, 0.4, 3.1))
    assert -2.5 * np.log10(rate / expected) == pytest.approx(0, abs=2e-4)


@pytest.mark.parametrize("law", ["CCM", "F19"])
@pytest.mark.parametrize("rv", [2.6, 3.1, 4.4])
def test_transmission_agrees_with_dust_extinction(law, rv):
    wave = np.array([150.0, 250.0, 440.0, 549.5, 900.0, 2100.0])
    model = {"CCM": CCM89, "F19": F19}[law](Rv=rv)
    np.testing.assert_allclose(transmission(law, wave, 0.7, rv), model.extinguish(1e3 / wave / u.um, Av=0.7), rtol=1e-6)


def test_too_small_rv_is_rejected_unless_av_is_zero(library):
    with pytest.raises(ValueError, match="R_V below"):
        rates(library, [(0, 24.0, 0.1)], rubin_bandpass("g", 5, 1.0), internal=Dust(np.ones(1), np.full(1, 0.5)))
    assert (
        rates(library, [(0, 24.0, 0.1)], rubin_bandpass("g", 5, 1.0), internal=Dust(np.zeros(1), np.zeros(1))).sum() > 0
    )


def test_band_photons_are_the_sums_of_node_photons_for_each_dust(library):
    random = np.random.default_rng(2)
    n = 50
    sed, z = random.integers(0, 4, n), random.uniform(0, 3, n)
    internal, milky_way = (Dust(random.uniform(0, 1.5, n), random.uniform(2.5, 5, n)) for _ in range(2))
    bandpasses = (rubin_bandpass("u", 5, 1.0), rubin_bandpass("i", 5, 1.0), roman_bandpass("F184", 5))
    spectra = LibrarySpectra(library, sed)
    measured = band_photons(np.full(n, 22.0), spectra, z, internal, milky_way, bandpasses)
    dusts = {
        ALL_DUST: (internal, milky_way),
        INTERNAL_DUST: (internal, no_dust(n)),
        NO_DUST: (no_dust(n), no_dust(n)),
    }
    for index, pair in dusts.items():
        for k, bandpass in enumerate(bandpasses):
            expected = node_photons(np.full(n, 22.0), spectra, z, *pair, bandpass).sum(axis=1)
            np.testing.assert_allclose(measured[index, :, k], expected, rtol=1e-9)


def test_flux_table_agrees_with_band_photons_to_1e_4_mag(library):
    random = np.random.default_rng(3)
    n = 3000
    four = SpectrumLibrary(library.names[:4], library.wave, library.photons[:4], library.limits[:4])
    bandpasses = (rubin_bandpass("u", 2, 1.0), rubin_bandpass("r", 2, 1.0), roman_bandpass("H158", 2))
    table = flux_table(four, bandpasses, "rest", 3.02)
    sed, z = random.integers(0, 4, n), random.uniform(0, 3.3, n)
    internal_av, mw_av, mag = random.uniform(0, 2.4, n), random.uniform(0, 0.25, n), random.uniform(18, 30, n)
    mag[7] = np.inf
    rv = np.full(n, 3.1)
    measured = table.photons(mag, sed, z, internal_av, mw_av)
    expected = band_photons(mag, LibrarySpectra(four, sed), z, Dust(internal_av, rv), Dust(mw_av, rv), bandpasses)
    lit = expected > 0
    np.testing.assert_allclose(2.5 * np.log10(measured[lit] / expected[lit]), 0, atol=1e-4)
    assert (measured[:, 7] == 0).all()


def test_a_flat_spectrum_has_the_ab_magnitude_magnorm():
    # f_lambda is constant within a bin: a flat f_nu needs many narrow bins
    edges = np.exp(np.linspace(np.log(200), np.log(2500), 600))
    flat = TophatSpectra(np.full((1, 599), 7.0), edges)
    dust_free = no_dust(1)
    for band in ("H158", "Y106"):
        bandpass = roman_bandpass(band, 5)
        rate = node_photons(np.full(1, 22.0), flat, np.zeros(1), dust_free, dust_free, bandpass).sum()
        assert 31.4 - 2.5 * np.log10(njy(rate, bandpass)) == pytest.approx(22.0, abs=2e-2)


def test_tophat_spectra_agree_with_galsim():
    random = np.random.default_rng(5)
    edges = np.array([100, 150, 250, 350, 450, 480, 510, 560, 640, 760, 900, 1200, 1700, 2100.0])
    values = random.uniform(1, 3, (3, len(edges) - 1))
    redshift = np.array([0.1, 0.5, 1.2])
    dust_free = no_dust(3)
    bandpass, reference = rubin_bandpass("r", 5, 1.0), galsim.Bandpass("LSST_r.dat", "nm")
    measured = node_photons(np.full(3, 20.0), TophatSpectra(values, edges), redshift, dust_free, dust_free, bandpass)
    flambda = values * (1 / edges[:-1] - 1 / edges[1:]) / np.diff(edges)
    speed = 2.99792458e17  # nm / s
    for row in range(3):
        wave = np.stack([edges[:-1], edges[1:] - 1e-6], 1).ravel()
        # f_lambda, erg/s/cm2/nm, of a source whose f_nu in the bin of 500 nm corresponds to magnorm 20
        absolute = np.repeat(flambda[row], 2) / values[row, 5] * 3.631e-20 * 10**-8 * speed
        sed = galsim.SED(galsim.LookupTable(wave, absolute, interpolant="linear"), "nm", "flambda")
        expected = sed.atRedshift(redshift[row]).calculateFlux(reference)
        assert measured[row].sum() == pytest.approx(expected, rel=2e-4)


def test_infinite_or_nan_magnorm_gives_no_photons(library):
    rows = [(0, np.inf, 0.5), (0, np.nan, 0.5), (0, 20.0, 0.5)]
    measured = rates(library, rows, roman_bandpass("H158", 5)).sum(axis=1)
    assert measured[0] == 0
    assert measured[1] == 0
    assert measured[2] > 0


def test_read_folder_gives_the_reason_for_each_spectrum_that_is_not_read(shared):
    good = "starSED/kurucz/km10_4750.fits_g00_4790.gz"
    library, reasons = read_folder(shared / "seds", [good, "starSED/kurucz/none.gz", "../opsim/small_opsim_9683.db"])
    assert library.names == (good,)
    assert "not in the library" in reasons["starSED/kurucz/none.gz"]
    assert "out of the library" in reasons["../opsim/small_opsim_9683.db"]
    assert Path(good).name.startswith("km10")
    assert np.interp(500.0, library.wave, library.photons[0]) == pytest.approx(1.0, abs=5e-3)
    assert library.limits[0, 0] < 100
