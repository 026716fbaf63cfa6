"""The generated universe: matter and lensing against theory, counts, pairs, colours and sizes against surveys."""

from functools import lru_cache

import healpy
import numpy as np
import pyccl
import pytest
from scipy.spatial import cKDTree

from romandask.ingest.spectra import galaxy_templates
from romandask.kernels.universe import galaxies, galaxy_rows, milky_way_stars
from romandask.kernels.universe.bandpasses import roman_bandpass, rubin_bandpass
from romandask.kernels.universe.flux_table import flux_table
from romandask.kernels.universe.population import (
    GALAXY_COUNTS,
    mean_satellites,
    poisson,
    population,
    redshift_within,
    richness,
)
from romandask.kernels.universe.structure import bias, shell_spectra, shells, structure
from romandask.model.cosmology import Cosmology
from romandask.model.sky import Region, offset_positions, unit_vectors

NSIDE = 128
REGION = Region(50.0, 50.8, -0.4, 0.4)
DENSITY = 597.2
COSMO = Cosmology()


@pytest.fixture(scope="module")
def sky():
    """All pixels of a low-resolution universe."""
    return structure(NSIDE, np.arange(12 * NSIDE**2), 3)


@pytest.fixture(scope="module")
def ccl():
    return pyccl.Cosmology(
        Omega_c=COSMO.omega_m - COSMO.omega_b,
        Omega_b=COSMO.omega_b,
        h=COSMO.h,
        n_s=COSMO.n_s,
        sigma8=COSMO.sigma_8,
        transfer_function="eisenstein_hu",
        matter_power_spectrum="halofit",
    )


@pytest.fixture(scope="module")
def patch(sky):
    """Galaxies of 0.64 square degrees with their photometry, as rows of the truth catalog."""
    cells = galaxies.with_surroundings(REGION.cells(galaxies.CELL_ORDER))
    drawn = galaxies.draw(cells, 5, DENSITY, sky)
    drawn = drawn.take(REGION.contains(drawn.ra, drawn.dec))
    return galaxy_rows.galaxy_rows(drawn, sky, table(), ("g", "r", "i", "z", "H158"), (0.0, 0.0), 0.03)


@lru_cache(maxsize=1)
def table():
    bandpasses = (*(rubin_bandpass(band, 2, 1.0) for band in "griz"), roman_bandpass("H158", 2))
    return flux_table(galaxy_templates(galaxies.TEMPLATES, galaxies.STEPS), bandpasses, "rest", 3.02)


def magnitudes(frame, band):
    return 31.4 - 2.5 * np.log10(frame[f"flux_{band}"])


def binned(spectrum, low=20, high=180, width=40):
    ell = np.arange(len(spectrum))
    weight = (2 * ell + 1) * spectrum
    edges = np.arange(low, high + 1, width)
    return np.array([weight[a:b].sum() / (2 * ell[a:b] + 1).sum() for a, b in zip(edges[:-1], edges[1:], strict=True)])


def cross(first, second=None):
    """Angular power of maps in nested order."""
    maps = [healpy.reorder(np.asarray(m, float), n2r=True) for m in (first, first if second is None else second)]
    return healpy.anafast(*maps, lmax=2 * NSIDE, iter=1)


def test_background_and_growth_are_those_of_an_independent_code(ccl):
    z = np.array([0.1, 0.5, 1.0, 2.0, 3.0])
    np.testing.assert_allclose(COSMO.comoving_distance(z), pyccl.comoving_radial_distance(ccl, 1 / (1 + z)), rtol=2e-3)
    np.testing.assert_allclose(COSMO.growth(z), pyccl.growth_factor(ccl, 1 / (1 + z)), rtol=3e-3)


def test_shells_have_their_angular_power_and_galaxies_theirs(sky):
    every = shells()
    for shell in (6, 15, 28):
        theory = shell_spectra(2 * NSIDE)[shell]
        np.testing.assert_allclose(binned(cross(sky.fields["delta"][shell])), binned(theory), rtol=0.06)
        b = float(bias(every.planes[shell]))
        # of the lognormal field to the power b the correlation is (1 + xi)^(b^2) - 1: b^2 xi where xi is small
        measured = binned(cross(sky.fields["galaxies"][shell])) / binned(theory)
        np.testing.assert_allclose(measured, b**2, rtol=0.15)
        assert sky.fields["galaxies"][shell].min() >= 0
        assert sky.fields["galaxies"][shell].mean() == pytest.approx(1, abs=1e-3)


