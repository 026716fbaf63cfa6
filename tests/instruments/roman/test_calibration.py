"""Calibration files: the layout of Troxel et al. (2023), table 1, statistics of synthetic SCAs, and error messages."""

from functools import partial

import numpy as np
import pytest
from astropy.io import fits
from conftest import command
from scipy import stats

from romandask.instruments.roman import calibration_files
from romandask.instruments.roman.calibration import check_files, make_files
from romandask.instruments.roman.calibration_files import TABLE, check, flat, path_of, read
from romandask.kernels.detectors import sca as sca_effects
from romandask.kernels.detectors import synthetic_sca as sca
from romandask.kernels.detectors.sca import STIMULI
from romandask.kernels.detectors.sca_exposure import (
    DISCONNECTED_FLAG,
    HOT_FLAG,
    Response,
    accumulate,
    calibrate,
    poisson,
    read_out,
)
from romandask.kernels.detectors.simple_detector import PERSISTENCE, Detector, observe
from romandask.kernels.detectors.synthetic_sca import (
    ADJACENT,
    BAD_BITS,
    DISCONNECTED,
    HOT,
    LOW_EFFICIENCY,
    NOISY,
    REFERENCE,
)
from romandask.model.errors import UserError
from romandask.model.seeds import rng


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The calibration file of SCA 3, at full size."""
    folder = tmp_path_factory.mktemp("calibration")
    (path,) = make_files(folder, 7, [3])
    yield path
    path.unlink()


@pytest.mark.slow
def test_files_have_the_extensions_of_table_1_in_order(made):
    check(made)
    assert check_files(made.parent) == [made]
    with fits.open(made) as file:
        assert file[0].header["DETECTOR"] == 3
        assert [hdu.name for hdu in file[1:]] == [extension.name for extension in TABLE]
        assert set(file["SOURCES"].data["EXTNAME"]) >= {"RELQE1", "BIAS"}
        assert file["VTPE"].header["VALID"] is False
        assert file["BIAS"].header["BITPIX"] == 16
    assert not list(made.parent.glob(".*partial"))


def test_values_depend_only_on_the_seed_and_the_sca(made):
    def generator(name):
        return rng(7, "calibration", 3, name)

    np.testing.assert_array_equal(read(made, "GAIN"), sca.gain(generator))
    np.testing.assert_array_equal(read(made, "BIAS"), sca.bias(generator))
    bits = read(made, "BADPIX")
    np.testing.assert_array_equal(bits, sca.bad_pixels(generator))
    np.testing.assert_array_equal(read(made, "DARK"), sca.dark_current(generator, bits))
    assert (sca.gain(generator) != sca.gain(lambda name: rng(7, "calibration", 4, name))).all()


@pytest.mark.slow
def test_synthetic_detectors_have_the_statistics_of_real_ones(made):
    gain, well, bias = read(made, "GAIN"), read(made, "SATURATE"), read(made, "BIAS").astype(float)
    assert gain.mean() == pytest.approx(1.6, rel=0.02)
    assert well.mean() == pytest.approx(1.1e5, rel=1e-3)
    assert well.std() == pytest.approx(0.04 * 1.1e5, rel=0.01)
    # 32 readout channels, stripes of 128 columns
    stripes = bias.reshape(4096, 32, 128).mean(axis=(0, 2))
    assert bias.mean() == pytest.approx(6700, abs=150)
    assert 80 < stripes.std() < 250
    assert bias.reshape(4096, 32, 128)[:, 5].std() == pytest.approx(60, rel=0.02)
    assert np.median(read(made, "DARK")[4:-4, 4:-4]) == pytest.approx(0.015, rel=0.01)
    noise = read(made, "READ")[2]
    assert np.median(noise) == pytest.approx(8.5, rel=0.01)
    kernels = read(made, "IPC")
    np.testing.assert_allclose(kernels.sum(axis=(0, 1)), 1, atol=1e-6)
    assert kernels[1, 1].mean() == pytest.approx(0.94, abs=2e-3)
    areas = read(made, "BFE")
    assert areas[2, 2].mean() == pytest.approx(-2.04e-6, rel=0.01)
    assert 0.36e-6 < areas[2, 1].mean() < 0.43e-6
    np.testing.assert_allclose(areas.sum(axis=(0, 1)), 0, atol=1e-12)
    persistence = read(made, "PERSIST")[:, 100:200, 100:200]
    assert (np.diff(persistence, axis=0) > 0).all()
    assert len(persistence) == len(STIMULI)
    # the signal increases with the charge up to the full well
    b = read(made, "CNL")
    assert (1 - 1.2e5 * (2 * b[0] + 1.2e5 * (3 * b[1] + 4 * 1.2e5 * b[2])) > 0.5).all()


def test_bad_pixels_have_neighbours_and_the_properties_of_their_bits(made):
    bits = read(made, "BADPIX")
    inner = bits[4:-4, 4:-4]
    for bit, share in ((DISCONNECTED, 3e-4), (HOT, 1e-3), (LOW_EFFICIENCY, 8e-4), (NOISY, 2e-3)):
        assert np.mean(inner & bit > 0) == pytest.approx(share, rel=0.1)
    y, x = np.nonzero(bits & HOT)
    assert (bits[y, np.minimum(x + 1, 4095)] & (ADJACENT | REFERENCE) > 0).all()
    assert (read(made, "DARK")[y, x] >= 1).all()
    low_efficiency = bits & LOW_EFFICIENCY > 0
    assert (read(made, "RELQE1")[low_efficiency] <= 0.8).all()
    border = np.ones(bits.shape, bool)
    border[4:-4, 4:-4] = False
    assert (bits[border] & REFERENCE > 0).all()
    assert not (inner & REFERENCE).any()
    assert sum(BAD_BITS.values()) == 63


def test_flat_extensions_hold_kernels_side_by_side(made):
    kernels = read(made, "BFE")
    side_by_side = read(made, "BFEFLAT")
    np.testing.assert_array_equal(side_by_side[5 * 3 : 5 * 4, 5 * 8 : 5 * 9], kernels[:, :, 3, 8])
    np.testing.assert_array_equal(read(made, "IPCFLAT"), flat(read(made, "IPC")))


def test_a_damaged_value_is_detected(made):
    with fits.open(made) as file:
        offset = file["GAIN"].fileinfo()["datLoc"] + 77
    with open(made, "r+b") as raw:
        raw.seek(offset)
        byte = raw.read(1)
        raw.seek(offset)
        raw.write(bytes([byte[0] ^ 4]))
    try:
        with pytest.raises(UserError, match="GAIN is damaged"):
            read(made, "GAIN")
    finally:
        with open(made, "r+b") as raw:
            raw.seek(offset)
            raw.write(byte)
    read(made, "GAIN")


@pytest.fixture(scope="module")
def planes(made):
    """The calibrations in memory, as a `Planes` function."""
    dtypes = {"CNL": np.float32, "READ": np.float32}
    names = [extension.name for extension in TABLE if extension.dtype and not extension.name.endswith("FLAT")]
    values = {name: read(made, name).astype(dtypes.get(name, calibration_files.BY_NAME[name].dtype)) for name in names}

    def get(name, rows):
        return values[name] if name in ("BFE", "IPC", "GAIN") else values[name][..., rows, :]

    values["READ"] = values["READ"][2]
    return get


@pytest.fixture(scope="module")
def response():
    """Response in a band where efficiency and yield are 1."""
    return Response(np.ones((64, 64), np.float32), np.ones((32, 32), np.float32), 139.8)


def expose(light, planes, response, generators, persistence=None):
    """Return data numbers and dq of an exposure."""
    return read_out(accumulate(light, planes, response, generators), planes, response, generators, persistence)


def generators(name, block):
    return rng(1, "exposures", name, block)


@pytest.mark.slow
def test_a_dark_exposure_has_the_moments_of_its_calibrations(planes, response):
    numbers, dq = expose(np.zeros((4088, 4088), np.float32), planes, response, generators)
    inner = (slice(4, -4), slice(4, -4))
    gain = sca_effects.expand(planes("GAIN", slice(None)), 128, slice(0, 4096))[inner]
    signal = (numbers.astype(float) - planes("BIAS", slice(0, 4096))[inner]) * gain
    good = dq == 0
    dark, read_noise = planes("DARK", slice(0, 4096))[inner] * 139.8, planes("READ", slice(0, 4096))[inner]
    # interpixel capacitance moves a little charge of hot pixels to their unflagged diagonal neighbours
    assert signal[good].mean() == pytest.approx(dark[good].mean(), abs=0.05)
    variance = dark[good].mean() * 0.887 + np.mean(read_noise[good] ** 2) + np.mean(gain[good] ** 2) / 12
    # interpixel capacitance averages the noise of the dark current over neighbours: 0.94^2 + 4 * 0.0135^2 + ...
    assert signal[good].var() == pytest.approx(variance + dark[good].var() * 0.89, rel=5e-3)
    hot = dq & HOT_FLAG > 0
    assert np.median(signal[hot]) == pytest.approx(np.median(0.94 * np.minimum(dark[hot], 1.1e5)), rel=0.1)
    disconnected = dq & DISCONNECTED_FLAG > 0
    assert signal[disconnected].mean() == pytest.approx(0, abs=1)
    again, _ = expose(np.zeros((4088, 4088), np.float32), planes, response, generators)
    np.testing.assert_array_equal(again, numbers)


@pytest.mark.slow
def test_calibration_recovers_a_flat_and_its_variance(planes, response):
    light = np.full((4088, 4088), 185.0, np.float32)
    numbers, dq = expose(light, planes, response, generators)
    image, variance = calibrate(numbers, planes, response)
    good = dq == 0
    assert good.mean() > 0.985
    assert image[good].mean() == pytest.approx(185, rel=1e-3)
    assert ((image[good] - 185) / np.sqrt(variance[good])).std() == pytest.approx(1, abs=0.015)
    # persistence is added to the image and flagged
    persistence = np.zeros((4088, 4088), np.float32)
    persistence[1000:1100, 500:600] = 2.0
    numbers, flags = expose(light, planes, response, generators, persistence)
    square = (slice(1000, 1100), slice(500, 600))
    assert (flags[square] & PERSISTENCE > 0).all()
    assert (flags & PERSISTENCE > 0).sum() == 10_000
    change = calibrate(numbers, planes, response)[0][square] - image[square]
    # the median excludes pixels of low efficiency
    assert np.median(change) == pytest.approx(2 * 139.8, rel=0.02)


@pytest.mark.slow
def test_fluxes_of_stars_agree_with_the_simple_detector(planes, response):
    """From 17 to 22 mag, to 0.3%, in apertures that contain the charge moved by the brighter-fatter effect."""
    side, sky = 32, 100.0
    y, x = np.indices((side, side)) - 15.6
    spot = np.exp(-(x**2 + y**2) / (2 * 1.3**2))
    spot = (spot / spot.sum()).astype(np.float32)
    n = 4088 // side
    level = np.arange(n * n).reshape(n, n) % 6
    fluxes = 8.4e5 * 10 ** (-0.4 * np.arange(6))
    light = np.zeros((4088, 4088), np.float32)
    tiles = light[: n * side, : n * side].reshape(n, side, n, side)
    tiles += fluxes[level].astype(np.float32)[:, None, :, None] * spot[None, :, None, :]
    numbers, dq = expose(light + np.float32(sky), planes, response, generators)
    image, _ = calibrate(numbers, planes, response)
    simple, _ = observe(light, np.float32(sky), Detector(1.1e5, 8.5), partial(rng, 1, "simple"))
    bad = dq.astype(bool)[: n * side, : n * side].reshape(n, side, n, side).transpose(0, 2, 1, 3)[..., 6:26, 6:26]
    clean = ~bad.any(axis=(2, 3))

    def aperture_flux(array):
        cut = array[: n * side, : n * side].reshape(n, side, n, side).transpose(0, 2, 1, 3)
        return (cut[..., 6:26, 6:26] - np.float32(sky)).sum(axis=(2, 3), dtype=float)

    full_model, simple_model = aperture_flux(image), aperture_flux(simple)
    for k, flux in enumerate(fluxes):
        chosen = clean & (level == k)
        assert chosen.sum() > 50, k
        scatter = simple_model[chosen].std() / np.sqrt(chosen.sum()) / flux
        assert full_model[chosen].mean() / simple_model[chosen].mean() == pytest.approx(
            1, abs=max(0.003, 4 * scatter)
        ), k


def test_poisson_numbers_have_the_poisson_distribution():
    mean = np.repeat(np.array([0.0, 0.3, 2.1, 15.0, 400.0], np.float32), 200_000).reshape(5, -1)
    numbers = poisson(mean, rng(1, "poisson"))
    assert (numbers[0] == 0).all()
    for row, expected in zip(numbers[1:], mean[1:, 0], strict=True):
        assert row.mean() == pytest.approx(float(expected), abs=5 * float(np.sqrt(expected / 200_000)))
        assert row.var() == pytest.approx(float(expected), rel=0.02)
    share = np.mean(numbers[2][:, None] == np.arange(8), axis=0)
    np.testing.assert_allclose(share, stats.poisson.pmf(np.arange(8), 2.1), atol=5e-3)


def test_errors_of_bad_files(tmp_path):
    path = path_of(tmp_path, 1)
    with pytest.raises(UserError, match=r"no calibration file \(sca01.fits to sca18.fits\)"):
        check_files(tmp_path)
    path.write_text("not FITS")
    with pytest.raises(UserError, match="sca01.fits: not a FITS file"):
        check(path)
    hdus = [fits.ImageHDU(name=extension.name) for extension in TABLE]
    fits.HDUList([fits.PrimaryHDU(), *hdus[:-1]]).writeto(path, overwrite=True)
    with pytest.raises(UserError, match="extensions BIAS are missing"):
        check(path)
    fits.HDUList([fits.PrimaryHDU(), *hdus]).writeto(path, overwrite=True)
    with pytest.raises(UserError, match=r"RELQE1 has shape \(\), expected \(4096, 4096\)"):
        check(path)
    fits.HDUList([fits.PrimaryHDU(), hdus[1], hdus[0], *hdus[2:]]).writeto(path, overwrite=True)
    with pytest.raises(UserError, match="extensions are RELQE1, SOURCES"):
        check(path)
    hdu = fits.ImageHDU(np.zeros((32, 32)), name="GAIN")
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path, overwrite=True)
    with pytest.raises(UserError, match="GAIN has BITPIX -64 and BZERO 0, expected -32 and 0"):
        read(path, "GAIN")
    hdu = fits.ImageHDU(np.full((32, 32), np.nan, np.float32), name="GAIN")
    fits.HDUList([fits.PrimaryHDU(), hdu]).writeto(path, overwrite=True)
    with pytest.raises(UserError, match="GAIN has 1024 values that are not finite"):
        read(path, "GAIN")
    with pytest.raises(UserError, match="DARK cannot be read"):
        read(path, "DARK")


def test_make_files_checks_its_arguments_before_it_writes(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="SCA 19: Roman has 1 to 18"):
        list(make_files(tmp_path / "out", 1, [1, 19]))
    monkeypatch.setattr("romandask.instruments.roman.calibration.BYTES", 1 << 60)
    with pytest.raises(UserError, match="2 files need"):
        list(make_files(tmp_path / "out", 1, [1, 2]))
    assert not list(tmp_path.glob("out/*"))
    assert calibration_files.BY_NAME["CNL"].shape == (3, 4096, 4096)


@pytest.mark.slow
def test_errors_of_the_commands(tmp_path):
    done = command("calibration", "check", str(tmp_path))
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: ")
    done = command("calibration", "make", str(tmp_path / "o"), "--sca", "30")
    assert done.returncode == 2
    assert "SCA 30" in done.stderr
