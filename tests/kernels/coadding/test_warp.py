"""Lanczos interpolation onto a tile, compared with explicit sums and with images drawn by GalSim."""

import galsim
import numpy as np
import pytest
from astropy.wcs import WCS

from romandask.kernels.coadding.coadd_psf import warped_psf
from romandask.kernels.coadding.pixel_map import bounds, pixel_map, strips
from romandask.kernels.coadding.warp import REACH, Means, lanczos_weights
from romandask.model.seeds import rng
from romandask.model.tiles import tangent_header


def frames(angle: float = 25.0, side: int = 120) -> tuple[WCS, WCS, tuple[int, int]]:
    """Return the WCS of a tile, the WCS of an exposure rotated and shifted against it, and the exposure's shape."""
    tile = WCS(tangent_header(53.0, -40.0, side, 0.2))
    rotation, step = np.radians(angle), 0.2 / 3600
    header = {
        "CTYPE1": "RA---TAN",
        "CTYPE2": "DEC--TAN",
        "CRVAL1": 53.0008,
        "CRVAL2": -39.9997,
        "CRPIX1": 70.3,
        "CRPIX2": 64.1,
        "CD1_1": -step * np.cos(rotation),
        "CD1_2": step * np.sin(rotation),
        "CD2_1": step * np.sin(rotation),
        "CD2_2": step * np.cos(rotation),
    }
    return tile, WCS(header), (130, 140)


def warped(planes, bad, marked=None, weight=2.0, side=120):
    """Return the sums after adding one exposure to a tile, and the number of tile pixels that it contributes to."""
    tile, frame, shape = frames(side=side)
    sums = Means((side, side), len(planes))
    onto = pixel_map(tile, frame, slice(0, side), slice(0, side))
    onto = onto.part(*bounds(strips(onto, (slice(0, shape[0]), slice(0, shape[1])))))
    marked = np.zeros(shape, bool) if marked is None else marked
    covered = sums.add(planes, bad, marked, weight, onto, (0, 0))
    return sums, covered


def positions(side=120):
    """Return x and y on the exposure of all tile pixels."""
    tile, frame, _ = frames(side=side)
    v, u = np.mgrid[:side, :side]
    x, y = frame.all_world2pix(*tile.all_pix2world(u.ravel(), v.ravel(), 0), 0)
    return x.reshape(side, side), y.reshape(side, side)


def test_a_tile_pixel_is_the_weighted_sum_of_six_by_six_pixels():
    shape = frames()[2]
    image = rng(1, "image").normal(10, 3, shape).astype(np.float32)
    bad = rng(1, "bad").random(shape) < 0.002
    sums, covered = warped(image[None], bad)
    mean = sums.means()[0]
    x, y = positions()
    count = 0
    for v, u in np.ndindex(mean.shape):
        i, j = int(np.floor(x[v, u])) - 2, int(np.floor(y[v, u])) - 2
        inside = i >= 0 and j >= 0 and i + 6 <= shape[1] and j + 6 <= shape[0]
        if not inside or bad[j : j + 6, i : i + 6].any():
            assert sums.weight[v, u] == 0
            assert mean[v, u] == 0
            continue
        across = np.sinc(x[v, u] - i - np.arange(6)) * np.sinc((x[v, u] - i - np.arange(6)) / REACH)
        up = np.sinc(y[v, u] - j - np.arange(6)) * np.sinc((y[v, u] - j - np.arange(6)) / REACH)
        expected = up / up.sum() @ image[j : j + 6, i : i + 6] @ (across / across.sum())
        assert mean[v, u] == pytest.approx(expected, abs=2e-4)
        assert sums.weight[v, u] == 2.0
        assert sums.count[v, u] == 1
        count += 1
    assert count == covered > 5000


def test_weights_sum_to_one_and_select_one_pixel_at_its_centre():
    weights = lanczos_weights(np.array([0.0, 0.3, 1.0]))
    np.testing.assert_allclose(weights.sum(axis=1), 1)
    np.testing.assert_allclose(weights[0], [0, 0, 1, 0, 0, 0], atol=1e-12)
    np.testing.assert_allclose(weights[2], [0, 0, 0, 1, 0, 0], atol=1e-12)


