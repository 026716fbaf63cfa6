"""Calibration files: the layout of the paper's table 1, statistics of what is made up, and clear words on bad ones."""

import numpy as np
import pytest
from astropy.io import fits
from conftest import command

from romandask.calibration import check_files, make_files
from romandask.formats import calibration
from romandask.formats.calibration import TABLE, check, flat, path_of, read
from romandask.kernels import synthetic_sca as sca
from romandask.kernels.sca import STIMULI
from romandask.kernels.synthetic_sca import ADJACENT, BAD_BITS, DISCONNECTED, HOT, LOW_EFFICIENCY, NOISY, REFERENCE
from romandask.model.errors import UserError
from romandask.model.seeds import rng


@pytest.fixture(scope="module")
def made(tmp_path_factory):
    """The calibration file of SCA 3, at full size."""
    folder = tmp_path_factory.mktemp("calibration")
    (path,) = make_files(folder, 7, [3])
    yield path
    path.unlink()


def test_extensions_are_those_of_table_1_in_their_order(made):
    check(made)
    assert check_files(made.parent) == [made]
    with fits.open(made) as file:
        assert file[0].header["DETECTOR"] == 3
        assert [hdu.name for hdu in file[1:]] == [extension.name for extension in TABLE]
        assert set(file["SOURCES"].data["EXTNAME"]) >= {"RELQE1", "BIAS"}
        assert file["VTPE"].header["VALID"] is False
        assert file["BIAS"].header["BITPIX"] == 16
    assert not list(made.parent.glob(".*partial"))


def test_values_are_the_generators_whatever_else_is_made(made):
    def of(name):
        return rng(7, "calibration", 3, name)

    np.testing.assert_array_equal(read(made, "GAIN"), sca.gain(of))
    np.testing.assert_array_equal(read(made, "BIAS"), sca.bias(of))
    bits = read(made, "BADPIX")
    np.testing.assert_array_equal(bits, sca.bad_pixels(of))
    np.testing.assert_array_equal(read(made, "DARK"), sca.dark_current(of, bits))
    assert (sca.gain(of) != sca.gain(lambda name: rng(7, "calibration", 4, name))).all()


def test_made_up_detectors_have_the_statistics_of_real_ones(made):
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
    # at full well the signal still grows with the charge
    b = read(made, "CNL")
    assert (1 - 1.2e5 * (2 * b[0] + 1.2e5 * (3 * b[1] + 4 * 1.2e5 * b[2])) > 0.5).all()


def test_bad_pixels_have_footprints_and_what_makes_them_bad(made):
    bits = read(made, "BADPIX")
    inner = bits[4:-4, 4:-4]
    for bit, share in ((DISCONNECTED, 3e-4), (HOT, 1e-3), (LOW_EFFICIENCY, 8e-4), (NOISY, 2e-3)):
        assert np.mean(inner & bit > 0) == pytest.approx(share, rel=0.1)
    y, x = np.nonzero(bits & HOT)
    assert (bits[y, np.minimum(x + 1, 4095)] & (ADJACENT | REFERENCE) > 0).all()
    assert (read(made, "DARK")[y, x] >= 1).all()
    weak = bits & LOW_EFFICIENCY > 0
    assert (read(made, "RELQE1")[weak] <= 0.8).all()
    border = np.ones(bits.shape, bool)
    border[4:-4, 4:-4] = False
    assert (bits[border] & REFERENCE > 0).all()
    assert not (inner & REFERENCE).any()
    assert sum(BAD_BITS.values()) == 63


def test_flat_kernels_lie_block_beside_block(made):
    kernels = read(made, "BFE")
    side_by_side = read(made, "BFEFLAT")
    np.testing.assert_array_equal(side_by_side[5 * 3 : 5 * 4, 5 * 8 : 5 * 9], kernels[:, :, 3, 8])
    np.testing.assert_array_equal(read(made, "IPCFLAT"), flat(read(made, "IPC")))


def test_a_damaged_value_is_found(made):
    with fits.open(made) as file:
        place = file["GAIN"].fileinfo()["datLoc"] + 77
    with open(made, "r+b") as raw:
        raw.seek(place)
        byte = raw.read(1)
        raw.seek(place)
        raw.write(bytes([byte[0] ^ 4]))
    try:
        with pytest.raises(UserError, match="GAIN is damaged"):
            read(made, "GAIN")
    finally:
        with open(made, "r+b") as raw:
            raw.seek(place)
            raw.write(byte)
    read(made, "GAIN")


def test_bad_files_are_said_in_one_line(tmp_path):
    path = path_of(tmp_path, 1)
    with pytest.raises(UserError, match=r"no calibration file \(sca01.fits to sca18.fits\)"):
        check_files(tmp_path)
    path.write_text("not FITS")
    with pytest.raises(UserError, match="sca01.fits: not a FITS file"):
        check(path)
    every = [fits.ImageHDU(name=extension.name) for extension in TABLE]
    fits.HDUList([fits.PrimaryHDU(), *every[:-1]]).writeto(path, overwrite=True)
    with pytest.raises(UserError, match="extensions BIAS are missing"):
        check(path)
    fits.HDUList([fits.PrimaryHDU(), *every]).writeto(path, overwrite=True)
    with pytest.raises(UserError, match=r"RELQE1 has shape \(\), expected \(4096, 4096\)"):
        check(path)
    fits.HDUList([fits.PrimaryHDU(), every[1], every[0], *every[2:]]).writeto(path, overwrite=True)
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


def test_the_generator_refuses_before_it_writes(tmp_path, monkeypatch):
    with pytest.raises(UserError, match="SCA 19: Roman has 1 to 18"):
        list(make_files(tmp_path / "out", 1, [1, 19]))
    monkeypatch.setattr("romandask.calibration.BYTES", 1 << 60)
    with pytest.raises(UserError, match="2 files need"):
        list(make_files(tmp_path / "out", 1, [1, 2]))
    assert not list(tmp_path.glob("out/*"))
    assert calibration.BY_NAME["CNL"].shape == (3, 4096, 4096)


def test_the_command_line_says_what_is_wrong(tmp_path):
    done = command("calibration", "check", str(tmp_path))
    assert (done.returncode, done.stdout) == (2, "")
    assert done.stderr.startswith("error: ")
    done = command("calibration", "make", str(tmp_path / "o"), "--sca", "30")
    assert done.returncode == 2
    assert "SCA 30" in done.stderr
