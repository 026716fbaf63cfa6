"""Detection and photometry of one image, compared with Source Extractor, NumPy and SciPy."""

import shutil
import subprocess
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import sep
from astropy.io import fits
from scipy import ndimage
from scipy.spatial import cKDTree

from romandask.kernels.measurement import psf_fit
from romandask.kernels.measurement.detected_objects import FLAGS, NOT_DEBLENDED, DetectedObjects
from romandask.kernels.measurement.extract import detect
from romandask.kernels.measurement.measurement_image import (
    MeasurementImage,
    errors,
    median,
    weighted_mean,
)
from romandask.kernels.measurement.noise import noise_ratios, rms_of, scatter
from romandask.kernels.measurement.photometry import ellipse_flux, kron_fluxes, psf_fluxes

SIDE, SEXTRACTOR = 1000, Path("/usr/share/source-extractor")


def field(seed: int = 3, count: int = 900) -> np.ndarray:
    """Return a noiseless image (SIDE, SIDE) of exponential galaxies convolved with a Gaussian PSF."""
    random = np.random.default_rng(seed)
    image = np.zeros((SIDE, SIDE), np.float32)
    offset = np.arange(-30, 31)
    for _ in range(count):
        x, y = random.uniform(35, SIDE - 36, 2)
        flux, size = 10 ** random.uniform(1.8, 4.2), random.uniform(0.8, 2.5)
        angle, ratio = random.uniform(0, np.pi), random.uniform(0.4, 1)
        column, row = int(x), int(y)
        u, v = np.meshgrid(offset - (x - column), offset - (y - row))
        a, b = u * np.cos(angle) + v * np.sin(angle), -u * np.sin(angle) + v * np.cos(angle)
        stamp = np.exp(-np.hypot(a, b / ratio) / size)
        image[row - 30 : row + 31, column - 30 : column + 31] += (flux / stamp.sum() * stamp).astype(np.float32)
    return ndimage.gaussian_filter(image, 1.3)


def measurement_of(image: np.ndarray, noise: np.ndarray, weight: np.ndarray) -> MeasurementImage:
    error, mask = errors(weight.astype(np.float32), rms_of(noise, weight))
    psf = np.zeros((41, 41), np.float32)
    psf[20, 20] = 1
    return MeasurementImage(
        image=image,
        error=error,
        mask=mask,
        aperture_ratios=noise_ratios(noise[None], error[None], mask[None]),
        psf=ndimage.gaussian_filter(psf, 1.3),
    )


@pytest.fixture(scope="module")
def noisy() -> MeasurementImage:
    random = np.random.default_rng(1)
    image = field() + random.normal(0, 1, (SIDE, SIDE)).astype(np.float32)
    return measurement_of(image, random.normal(0, 1, (SIDE, SIDE)).astype(np.float32), np.ones((SIDE, SIDE)))


def test_objects_and_fluxes_agree_with_source_extractor(noisy, tmp_path):
    program = shutil.which("source-extractor")
    if program is None:
        pytest.fail("Source Extractor is not installed: apt-get install source-extractor")
    fits.writeto(tmp_path / "image.fits", noisy.image)
    fits.writeto(tmp_path / "rms.fits", noisy.error)
    names = ["X_IMAGE", "Y_IMAGE", "XWIN_IMAGE", "YWIN_IMAGE", "FLUX_AUTO", "FLUXERR_AUTO", "FLAGS"]
    (tmp_path / "list.param").write_text("\n".join(names) + "\n")
    settings = {
        "CATALOG_NAME": "found.cat",
        "CATALOG_TYPE": "ASCII",
        "PARAMETERS_NAME": "list.param",
        "FILTER_NAME": SEXTRACTOR / "default.conv",
        "STARNNW_NAME": SEXTRACTOR / "default.nnw",
        "DETECT_THRESH": 2.5,
        "ANALYSIS_THRESH": 2.5,
        "DETECT_MINAREA": 5,
        "DEBLEND_NTHRESH": 48,
        "DEBLEND_MINCONT": 0.05,
        "BACK_TYPE": "MANUAL",
        "BACK_VALUE": 0,
        "WEIGHT_TYPE": "MAP_RMS",
        "WEIGHT_IMAGE": "rms.fits",
        "WEIGHT_GAIN": "N",
        "GAIN": 0,
        "PHOT_AUTOPARAMS": "2.5,3.5",
        "VERBOSE_TYPE": "QUIET",
    }
    arguments = [text for name, value in settings.items() for text in (f"-{name}", str(value))]
    done = subprocess.run(
        [program, "image.fits", "-c", str(SEXTRACTOR / "default.sex"), *arguments],
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
        timeout=120,
    )
    assert done.returncode == 0, done.stderr
    sextractor = np.loadtxt(tmp_path / "found.cat")
    objects, segments = detect(noisy, 2.5, 5, 48, 0.05, 0.0)
    tree = cKDTree(np.c_[objects.x, objects.y])
    # x and y are windowed positions, or barycentres where the window moves away
    queries = [tree.query(sextractor[:, columns] - 1) for columns in ([0, 1], [2, 3])]
    distance = np.min([distances for distances, _ in queries], axis=0)
    nearest = np.where(queries[0][0] < queries[1][0], queries[0][1], queries[1][1])
    assert len(sextractor) > 500
    assert (distance < 1).mean() > 0.98
    assert len(objects.x) == pytest.approx(len(sextractor), rel=0.02)
    flux, _, _ = kron_fluxes(noisy, segments, objects)
    matched = (distance < 1) & (sextractor[:, 4] > 20 * sextractor[:, 5])
    difference = -2.5 * np.log10(flux[nearest[matched]] / sextractor[matched, 4])
    assert matched.sum() > 200
    assert abs(np.median(difference)) < 0.001
    assert (np.abs(difference) < 0.02).mean() > 0.99


