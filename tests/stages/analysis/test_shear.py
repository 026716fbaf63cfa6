"""Cosmic shear against pyccl, GalSim, Monte Carlo and analytic limits."""

from dataclasses import replace

import galsim
import numpy as np
import pandas as pd
import pyarrow as pa
import pyccl
import pytest
import treecorr
from scipy.special import jv

from romandask.kernels.measurement.shear import ELL, bin_means, convergence_power, correlations, covariance, shapes
from romandask.model.cosmology import Cosmology
from romandask.model.settings import LensingSettings
from romandask.model.sky import Region
from romandask.products.hats import with_spatial_index
from romandask.products.tables import TableProduct
from romandask.products.units import Unit
from romandask.stages.analysis.shear import MeasureShapes, lensing
from romandask.stages.analysis.two_point import pair_sums, patches, separations, significance, two_point

COSMO = Cosmology()
ARCMIN = np.radians(1 / 60)
EDGES = np.geomspace(2.5, 250, 21) * ARCMIN
BINS = np.linspace(0, 3, 61)


@pytest.fixture(scope="module")
def sources():
    z = (BINS[1:] + BINS[:-1]) / 2
    return z**2 * np.exp(-((z / 0.6) ** 1.2))


@pytest.fixture(scope="module")
def power(sources):
    return convergence_power(BINS, sources)


@pytest.mark.slow
def test_the_power_spectrum_and_its_correlations_are_pyccls(sources, power):
    ccl = pyccl.Cosmology(
        Omega_c=COSMO.omega_m - COSMO.omega_b,
        Omega_b=COSMO.omega_b,
        h=COSMO.h,
        n_s=COSMO.n_s,
        sigma8=COSMO.sigma_8,
        transfer_function="boltzmann_camb",
        matter_power_spectrum="camb",
        Neff=3.046,
        m_nu=0.0,
        extra_parameters={"camb": {"halofit_version": "mead2020"}},
    )
    tracer = pyccl.WeakLensingTracer(ccl, dndz=((BINS[1:] + BINS[:-1]) / 2, sources))
    few = np.geomspace(20, 5000, 30).astype(int)
    theirs = pyccl.angular_cl(ccl, tracer, tracer, few)
    ours = np.interp(few, ELL, power)
    assert np.abs(ours / theirs - 1).max() < 0.03
    # narrow bins, so that a mean over them is the value in the middle
    narrow = np.geomspace(3, 200, 200) * ARCMIN
    middle = np.sqrt(narrow[1:] * narrow[:-1])
    xi = correlations(narrow, power)
    for row, kind in enumerate(("GG+", "GG-")):
        expected = pyccl.correlation(ccl, ell=ELL, C_ell=power, theta=np.degrees(middle), type=kind, method="Bessel")
        assert np.abs(xi[row] / expected - 1).max() < 0.02, kind


def test_bin_means_are_means_over_the_annulus():
    edges = np.array([3.0, 10.0]) * ARCMIN
    ell = np.array([10, 300, 3000, 20_000])
    theta = np.linspace(*edges, 200_001)
    for kernel, order in zip(bin_means(edges, ell), (0, 4), strict=True):
        values = jv(order, ell[:, None] * theta) * theta
        mean = np.trapezoid(values, theta, axis=1) / np.trapezoid(theta, theta)
        np.testing.assert_allclose(kernel[0], mean, rtol=1e-4, atol=1e-8)


def test_a_shape_is_galsims_sheared_shape():
    """An ellipse at 30 degrees east of north, then lensed."""
    g = galsim.Shear(g=(2.0 - 1.2) / (2.0 + 1.2), beta=(90 + 30) * galsim.degrees)
    expected = galsim.Shear(g1=0.04 / 0.98, g2=-0.03 / 0.98) + g
    found = shapes(2.0, 1.2, 30.0, 0.04, -0.03, 0.02)
    assert found.real == pytest.approx(expected.g1, abs=1e-9)
    assert found.imag == pytest.approx(expected.g2, abs=1e-9)


def test_shape_noise_alone_is_two_sigma_to_the_fourth_over_pairs():
    """Monte Carlo of pairs of random shapes: the variance of the mean of their products."""
    random = np.random.default_rng(1)
    sigma, pairs = 0.25, 5000
    first, second = (random.normal(0, sigma, (2, 2000, pairs)) for _ in range(2))
    scatter = (first * second).sum(axis=0).mean(axis=1).var()
    area, density = np.radians(1) ** 2, 30 / ARCMIN**2
    matrix = covariance(EDGES, np.zeros(len(ELL)), area, density, sigma, np.full(20, pairs))
    assert matrix[0, 0] == pytest.approx(scatter, rel=0.1)
    assert np.count_nonzero(matrix - np.diag(np.diag(matrix))) == 0


