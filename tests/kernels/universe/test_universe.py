"""The generated universe: matter and lensing compared with theory, galaxies and stars compared with surveys."""

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
    poisson_from_uniform,
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
    """The structure of a low-resolution universe, in all pixels of the sphere."""
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
    """Rows of the truth catalog for the galaxies of 0.64 square degrees."""
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
    """Return the mean of a power spectrum in bins of l, weighted by 2 l + 1."""
    ell = np.arange(len(spectrum))
    weight = (2 * ell + 1) * spectrum
    edges = np.arange(low, high + 1, width)
    return np.array([weight[a:b].sum() / (2 * ell[a:b] + 1).sum() for a, b in zip(edges[:-1], edges[1:], strict=True)])


def angular_power(field):
    """Return the angular power spectrum of a map in the nested scheme."""
    ring = healpy.reorder(np.asarray(field, float), n2r=True)
    return healpy.anafast(ring, lmax=2 * NSIDE, iter=1)


def test_distances_and_growth_agree_with_ccl(ccl):
    z = np.array([0.1, 0.5, 1.0, 2.0, 3.0])
    np.testing.assert_allclose(COSMO.comoving_distance(z), pyccl.comoving_radial_distance(ccl, 1 / (1 + z)), rtol=2e-3)
    np.testing.assert_allclose(COSMO.growth(z), pyccl.growth_factor(ccl, 1 / (1 + z)), rtol=3e-3)


@pytest.mark.slow
def test_angular_power_of_matter_and_galaxies_agrees_with_theory(sky):
    for shell in (6, 15, 28):
        theory = shell_spectra(2 * NSIDE)[shell]
        np.testing.assert_allclose(binned(angular_power(sky.fields["delta"][shell])), binned(theory), rtol=0.06)
        b = float(bias(shells().planes[shell]))
        # a lognormal field to the power b has the correlation function (1 + xi)^(b^2) - 1, or b^2 xi for small xi
        measured = binned(angular_power(sky.fields["galaxies"][shell])) / binned(theory)
        np.testing.assert_allclose(measured, b**2, rtol=0.15)
        assert sky.fields["galaxies"][shell].min() >= 0
        assert sky.fields["galaxies"][shell].mean() == pytest.approx(1, abs=1e-3)


def test_convergence_agrees_with_theory(sky, ccl):
    for shell in (12, 20, 30):
        source = shells().planes[shell]
        z = np.linspace(max(source - 0.02, 1e-3), source + 0.02, 201)
        tracer = pyccl.WeakLensingTracer(ccl, dndz=(z, np.exp(-0.5 * ((z - source) / 0.004) ** 2)))
        theory = pyccl.angular_cl(ccl, tracer, tracer, np.arange(2 * NSIDE + 1))
        # the tolerance of a tenth is due to shells of 200 Mpc and cosmic variance
        np.testing.assert_allclose(binned(angular_power(sky.fields["convergence"][shell])), binned(theory), rtol=0.12)


def test_shear_agrees_with_the_convergence_and_has_no_b_modes(sky):
    shell = 20
    # the axes of HEALPix are south and east
    q, u = (healpy.reorder(np.asarray(sky.fields[name][shell], float), n2r=True) for name in ("shear_1", "shear_2"))
    e, b = healpy.map2alm_spin([-q, u], 2, lmax=2 * NSIDE)
    kappa = healpy.map2alm(
        healpy.reorder(np.asarray(sky.fields["convergence"][shell], float), n2r=True), lmax=2 * NSIDE, iter=1
    )
    ell = np.arange(2 * NSIDE + 1)
    factor = (ell + 2) * np.maximum(ell - 1, 0) / np.maximum(ell * (ell + 1), 1)
    np.testing.assert_allclose(binned(healpy.alm2cl(e)), binned(healpy.alm2cl(kappa) * factor), rtol=0.02)
    assert binned(healpy.alm2cl(b)).max() < 1e-3 * binned(healpy.alm2cl(e)).max()


def test_tangential_shear_is_positive_around_peaks(sky):
    """The shear has the on-sky sign convention of GalSim, with axes west and north."""
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