def test_errors_agree_with_the_scatter_in_correlated_noise():
    """The noise of a drizzled image is smooth: errors for white noise of the same rms would be half as large."""
    random = np.random.default_rng(5)
    noise, other = (
        ndimage.gaussian_filter(random.normal(0, 1, (SIDE, SIDE)), 0.8).astype(np.float32) for _ in range(2)
    )
    weight = np.ones((SIDE, SIDE))
    weight[:, : SIDE // 2] = 2.0
    noise, other = (np.asarray(plane / np.sqrt(weight), np.float32) for plane in (noise, other))
    measurement = measurement_of(other, noise, weight)
    measurement = replace(measurement, psf_ratio=scatter(noise[None], measurement.psf, measurement.error[None]))
    x, y = random.uniform(40, SIDE - 40, (2, 3000))
    for radius in (2.0, 5.0, 11.0):
        ones, no_segments = np.ones(len(x)), np.zeros((SIDE, SIDE), np.int32)
        flux, error, _ = ellipse_flux(
            measurement, no_segments, ones.astype(int), x, y, ones, ones, 0 * ones, radius * ones
        )
        assert np.std(flux / error) == pytest.approx(1, abs=0.1)
    unused = {name: np.zeros(len(x)) for name in DetectedObjects.__dataclass_fields__ if name not in ("x", "y")}
    flux, error = psf_fluxes(measurement, DetectedObjects(x=x, y=y, **unused))
    assert np.std(flux / error) == pytest.approx(1, abs=0.1)


def test_the_segmentation_map_has_the_objects_and_a_deblending_overflow_is_flagged(noisy, monkeypatch):
    objects, segments = detect(noisy, 2.5, 5, 48, 0.05, 0.0)
    ix, iy = np.rint(objects.x).astype(int), np.rint(objects.y).astype(int)
    assert (segments[iy, ix] == objects.label).mean() > 0.9
    assert set(np.unique(segments)) == {0, *objects.label}
    extract = sep.extract

    def crowded(*arguments, deblend_cont, **named):
        if deblend_cont < 1:
            raise Exception("object deblending overflow")
        return extract(*arguments, deblend_cont=deblend_cont, **named)

    monkeypatch.setattr(sep, "extract", crowded)
    flagged, _ = detect(noisy, 2.5, 5, 48, 0.05, 0.0)
    assert (flagged.flags & NOT_DEBLENDED > 0).all()
    assert FLAGS["not_deblended"] == NOT_DEBLENDED
    assert 0.7 * len(objects.x) < len(flagged.x) <= len(objects.x)


@pytest.mark.parametrize("bands", [1, 2, 3, 4, 5, 6])
def test_the_median_agrees_with_numpy_for_the_bands_with_data(bands):
    random = np.random.default_rng(bands)
    planes = random.normal(size=(bands, 60, 70)).astype(np.float32)
    weights = random.uniform(0.5, 1, planes.shape).astype(np.float32)
    weights[random.random(planes.shape) < 0.3] = 0
    medians = median(list(planes), list(weights))
    has_data = (weights > 0).any(axis=0)
    expected = np.nanmedian(np.where(weights > 0, planes, np.nan)[:, has_data], axis=0)
    np.testing.assert_allclose(medians[has_data], expected, atol=1e-6)
    assert not medians[~has_data].any()


def test_the_mean_weights_bands_by_inverse_variance():
    planes = [np.full((3, 4), value, np.float32) for value in (1.0, 3.0)]
    weights = [np.full((3, 4), 2.0, np.float32), np.full((3, 4), 5.0, np.float32)]
    weights[1][0] = 0
    mean, total = weighted_mean(planes, weights, [2.0, 1.0])
    np.testing.assert_allclose(mean[0], 1)
    np.testing.assert_allclose(mean[1:], (0.5 * 1 + 5 * 3) / 5.5)
    np.testing.assert_allclose(total[1:], 5.5)


@pytest.mark.parametrize("side", [71, 25, 9])
def test_psf_fits_agree_with_scipys_spline(side):
    random = np.random.default_rng(5)
    offset = np.arange(side) - (side - 1) / 2
    psf = np.exp(-(offset[:, None] ** 2 + offset**2) / 6) + 0.01 * random.random((side, side))
    image = random.normal(size=(90, 120)).astype(np.float32)
    x, y = random.uniform(-3, 123, 300), random.uniform(-3, 93, 300)
    x[:20], y[:2] = np.rint(x[:20]), np.rint(y[:2])
    flux, norm = psf_fit.fit(image, psf, x, y)
    inside = 0
    for n in range(300):
        ix, iy = round(x[n]), round(y[n])
        if not (12 <= ix < 108 and 12 <= iy < 78):
            assert np.isnan(flux[n])
            assert norm[n] == 0
            continue
        inside += 1
        v, u = np.mgrid[-12:13, -12:13]
        positions = [v + (side - 1) / 2 + iy - y[n], u + (side - 1) / 2 + ix - x[n]]
        model = ndimage.map_coordinates(psf, positions, order=5)
        assert norm[n] == pytest.approx((model**2).sum(), rel=1e-10)
        data = image[iy - 12 : iy + 13, ix - 12 : ix + 13]
        assert flux[n] == pytest.approx((model * data).sum() / (model**2).sum(), rel=1e-9, abs=1e-12)
    assert inside > 100