def test_convergence_and_shear_of_matter_agree_with_theory(sky, ccl):
    for shell in (12, 20, 30):
        source = shells().planes[shell]
        z = np.linspace(max(source - 0.02, 1e-3), source + 0.02, 201)
        tracer = pyccl.WeakLensingTracer(ccl, dndz=(z, np.exp(-0.5 * ((z - source) / 0.004) ** 2)))
        theory = pyccl.angular_cl(ccl, tracer, tracer, np.arange(2 * NSIDE + 1))
        # shells of 200 Mpc and one sky: a tenth
        np.testing.assert_allclose(binned(cross(sky.fields["convergence"][shell])), binned(theory), rtol=0.12)


def test_shear_is_that_of_the_convergence_and_has_no_curl(sky):
    shell = 20
    # HEALPix's axes are south and east
    q, u = (healpy.reorder(np.asarray(sky.fields[name][shell], float), n2r=True) for name in ("shear_1", "shear_2"))
    e, b = healpy.map2alm_spin([-q, u], 2, lmax=2 * NSIDE)
    kappa = healpy.map2alm(
        healpy.reorder(np.asarray(sky.fields["convergence"][shell], float), n2r=True), lmax=2 * NSIDE, iter=1
    )
    ell = np.arange(2 * NSIDE + 1)
    factor = (ell + 2) * np.maximum(ell - 1, 0) / np.maximum(ell * (ell + 1), 1)
    np.testing.assert_allclose(binned(healpy.alm2cl(e)), binned(healpy.alm2cl(kappa) * factor), rtol=0.02)
    assert binned(healpy.alm2cl(b)).max() < 1e-3 * binned(healpy.alm2cl(e)).max()


def test_shear_turns_around_mass(sky):
    """Tangential shear, on the sky in GalSim's axes (west, north), is positive around peaks: the sign is right."""
    kappa = sky.fields["convergence"][20]
    tangential, crossed = [], []
    for pixel in np.argsort(-kappa)[:150]:
        ra, dec = healpy.pix2ang(NSIDE, pixel, nest=True, lonlat=True)
        if abs(dec) > 60:
            continue
        near = healpy.query_disc(NSIDE, unit_vectors(ra, dec), np.radians(2.0), nest=True)
        other_ra, other_dec = healpy.pix2ang(NSIDE, near, nest=True, lonlat=True)
        west, north = -((other_ra - ra + 180) % 360 - 180) * np.cos(np.radians(dec)), other_dec - dec
        around = np.hypot(west, north) > 0.8
        angle = 2 * np.arctan2(north, west)[around]
        g1, g2 = (sky.fields[name][20][near][around] for name in ("shear_1", "shear_2"))
        tangential.append(-(g1 * np.cos(angle) + g2 * np.sin(angle)).mean())
        crossed.append((g1 * np.sin(angle) - g2 * np.cos(angle)).mean())
    assert np.mean(tangential) > 20 * abs(np.mean(crossed))
    assert np.mean(tangential) > 0.002


def test_lensing_is_continuous_between_pixels_and_grows_with_redshift(sky):
    z = np.array([0.02, 0.3, 1.0, 2.0, 3.0])
    kappa = np.stack([sky.lensing(np.full(5, ra), np.full(5, 10.0), z)[0] for ra in np.linspace(30, 31, 400)])
    assert np.abs(np.diff(kappa[:, 2])).max() < 0.2 * np.ptp(kappa[:, 2])
    random = np.random.default_rng(4)
    far = [
        sky.lensing(random.uniform(0, 360, 4000), random.uniform(-60, 60, 4000), np.full(4000, v))[0].std() for v in z
    ]
    assert (np.diff(far) > 0).all()
    with pytest.raises(ValueError, match="outside the pixels"):
        structure(64, np.arange(50), 1).lensing(np.array([200.0]), np.array([-80.0]), np.array([1.0]))


