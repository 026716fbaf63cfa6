"""Effects of the SCAs, each compared with analytic cases, loops over pixels, or GalSim."""

import galsim
import galsim.roman
import numpy as np
import pytest

from romandask.kernels.detectors import sca
from romandask.kernels.detectors.brighter_fatter import brighter_fatter, potentials
from romandask.kernels.detectors.cosmic_rays import hits, tracks
from romandask.kernels.detectors.synthetic_sca import AREA_KERNEL_QUARTER, area_kernels, capacitance
from romandask.model.seeds import rng


def generators(name):
    return rng(3, "calibration", 1, name)


@pytest.fixture(scope="module")
def kernel() -> np.ndarray:
    """An area kernel, (5, 5), 1/electron."""
    half = np.concatenate([AREA_KERNEL_QUARTER, AREA_KERNEL_QUARTER[:, 1::-1]], axis=1)
    return np.concatenate([half, half[1::-1]]) * 1e-6


def blocks_of(kernel, ny, nx):
    """Return the area kernels of ny x nx blocks, all equal."""
    return np.broadcast_to(kernel[:, :, None, None], (5, 5, ny, nx)).copy()


def test_an_isolated_bright_pixel_loses_charge_to_its_neighbours(kernel):
    charge = np.zeros((64, 64), np.float32)
    charge[30, 31] = 5e4
    after = brighter_fatter(charge, blocks_of(kernel, 1, 1), 64)
    # half of the area kernel on average, times the mean charge at a boundary, (5e4 + 0) / 2
    assert 1 - after[30, 31] / 5e4 == pytest.approx(0.5 * 2.04e-6 * 5e4 / 2, rel=1e-4)
    assert 1 - after[30, 31] / 5e4 == pytest.approx(0.025, abs=0.001)
    assert after.sum(dtype=float) == pytest.approx(5e4, rel=1e-6)
    # the four neighbours receive equal shares, other pixels nothing: between empty pixels there is no charge to move
    around = after[[29, 31, 30, 30], [31, 31, 30, 32]]
    np.testing.assert_allclose(around, around[0], rtol=1e-4)
    assert around.sum() == pytest.approx(5e4 - after[30, 31], rel=1e-3)


def test_the_linear_response_of_a_flat_is_the_area_kernel(kernel):
    """A slightly brighter pixel changes its neighbours by half of their change in area times the charge."""
    flat = np.full((40, 40), 2e4)
    brighter = flat.copy()
    brighter[20, 20] += 200.0
    kernels = blocks_of(kernel, 1, 1)
    change = brighter_fatter(brighter, kernels, 40).astype(float) - brighter_fatter(flat, kernels, 40)
    change[20, 20] -= 200.0
    response = change[18:23, 18:23] / (0.5 * 2e4 * 200.0)
    np.testing.assert_allclose(response, kernel, atol=1.2e-8)


def test_potentials_have_the_kernel_as_their_laplacian(kernel):
    potential = potentials(kernel)
    laplacian = (
        potential[:-2, 1:-1]
        + potential[2:, 1:-1]
        + potential[1:-1, :-2]
        + potential[1:-1, 2:]
        - 4 * potential[1:-1, 1:-1]
    )
    np.testing.assert_allclose(-laplacian, kernel, atol=1e-18)


def test_the_covariance_of_flats_is_the_area_kernel(kernel):
    """Covariance / mean^2 of pairs of pixels, from differences of flats, is the area kernel."""
    mean, side, covariance = 4e4, 1024, np.zeros((3, 3))
    pairs = 6
    for pair in range(pairs):
        first, second = (
            brighter_fatter(
                rng(1, "flat", pair, k).poisson(mean, (side, side)).astype(np.float32), blocks_of(kernel, 8, 8), 128
            ).astype(float)
            for k in range(2)
        )
        difference = first - second
        for dy in range(3):
            for dx in range(3):
                product = difference[: side - dy, : side - dx] * difference[dy:, dx:]
                covariance[dy, dx] += product.mean() / 2 / mean**2 / pairs
    # subtract the Poisson variance
    covariance[0, 0] -= 1 / mean
    quarter = AREA_KERNEL_QUARTER[::-1, ::-1] * 1e-6
    scatter = 1 / mean / np.sqrt(pairs * side**2)
    np.testing.assert_allclose(covariance[1:, 0], quarter[1:, 0], atol=5 * scatter)
    np.testing.assert_allclose(covariance[0, 1:], quarter[0, 1:], atol=5 * scatter)
    np.testing.assert_allclose(covariance[1:, 1:], quarter[1:, 1:], atol=5 * scatter)
    assert covariance[0, 0] == pytest.approx(quarter[0, 0], rel=0.06)
    assert covariance[0, 1] > 20 * scatter