@pytest.mark.slow
def test_sample_variance_is_that_of_gaussian_fields(power):
    """The scatter of xi+ between periodic Gaussian fields without noise, averaged over annuli."""
    random = np.random.default_rng(7)
    n, side = 256, np.radians(10.0)
    step = side / n
    wave = 2 * np.pi * np.fft.fftfreq(n, step)
    ell = np.hypot(wave[:, None], wave[None, :])
    # smoothed, and without the longest waves, so that neither pixels nor the few longest modes matter
    smooth = power * np.exp(-((ELL * 3 * step) ** 2) / 2) * (1 - np.exp(-((ELL / 250) ** 4)))
    spectrum = np.interp(ell, ELL, smooth, left=0)
    spectrum[0, 0] = 0
    x = np.fft.fftfreq(n, 1 / n) * step
    theta = np.hypot(x[:, None], x[None, :])
    edges = np.array([20, 35, 50, 70]) * ARCMIN
    rings = [(theta >= low) & (theta < high) for low, high in zip(edges[:-1], edges[1:], strict=True)]
    found = []
    for _ in range(1500):
        field = np.fft.fft2(random.normal(size=(n, n))) / n * np.sqrt(spectrum / step**2)
        xi = np.fft.ifft2(np.abs(field) ** 2).real
        found.append([xi[ring].mean() for ring in rings])
    # xi+ of the shear of a pure E field is the correlation of its convergence
    measured = np.cov(np.array(found).T)
    expected = covariance(edges, smooth, side**2, 1e30, 1e-6)[:3, :3]
    np.testing.assert_allclose(np.mean(found, axis=0), correlations(edges, smooth)[0], rtol=0.08)
    np.testing.assert_allclose(np.diag(measured), np.diag(expected), rtol=0.15)
    assert measured[0, 1] == pytest.approx(expected[0, 1], rel=0.25)


@pytest.mark.slow
def test_shapes_without_lensing_have_the_errors_of_their_noise_and_a_shear_its_square():
    random = np.random.default_rng(11)
    region = Region(52.0, 54.0, -41.0, -39.5)
    n, shear = 60_000, 0.05
    own = 0.25 * random.normal(size=n) + 0.25j * random.normal(size=n)
    frame = pd.DataFrame(
        {
            "ra": random.uniform(region.ra_min, region.ra_max, n),
            "dec": np.degrees(np.arcsin(random.uniform(*np.sin(np.radians([region.dec_min, region.dec_max])), n))),
            "redshift": np.full(n, 0.05),
            "g1": own.real,
            "g2": own.imag,
        }
    )
    settings = LensingSettings(max_separation=40, bins=8, patches=30)
    table = two_point(frame, settings, region)
    assert table["high"].iloc[-1] == pytest.approx(40)
    assert table["sigma"].iloc[0] == pytest.approx(0.25, rel=0.02)
    for kind in ("xip", "xim"):
        assert (table[kind] / table[f"{kind}_error"]).abs().max() < 4
        ratio = table[f"{kind}_jackknife"] / table[f"{kind}_error"]
        assert ratio.median() == pytest.approx(1, abs=0.25)
    assert significance(table) < 8
    moved = two_point(frame.assign(g1=frame["g1"] + shear), settings, region)
    assert (moved["xip"] - shear**2).abs().max() < 6e-4


def test_a_region_smaller_than_the_shortest_separation_has_no_bins():
    frame = pd.DataFrame({name: np.zeros(50) for name in ("ra", "dec", "redshift", "g1", "g2")})
    table = two_point(frame, LensingSettings(), Region(10.0, 10.05, 0.0, 0.05))
    assert len(table) == 0
    assert significance(table) == 0


def test_shapes_are_those_of_galaxies_that_are_counterparts(small):
    """Each galaxy is one row, also with several objects; a star with the same id is left out."""
    every = small.truth.galaxies.all_rows()
    some = every.iloc[::3]
    ids = np.concatenate([some["galaxy_id"], some["galaxy_id"][:5], every["galaxy_id"].iloc[[1]], [-1]])
    star = np.zeros(len(ids), bool)
    star[-2] = True
    cells = small.truth.galaxies.pixels
    where = pd.concat([some, some[:5], every.iloc[[1]], some[:1]])["_healpix_29"].to_numpy()
    order = small.truth.galaxies.order
    parts = [
        pd.DataFrame({"truth_id": ids, "star": star, "_healpix_29": where})[
            where >> 2 * (29 - order) == cell
        ].reset_index(drop=True)
        for cell in cells
    ]
    columns = pa.schema([("truth_id", pa.int64()), ("star", pa.bool_()), ("_healpix_29", pa.int64())])
    units = tuple(Unit(str(cell), cell) for cell in cells)
    sample = TableProduct(
        stage="samples/roman", units=units, make=lambda k: parts[k], schema=columns, pixels=cells, order=order
    )
    maker = MeasureShapes(sample, small.truth.galaxies)
    found = pd.concat([maker(k) for k in range(len(units))])
    assert sorted(found["galaxy_id"]) == sorted(some["galaxy_id"])
    first = some.iloc[0]
    axis = "disk" if np.isfinite(first["disk_magnorm"]) else "bulge"
    expected = shapes(
        first[f"size_{axis}_true"],
        first[f"size_minor_{axis}_true"],
        *(first[name] for name in ("position_angle_unlensed", "shear_1", "shear_2", "convergence")),
    )
    row = found.set_index("galaxy_id").loc[first["galaxy_id"]]
    assert row["g1"] + 1j * row["g2"] == pytest.approx(expected)