def test_hosts_and_satellites_add_up_to_the_counts():
    people = population(DENSITY)
    assert people.every.sum() == pytest.approx(DENSITY, rel=1e-6)
    assert (people.hosts >= 0).all()
    middle = (people.edges[1:] + people.edges[:-1]) / 2
    satellites = (people.hosts.sum(axis=1) * mean_satellites(middle)).sum()
    assert people.hosts.sum() + satellites == pytest.approx(DENSITY, rel=0.01)
    uniform = np.random.default_rng(1).random(400_000)
    assert richness(uniform).mean() == pytest.approx(1, abs=0.15)
    mean = np.repeat([0.1, 3.0, 40.0], 20_000)
    counts = poisson(np.random.default_rng(2).random(60_000), mean).reshape(3, -1)
    np.testing.assert_allclose(counts.mean(axis=1), [0.1, 3, 40], rtol=0.03)
    np.testing.assert_allclose(counts.var(axis=1), [0.1, 3, 40], rtol=0.05)


def test_redshifts_follow_their_distribution_inside_a_shell():
    edges = shells().edges
    uniform = np.random.default_rng(3).random(100_000)
    z = redshift_within(uniform, np.full(100_000, 1), np.full(100_000, 24.0))
    assert z.min() >= edges[1]
    assert z.max() <= edges[2]
    # z^2 exp(-z / z0) is nearly z^2 so near
    expected = 0.75 * (edges[2] ** 4 - edges[1] ** 4) / (edges[2] ** 3 - edges[1] ** 3)
    assert z.mean() == pytest.approx(expected, rel=0.015)


def test_counts_in_r_and_h_are_those_of_surveys(patch):
    area = REGION.area
    # the patch is one piece of a clustered universe: a few per cent
    assert len(patch) / area == pytest.approx(DENSITY, rel=0.08)
    r, h = magnitudes(patch, "r"), magnitudes(patch, "H158")
    for limit, count in GALAXY_COUNTS[GALAXY_COUNTS[:, 0] >= 22][:-1]:
        assert (r < limit).sum() / area == pytest.approx(10**count, rel=0.15)
    # COSMOS2020 (UltraVISTA H), galaxies a square arcminute of unmasked area
    for limit, count in ((21, 4.5), (22, 10.3), (23, 20.7), (24, 37.4)):
        assert (h < limit).sum() / area == pytest.approx(count, rel=0.35)


def test_colours_grow_bluer_with_magnitude_as_in_cosmos(patch):
    r, h = magnitudes(patch, "r"), magnitudes(patch, "H158")
    for low, colour in ((21, 1.17), (22, 1.18), (23, 1.15), (24, 1.02), (25, 0.87)):
        rows = (r > low) & (r < low + 1)
        assert np.median((r - h)[rows]) == pytest.approx(colour, abs=0.25)
    rows = (r > 22) & (r < 24)
    assert np.percentile((r - h)[rows], 90) - np.percentile((r - h)[rows], 10) > 1.2, "types are many"


def test_close_pairs_are_as_many_as_in_cosmos(patch):
    """Excess of pairs over random, H < 24, against COSMOS2020 whose masked third has been taken out."""
    chosen = patch[magnitudes(patch, "H158") < 24]
    edges = np.array([3, 6, 10, 20, 60])
    cosmos = np.array([0.22, 0.14, 0.10, 0.06])
    excess = pair_excess(chosen["ra"].to_numpy(), chosen["dec"].to_numpy(), edges)
    # shells of this resolution (27 arcmin) lack the 0.02-0.03 that larger structure adds
    np.testing.assert_allclose(excess, cosmos, rtol=0.6)
    assert (np.diff(excess) < 0).all()
    faint = patch[(magnitudes(patch, "r") > 26) & (magnitudes(patch, "r") < 27)]
    weaker = pair_excess(faint["ra"].to_numpy(), faint["dec"].to_numpy(), edges)
    assert (weaker < 0.5 * excess).all(), "the faint cluster less"