def test_a_star_keeps_its_position_flux_and_shape():
    """Compare a Moffat star drawn by GalSim on the exposure, then warped, with the same star drawn on the tile."""
    tile, frame, shape = frames()
    star = galsim.Moffat(beta=3, fwhm=0.7, flux=1000.0).shear(g1=0.05, g2=-0.03)
    image = np.zeros(shape, np.float32)
    x, y = frame.all_world2pix(53.0004, -39.9999, 0)
    local = galsim.AstropyWCS(wcs=frame).local(galsim.PositionD(float(x) + 1, float(y) + 1))
    frame_image = galsim.ImageF(image, xmin=0, ymin=0, wcs=local)
    star.drawImage(frame_image, center=galsim.PositionD(float(x), float(y)), wcs=local)
    sums, _ = warped(image[None] / 0.04, np.zeros(shape, bool))
    warped_star = sums.means()[0] * 0.04
    u, v = tile.all_world2pix(53.0004, -39.9999, 0)
    tile_local = galsim.AstropyWCS(wcs=tile).local(galsim.PositionD(float(u) + 1, float(v) + 1))
    expected = galsim.ImageF(120, 120, xmin=0, ymin=0, wcs=tile_local)
    star.drawImage(expected, center=galsim.PositionD(float(u), float(v)), wcs=tile_local)
    peak = expected.array.max()
    assert np.abs(warped_star - expected.array)[5:-5, 5:-5].max() < 0.01 * peak
    assert warped_star.sum() == pytest.approx(expected.array.sum(), rel=3e-3)
    moments = [galsim.hsm.FindAdaptiveMom(galsim.ImageF(star)) for star in (warped_star, expected.array.copy())]
    assert moments[0].moments_sigma == pytest.approx(moments[1].moments_sigma, rel=5e-3)
    assert moments[0].moments_centroid.x == pytest.approx(moments[1].moments_centroid.x, abs=2e-3)
    assert moments[0].observed_shape.g1 == pytest.approx(moments[1].observed_shape.g1, abs=2e-3)


def test_means_are_weighted_and_marks_surround_marked_pixels():
    shape = frames()[2]
    bad, none = np.zeros(shape, bool), np.zeros(shape, bool)
    bad[60, 70] = True
    sums, _ = warped(np.ones((2, *shape), np.float32), bad, bad.copy(), weight=3.0)
    tile, frame, _ = frames()
    onto = pixel_map(tile, frame, slice(0, 120), slice(0, 120))
    onto = onto.part(*bounds(strips(onto, (slice(0, shape[0]), slice(0, shape[1])))))
    sums.add(np.full((2, *shape), 5, np.float32), none, none, 1.0, onto, (0, 0))
    both = sums.count == 2
    once = sums.count == 1
    mean = sums.means()
    np.testing.assert_allclose(mean[0][both], 2.0, rtol=1e-5)
    np.testing.assert_allclose(mean[1][once], 5.0, rtol=1e-5)
    assert 25 <= once.sum() <= 49
    np.testing.assert_array_equal(sums.marks, once)


def test_a_psf_rotates_with_its_exposure():
    """Compare the oversampled image of a sheared star, rotated by the Jacobian, with the star rotated by GalSim."""
    angle, star = 40 * galsim.degrees, galsim.Gaussian(sigma=1.5).shear(g1=0.2)
    seen = galsim.Convolve(star, galsim.Pixel(1.0))
    fine = seen.drawImage(nx=256, ny=256, scale=1 / 8, offset=(0.5, 0.5), method="no_pixel", dtype=float).array * 64
    rotation = np.array([[np.cos(angle), -np.sin(angle)], [np.sin(angle), np.cos(angle)]])
    psf = warped_psf(fine, 8, rotation, 25)
    expected = seen.rotate(angle).drawImage(nx=25, ny=25, scale=1, method="no_pixel", dtype=float).array
    np.testing.assert_allclose(psf, expected, atol=1e-4)