def test_every_block_has_its_own_kernel_and_rows_can_be_done_separately():
    kernels = area_kernels(generators)
    charge = rng(1, "charge").poisson(3e3, (300, 260)).astype(np.float32) * 10
    whole = brighter_fatter(charge, kernels, 128)
    # the kernel reaches three rows beyond the rows that are compared
    part = brighter_fatter(charge[97:203], kernels, 128, (97, 0))
    np.testing.assert_allclose(part[4:-4], whole[101:199], rtol=1e-6)
    flipped = brighter_fatter(charge, kernels[..., ::-1], 128)
    assert np.abs(flipped - whole).max() > 1


def test_capacitance_agrees_with_a_loop_over_source_pixels():
    kernels, block = capacitance(generators)[:, :, :8, :8], 5
    signal = rng(1, "signal").poisson(500, (36, 38)).astype(np.float32)
    expected = np.zeros((36, 38))
    for y in range(36):
        for x in range(38):
            for dy in (-1, 0, 1):
                for dx in (-1, 0, 1):
                    if 0 <= y + dy < 36 and 0 <= x + dx < 38:
                        share = kernels[dy + 1, dx + 1, y // block, x // block]
                        expected[y + dy, x + dx] += share * signal[y, x]
    np.testing.assert_allclose(sca.interpixel_capacitance(signal, kernels, block), expected, rtol=2e-6)
    # an asymmetric kernel distinguishes source from target, and rows from columns
    skew = np.zeros((3, 3, 1, 1))
    skew[2, 1] = 1.0
    up = sca.interpixel_capacitance(signal, skew, 64)
    np.testing.assert_array_equal(up[1:], signal[:-1])
    part = sca.interpixel_capacitance(signal[10:30], kernels, block, (10, 0))
    np.testing.assert_allclose(part[1:-1], expected[11:29], rtol=2e-6)


def test_capacitance_with_one_kernel_agrees_with_galsim():
    signal = rng(1, "signal").poisson(500, (40, 50)).astype(np.float32)
    image = galsim.Image(signal.copy())
    galsim.roman.applyIPC(image, edge_treatment="extend")
    # GalSim's kernel refers to the target pixel: mirrored, it refers to the source pixel
    kernels = galsim.roman.ipc_kernel.array[::-1, ::-1, None, None]
    ours = sca.interpixel_capacitance(signal, kernels / kernels.sum(), 64)
    np.testing.assert_allclose(ours[1:-1, 1:-1], image.array[1:-1, 1:-1], rtol=2e-5)


def test_the_inverse_of_capacitance_recovers_the_signal():
    kernels = capacitance(generators)[:, :, :8, :8]
    signal = rng(1, "signal").poisson(500, (60, 60)).astype(np.float32) + np.float32(5e4) * np.eye(60, dtype=np.float32)
    recovered = sca.without_capacitance(sca.interpixel_capacitance(signal, kernels, 8), kernels, 8)
    assert np.abs(recovered[2:-2, 2:-2] - signal[2:-2, 2:-2]).max() < 1e-4 * signal.max()


def test_classical_nonlinearity_is_a_polynomial_with_an_inverse():
    planes = np.array([3e-7, 1e-12, 5e-18])
    charge = np.array([0.0, 1e3, 5e4, 1e5])
    expected = charge - 3e-7 * charge**2 - 1e-12 * charge**3 - 5e-18 * charge**4
    np.testing.assert_allclose(sca.nonlinear(charge, planes), expected, rtol=1e-12)
    np.testing.assert_allclose(sca.linear(expected, planes), charge, rtol=1e-9, atol=1e-9)
    beta = 6e-7
    image = galsim.Image(charge[None].copy())
    image.applyNonlinearity(lambda value, b: value - b * value**2, beta)
    np.testing.assert_allclose(sca.nonlinear(charge, np.array([beta, 0, 0])), image.array[0], rtol=1e-12)


def test_count_rate_nonlinearity_is_a_power_law():
    electrons = np.array([100.0, 1e4, 1e6]) * 10
    counted = sca.count_rate_nonlinearity(electrons, 0.01, 100.0)
    # rates of 0.1, 10 and 1000 times the reference rate
    np.testing.assert_allclose(counted / electrons, [0.1**0.01, 10**0.01, 1000**0.01], rtol=1e-9)
    np.testing.assert_allclose(sca.count_rate_linearity(counted, 0.01, 100.0), electrons, rtol=1e-9)


@pytest.mark.parametrize(
    ("charge", "released"),
    [
        (0.0, 0.0),
        (500.0, 0.05),  # proportional below the first level
        (1e3, 0.1),
        (2e3, 0.25),  # half way to the second level
        (3e3, 0.4),
        (2e4, 3.0),
        (1e5, 50.0),
        (3e5, 100.0),
        (9e5, 200.0),  # power law: a factor of 3 in charge is a factor of 2 in f(Q)
    ],
)
def test_persistence_at_between_and_beyond_the_levels(charge, released):
    planes = np.array([0.1, 0.4, 2.0, 4.0, 50.0, 100.0])
    assert sca.persistence(np.array([charge]), planes[:, None], 200.0)[0] == pytest.approx(released / 200.0)


def test_zero_planes_give_no_persistence():
    assert (sca.persistence(np.array([1e2, 1e4, 1e6]), np.zeros((6, 3)), 100.0) == 0).all()


def test_a_quantum_yield_adds_electrons_and_noise():
    photons = rng(1, "photons").poisson(100, 400_000)
    electrons = sca.quantum_yield(photons, 1.3, rng(1, "yield"))
    assert electrons.mean() == pytest.approx(130, rel=1e-3)
    # the mean square of the electrons of a photon is 0.7 + 0.3 * 4
    assert electrons.var() == pytest.approx(100 * (0.7 + 4 * 0.3), rel=0.01)
    assert sca.quantum_yield(photons, 1.0, rng(1, "yield")) is photons


def test_the_mean_over_a_band_interpolates_between_planes():
    wave = np.linspace(400, 2400, 50)
    planes = (2 + wave / 1000)[:, None, None] * np.ones((1, 2, 3))
    band_wave, weights = np.linspace(900, 1100, 31), np.linspace(1, 2, 31)
    mean = sca.band_mean(planes, wave, band_wave, weights)
    np.testing.assert_allclose(mean, np.full((2, 3), 2 + np.average(band_wave, weights=weights) / 1000))


def test_cosmic_rays_have_the_rate_and_lengths_of_an_isotropic_flux():
    rays = tracks((4096, 4096), 139.8, rng(1, "rays"))
    # 1.3e4 tracks on an SCA
    assert len(rays) == pytest.approx(5.5 * 4.096**2 * 139.8, abs=5 * np.sqrt(1.3e4))
    length = np.hypot(rays[:, 2], rays[:, 3])
    # the length is half a pixel times the tangent of the angle; cos^2 is uniform, so the median tangent is 1
    assert np.median(length) == pytest.approx(0.5, rel=0.05)
    assert np.mean(length > 1.5) == pytest.approx(1 / (1 + 9), rel=0.1)
    # the median of the Moyal distribution is 0.79 widths above the most probable value
    perpendicular = length < 0.05
    assert np.median(rays[perpendicular, 4]) == pytest.approx(2500 * (1 + 0.15 * 0.79), rel=0.05)


def test_tracks_leave_their_charge_in_the_pixels_that_they_cross():
    image = hits((20, 20), np.array([[3.0, 5.0, 10.0, 0.0, 1000.0], [10.2, 12.0, 0.0, 0.0, 50.0]]))
    assert image.sum() == pytest.approx(1050)
    np.testing.assert_allclose(image[5, 4:13], 100, rtol=0.15)
    assert image[12, 10] == 50
    assert (image[[4, 6]] == 0).all()
    cut_off = hits((20, 20), np.array([[18.0, 5.0, 10.0, 0.0, 1000.0]]))
    assert cut_off.sum() == pytest.approx(150, rel=0.1)


def test_charge_is_clipped_and_data_numbers_are_rounded():
    clipped, full = sca.saturate(np.array([9e4, 1.2e5]), np.array([1e5, 1.1e5]))
    assert (clipped.tolist(), full.tolist()) == ([9e4, 1.1e5], [False, True])
    numbers = sca.digitise(np.array([0.0, 160.0, -2e4, 1e6]), np.full(4, 1.6), np.full(4, 6700.0))
    assert numbers.dtype == np.uint16
    assert numbers.tolist() == [6700, 6800, 0, 65535]