def pair_excess(ra, dec, edges):
    random = np.random.default_rng(0)
    width = REGION.width, REGION.dec_max - REGION.dec_min
    here = np.stack([ra - REGION.ra_min, dec - REGION.dec_min], 1)
    there = random.uniform(0, width, (150_000, 2))
    counts = [
        np.diff(cKDTree(points).count_neighbors(cKDTree(points), edges / 3600)) / len(points) ** 2
        for points in (here, there)
    ]
    return counts[0] / counts[1] - 1


def test_sizes_shapes_and_knots(patch):
    r, i = magnitudes(patch, "r"), magnitudes(patch, "i")
    disk = np.sqrt(patch["size_disk_true"] * patch["size_minor_disk_true"])
    bulge = np.sqrt(patch["size_bulge_true"] * patch["size_minor_bulge_true"])
    for low, expected in ((22, 0.45), (24, 0.28), (26, 0.18)):
        assert np.median(disk[(r > low) & (r < low + 1)]) == pytest.approx(expected, rel=0.1)
    assert np.median(bulge / disk) == pytest.approx(0.5, abs=0.05)
    ratio = patch["size_minor_disk_true"] / patch["size_disk_true"]
    ellipticity = (1 - ratio) / (1 + ratio)
    assert np.sqrt((ellipticity**2).mean() / 2) == pytest.approx(0.247, abs=0.02)
    assert patch["position_angle_unlensed"].between(0, 180).all()
    knotty = patch["n_knots"] > 0
    # the limit is on unlensed light
    assert i[knotty].max() < 27.2
    assert 0.05 < knotty[i < 25].mean() < 0.5
    assert (np.isfinite(patch["knots_magnorm"]) == knotty).all()
    share = 10 ** (-0.4 * (patch["knots_magnorm"] - patch["disk_magnorm"]))[knotty]
    large = disk[knotty] > np.median(disk[knotty])
    assert share[large].mean() > 1.2 * share[~large].mean(), "the share of knots falls with size"
    assert (patch["flux_r_noMW"] > patch["flux_r"]).all()
    assert (patch["dust_r"] >= 0.02).all()


def test_magnitudes_in_r_are_those_that_were_drawn(sky):
    cells = REGION.cells(galaxies.CELL_ORDER)[:40]
    drawn = galaxies.draw(cells, 5, DENSITY, sky)
    rows = galaxy_rows.galaxy_rows(drawn, sky, table(), ("r",), (0.0, 0.0), 0.03)
    mu = 1 / ((1 - rows["convergence"]) ** 2 - rows["shear_1"] ** 2 - rows["shear_2"] ** 2)
    np.testing.assert_allclose(magnitudes(rows, "r") + 2.5 * np.log10(mu), drawn.magnitude, atol=1e-4)


def test_satellites_lie_around_their_hosts_on_the_sphere():
    ra, dec = offset_positions(
        np.array([0.001, 200.0]), np.array([-30.0, 89.999]), np.radians(0.01), np.array([4.0, 1.0])
    )
    gap = np.linalg.norm(unit_vectors(ra, dec) - unit_vectors([0.001, 200.0], [-30.0, 89.999]), axis=1)
    np.testing.assert_allclose(gap, np.radians(0.01), rtol=1e-8)


def test_stars_have_a_galactic_distribution():
    line, plane = milky_way_stars.sightline(53.5, -40.0), milky_way_stars.sightline(270.0, -29.0)
    assert plane.counts.sum() > 5 * line.counts.sum(), "more towards the Galactic centre"
    by_magnitude = line.counts.sum(axis=1)
    middle = (line.edges[1:] + line.edges[:-1]) / 2
    assert (by_magnitude[middle < 14] > 0).all(), "bright ones are there"
    # the mean star of a magnitude is redder (fainter in M_r) the fainter it is, until the halo takes over
    mean = (line.counts * line.luminosities).sum(axis=1) / by_magnitude
    assert np.interp(22, middle, mean) > np.interp(16, middle, mean) + 2
    slope = np.log10(line.counts[:80].sum() / line.counts[:60].sum()) / 2
    assert 0.1 < slope < 0.35, "a magnitude, r 18 to 20 at high latitude (Bahcall and Soneira 1980)"