def random_shapes(region: Region, count: int) -> pd.DataFrame:
    """Return galaxies with spatially correlated shapes."""
    random = np.random.default_rng(3)
    ra = (region.ra_min + random.uniform(0, region.width, count)) % 360
    dec = np.degrees(np.arcsin(random.uniform(*np.sin(np.radians([region.dec_min, region.dec_max])), count)))
    wave = 0.05 * np.sin(20 * np.radians(dec) * 60)
    return pd.DataFrame(
        {
            "ra": ra,
            "dec": dec,
            "redshift": random.uniform(0.2, 2, count),
            "g1": wave + random.normal(0, 0.2, count),
            "g2": random.normal(0, 0.2, count),
        }
    )


@pytest.mark.parametrize("ra", [(52.0, 54.0), (359.2, 1.1)])
def test_sums_over_patches_are_treecorrs_of_the_whole_with_its_jackknife(ra):
    region = Region(*ra, -41.0, -39.5)
    frame, settings = random_shapes(region, 20_000), LensingSettings(max_separation=60, bins=6, patches=12)
    table, edges = two_point(frame, settings, region), separations(settings, region)
    patch = np.full(len(frame), -1)
    for number, box in enumerate(patches(region, 12)):
        inside = box.contains(frame["ra"], frame["dec"])
        assert (patch[inside] == -1).all()
        patch[inside] = number
    assert patch.min() == 0
    assert np.ptp(np.bincount(patch)) < 0.15 * len(frame) / 12
    columns = {name: frame[name].to_numpy() for name in ("ra", "dec", "g1", "g2")}
    catalog = treecorr.Catalog(**columns, ra_units="deg", dec_units="deg", patch=patch)
    whole = treecorr.GGCorrelation(
        min_sep=edges[0],
        max_sep=edges[-1],
        nbins=len(edges) - 1,
        sep_units="arcmin",
        var_method="jackknife",
        cross_patch_weight="match",
    )
    whole.process(catalog)
    np.testing.assert_allclose(table["xip"], whole.xip, rtol=1e-9)
    np.testing.assert_allclose(table["xim"], whole.xim, rtol=1e-9, atol=1e-12)
    np.testing.assert_allclose(table["pairs"], whole.npairs)
    np.testing.assert_allclose(table["separation"], whole.meanr, rtol=1e-9)
    errors = np.sqrt(np.diag(whole.cov))
    np.testing.assert_allclose(table["xip_jackknife"], errors[: len(table)], rtol=1e-9)
    np.testing.assert_allclose(table["xim_jackknife"], errors[len(table) :], rtol=1e-9)


def test_stages_over_partitions_equal_the_computation_in_memory():
    """Shapes are in HEALPix partitions and counted patch by patch."""
    region = Region(52.0, 53.0, -40.6, -40.0)
    frame = with_spatial_index(random_shapes(region, 3000)).assign(galaxy_id=np.arange(3000))
    settings, order = LensingSettings(max_separation=15, bins=4, patches=6), 6
    cells = tuple(int(cell) for cell in region.cells(order))
    units = tuple(Unit(str(cell), cell) for cell in cells)
    where = frame["_healpix_29"].to_numpy() >> 2 * (29 - order)
    columns = pa.schema([("truth_id", pa.int64()), ("star", pa.bool_()), ("_healpix_29", pa.int64())])
    every = frame.assign(truth_id=frame["galaxy_id"], star=False)
    parts = [every[where == cell].reset_index(drop=True) for cell in cells]
    sample = TableProduct(
        stage="samples/roman", units=units, make=lambda k: parts[k], schema=columns, pixels=cells, order=order
    )
    stages = lensing(sample, sample, settings, region)
    made = replace(stages.shapes, make=lambda k: parts[k])
    pairs = replace(stages.pairs, make=replace(stages.pairs.make, shapes=made))
    found = replace(stages.shear.make, shapes=made, pairs=pairs)(0)
    expected = two_point(frame, settings, region)
    assert len(expected) == 4
    assert found["galaxies"].iloc[0] == 3000
    for name in ("separation", "pairs", "xip", "xim", "xip_error", "xip_jackknife", "sigma"):
        np.testing.assert_allclose(found[name], expected[name], rtol=1e-8)


def test_pairs_are_counted_by_one_thread_and_treecorr_is_left_as_it_was():
    """Workers run in parallel, so threads within one would only compete with the others."""
    treecorr.util.set_omp_threads(4)
    random = np.random.default_rng(1)
    rows = pd.DataFrame({name: random.uniform(0, 0.3, 500) for name in ("ra", "dec", "g1", "g2")})
    pair_sums(0, 1, rows, rows, np.array([1.0, 3.0, 9.0]))
    assert treecorr.get_omp_threads() == 1
    assert treecorr.util.max_omp_threads is None