def test_lensing_is_continuous_across_pixels_and_grows_with_redshift(sky):
    z = np.array([0.02, 0.3, 1.0, 2.0, 3.0])
    kappa = np.stack([sky.lensing(np.full(5, ra), np.full(5, 10.0), z)[0] for ra in np.linspace(30, 31, 400)])
    assert np.abs(np.diff(kappa[:, 2])).max() < 0.2 * np.ptp(kappa[:, 2])
    random = np.random.default_rng(4)
    rms = [
        sky.lensing(random.uniform(0, 360, 4000), random.uniform(-60, 60, 4000), np.full(4000, v))[0].std() for v in z
    ]
    assert (np.diff(rms) > 0).all()
    with pytest.raises(ValueError, match="outside the pixels"):
        structure(64, np.arange(50), 1).lensing(np.array([200.0]), np.array([-80.0]), np.array([1.0]))


def test_hosts_and_satellites_add_up_to_the_observed_counts():
    model = population(DENSITY)
    assert model.galaxies.sum() == pytest.approx(DENSITY, rel=1e-6)
    assert (model.hosts >= 0).all()
    middle = (model.edges[1:] + model.edges[:-1]) / 2
    satellites = (model.hosts.sum(axis=1) * mean_satellites(middle)).sum()
    assert model.hosts.sum() + satellites == pytest.approx(DENSITY, rel=0.01)
    uniform = np.random.default_rng(1).random(400_000)
    assert richness(uniform).mean() == pytest.approx(1, abs=0.15)
    mean = np.repeat([0.1, 3.0, 40.0], 20_000)
    counts = poisson_from_uniform(np.random.default_rng(2).random(60_000), mean).reshape(3, -1)
    np.testing.assert_allclose(counts.mean(axis=1), [0.1, 3, 40], rtol=0.03)
    np.testing.assert_allclose(counts.var(axis=1), [0.1, 3, 40], rtol=0.05)


def test_redshifts_follow_their_distribution_inside_a_shell():
    edges = shells().edges
    uniform = np.random.default_rng(3).random(100_000)
    z = redshift_within(uniform, np.full(100_000, 1), np.full(100_000, 24.0))
    assert z.min() >= edges[1]
    assert z.max() <= edges[2]
    # at these low redshifts z^2 exp(-z / z0) is nearly z^2
    expected = 0.75 * (edges[2] ** 4 - edges[1] ** 4) / (edges[2] ** 3 - edges[1] ** 3)
    assert z.mean() == pytest.approx(expected, rel=0.015)


@pytest.mark.slow
def test_counts_in_r_and_h_agree_with_surveys(patch):
    area = REGION.area
    # clustering changes the counts of one small patch by a few per cent
    assert len(patch) / area == pytest.approx(DENSITY, rel=0.08)
    r, h = magnitudes(patch, "r"), magnitudes(patch, "H158")
    for limit, count in GALAXY_COUNTS[GALAXY_COUNTS[:, 0] >= 22][:-1]:
        assert (r < limit).sum() / area == pytest.approx(10**count, rel=0.15)
    # COSMOS2020 (UltraVISTA H), galaxies per square arcminute of unmasked area
    for limit, count in ((21, 4.5), (22, 10.3), (23, 20.7), (24, 37.4)):
        assert (h < limit).sum() / area == pytest.approx(count, rel=0.35)


def test_colours_become_bluer_with_magnitude_as_in_cosmos(patch):
    r, h = magnitudes(patch, "r"), magnitudes(patch, "H158")
    for low, colour in ((21, 1.17), (22, 1.18), (23, 1.15), (24, 1.02), (25, 0.87)):
        rows = (r > low) & (r < low + 1)
        assert np.median((r - h)[rows]) == pytest.approx(colour, abs=0.25)
    rows = (r > 22) & (r < 24)
    assert np.percentile((r - h)[rows], 90) - np.percentile((r - h)[rows], 10) > 1.2, "the colours spread widely"


