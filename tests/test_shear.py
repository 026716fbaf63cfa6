"""Cosmic shear against pyccl, GalSim, Monte Carlo and analytic limits."""

import galsim
import numpy as np
import pandas as pd
import pyarrow as pa
import pyccl
import pytest
from scipy.special import jv

from romandask.kernels.shear import ELL, bin_means, convergence_power, correlations, covariance, shapes
from romandask.lensing import MeasureShear, significance, two_point
from romandask.model.config import LensingSettings
from romandask.model.cosmology import Cosmology
from romandask.model.sky import Region
from romandask.runtime.tables import TableProduct
from romandask.runtime.units import Unit

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


def test_the_power_spectrum_and_its_correlations_are_pyccls(sources, power):
    ccl = pyccl.Cosmology(
        Omega_c=COSMO.omega_m - COSMO.omega_b, Omega_b=COSMO.omega_b, h=COSMO.h, n_s=COSMO.n_s, sigma8=COSMO.sigma_8,
        transfer_function="boltzmann_camb", matter_power_spectrum="camb", Neff=3.046, m_nu=0.0,
        extra_parameters={"camb": {"halofit_version": "mead2020"}},
    )  # fmt: skip
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


def test_sample_variance_is_that_of_gaussian_fields(power):
    """Periodic Gaussian fields without noise: xi+ by the transform, averaged over annuli, from field to field."""
    random = np.random.default_rng(7)
    n, side = 256, np.radians(10.0)
    step = side / n
    wave = 2 * np.pi * np.fft.fftfreq(n, step)
    ell = np.hypot(wave[:, None], wave[None, :])
    # of a smoothed field without waves as long as itself, so that neither its pixels nor its few longest waves matter
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


def test_shapes_without_lensing_have_the_errors_of_their_noise_and_a_shear_its_square():
    random = np.random.default_rng(11)
    region = Region(52.0, 54.0, -41.0, -39.5)
    n, shear = 60_000, 0.05
    own = 0.25 * random.normal(size=n) + 0.25j * random.normal(size=n)
    frame = pd.DataFrame({
        "ra": random.uniform(region.ra_min, region.ra_max, n),
        "dec": np.degrees(np.arcsin(random.uniform(*np.sin(np.radians([region.dec_min, region.dec_max])), n))),
        "redshift": np.full(n, 0.05), "g1": own.real, "g2": own.imag,
    })  # fmt: skip
    settings = LensingSettings(max_separation=40, bins=8, patches=30)
    table = two_point(frame, settings, region, 1)
    assert table["high"].iloc[-1] == pytest.approx(40)
    assert table["sigma"].iloc[0] == pytest.approx(0.25, rel=0.02)
    for kind in ("xip", "xim"):
        assert (table[kind] / table[f"{kind}_error"]).abs().max() < 4
        ratio = table[f"{kind}_jackknife"] / table[f"{kind}_error"]
        assert ratio.median() == pytest.approx(1, abs=0.25)
    assert significance(table) < 8
    moved = two_point(frame.assign(g1=frame["g1"] + shear), settings, region, 1)
    assert (moved["xip"] - shear**2).abs().max() < 6e-4


def test_a_region_smaller_than_the_shortest_separation_has_no_bins():
    frame = pd.DataFrame({name: np.zeros(50) for name in ("ra", "dec", "redshift", "g1", "g2")})
    table = two_point(frame, LensingSettings(), Region(10.0, 10.05, 0.0, 0.05), 1)
    assert len(table) == 0
    assert significance(table) == 0


def test_the_sample_is_the_galaxies_that_objects_have_as_counterparts(small):
    """Each once, whatever the number of its pieces; no star of the same number."""
    every = small.truth.galaxies.all_rows()
    some = every.iloc[::3]
    ids = np.concatenate([some["galaxy_id"], some["galaxy_id"][:5], every["galaxy_id"].iloc[[1]], [-1]])
    star = np.zeros(len(ids), bool)
    star[-2] = True
    cells = small.truth.galaxies.pixels
    where = pd.concat([some, some[:5], every.iloc[[1]], some[:1]])["_healpix_29"].to_numpy()
    order = small.truth.galaxies.order
    parts = [
        pd.DataFrame({"truth_id": ids, "star": star})[where >> 2 * (29 - order) == cell].reset_index(drop=True)
        for cell in cells
    ]
    columns = pa.schema([("truth_id", pa.int64()), ("star", pa.bool_())])
    units = tuple(Unit(str(cell), cell) for cell in cells)
    sample = TableProduct("samples/roman", units, lambda k: parts[k], columns, cells, order)
    maker = MeasureShear(sample, small.truth.galaxies, LensingSettings(), small.region, 1)
    found = pd.concat([maker.shapes(k) for k in range(len(units))])
    assert sorted(found["galaxy_id"]) == sorted(some["galaxy_id"])
    first = some.iloc[0]
    axis = "disk" if np.isfinite(first["disk_magnorm"]) else "bulge"
    expected = shapes(
        first[f"size_{axis}_true"], first[f"size_minor_{axis}_true"],
        *(first[name] for name in ("position_angle_unlensed", "shear_1", "shear_2", "convergence")),
    )  # fmt: skip
    row = found.set_index("galaxy_id").loc[first["galaxy_id"]]
    assert row["g1"] + 1j * row["g2"] == pytest.approx(expected)