def test_excess_of_close_pairs_agrees_with_cosmos(patch):
    """Excess of pairs over random positions at H < 24, compared with the unmasked two thirds of COSMOS2020."""
    bright = patch[magnitudes(patch, "H158") < 24]
    edges = np.array([3, 6, 10, 20, 60])
    cosmos = np.array([0.22, 0.14, 0.10, 0.06])
    excess = pair_excess(bright["ra"].to_numpy(), bright["dec"].to_numpy(), edges)
    # at the resolution of these shells (27 arcmin) the 0.02-0.03 from large-scale structure are missing
    np.testing.assert_allclose(excess, cosmos, rtol=0.6)
    assert (np.diff(excess) < 0).all()
    faint = patch[(magnitudes(patch, "r") > 26) & (magnitudes(patch, "r") < 27)]
    faint_excess = pair_excess(faint["ra"].to_numpy(), faint["dec"].to_numpy(), edges)
    assert (faint_excess < 0.5 * excess).all(), "faint galaxies cluster less"


def pair_excess(ra, dec, edges):
    """Return the number of pairs over that of random positions, minus 1, in bins of separation (arcsec)."""
    random = np.random.default_rng(0)
    width = REGION.width, REGION.dec_max - REGION.dec_min
    objects = np.stack([ra - REGION.ra_min, dec - REGION.dec_min], 1)
    random_positions = random.uniform(0, width, (150_000, 2))
    counts = [
        np.diff(cKDTree(points).count_neighbors(cKDTree(points), edges / 3600)) / len(points) ** 2
        for points in (objects, random_positions)
    ]
    return counts[0] / counts[1] - 1


def test_sizes_shapes_knots_and_dust_of_galaxies(patch):
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
    has_knots = patch["n_knots"] > 0
    # the limit of 27 applies to the magnitude without magnification
    assert i[has_knots].max() < 27.2
    assert 0.05 < has_knots[i < 25].mean() < 0.5
    assert (np.isfinite(patch["knots_magnorm"]) == has_knots).all()
    knot_ratio = 10 ** (-0.4 * (patch["knots_magnorm"] - patch["disk_magnorm"]))[has_knots]
    large = disk[has_knots] > np.median(disk[has_knots])
    assert knot_ratio[large].mean() > 1.2 * knot_ratio[~large].mean(), "large galaxies have more light in knots"
    assert (patch["flux_r_noMW"] > patch["flux_r"]).all()
    assert (patch["dust_r"] >= 0.02).all()


def test_unlensed_r_magnitudes_equal_the_generated_magnitudes(sky):
    cells = REGION.cells(galaxies.CELL_ORDER)[:40]
    drawn = galaxies.draw(cells, 5, DENSITY, sky)
    rows = galaxy_rows.galaxy_rows(drawn, sky, table(), ("r",), (0.0, 0.0), 0.03)
    mu = 1 / ((1 - rows["convergence"]) ** 2 - rows["shear_1"] ** 2 - rows["shear_2"] ** 2)
    np.testing.assert_allclose(magnitudes(rows, "r") + 2.5 * np.log10(mu), drawn.magnitude, atol=1e-4)


def test_offset_positions_are_at_the_given_separation():
    ra, dec = offset_positions(
        np.array([0.001, 200.0]), np.array([-30.0, 89.999]), np.radians(0.01), np.array([4.0, 1.0])
    )
    separation = np.linalg.norm(unit_vectors(ra, dec) - unit_vectors([0.001, 200.0], [-30.0, 89.999]), axis=1)
    np.testing.assert_allclose(separation, np.radians(0.01), rtol=1e-8)


def test_star_counts_depend_on_direction_and_magnitude_as_in_the_galaxy():
    line, plane = milky_way_stars.sightline(53.5, -40.0), milky_way_stars.sightline(270.0, -29.0)
    assert plane.counts.sum() > 5 * line.counts.sum(), "more towards the Galactic centre"
    by_magnitude = line.counts.sum(axis=1)
    middle = (line.edges[1:] + line.edges[:-1]) / 2
    assert (by_magnitude[middle < 14] > 0).all(), "there are bright stars"
    # the mean M_r increases with r, until the halo dominates
    mean = (line.counts * line.absolute_magnitudes).sum(axis=1) / by_magnitude
    assert np.interp(22, middle, mean) > np.interp(16, middle, mean) + 2
    slope = np.log10(line.counts[:80].sum() / line.counts[:60].sum()) / 2
    assert 0.1 < slope < 0.35, "dex per magnitude, r from 18 to 20 at high latitude (Bahcall and Soneira 1980)"
