"""PSFs of drizzled coadds, compared with GalSim stars drizzled by the drizzle package and with means over dithers."""

from dataclasses import replace
from types import SimpleNamespace

import galsim
import numpy as np
import pytest
from astropy.wcs import WCS
from drizzle.resample import Drizzle
from scipy.special import erf

from romandask.instruments.psf_image import flat_shares
from romandask.kernels.coadding.coadd_psf import drizzled_psf, native_star
from romandask.kernels.coadding.drizzle import Sums
from romandask.kernels.coadding.pixel_map import PixelMap, pixel_map
from romandask.model.errors import UserError
from romandask.stages.coadds.coadds import coadds
from romandask.stages.coadds.psf_at import coadd_psf

TURN = 1.9 * np.array([[np.cos(0.5), -np.sin(0.5)], [np.sin(0.5), np.cos(0.5)]])
"""Jacobian of the map from native pixels to tile pixels: 1.9 tile pixels per native pixel, rotated by 0.5 rad."""


def gaussian(sigma: float, oversampling: int = 8, side: int = 64) -> np.ndarray:
    """Return a Gaussian star convolved with native pixels, with `oversampling` samples per pixel."""
    offset = (np.arange(side * oversampling) - side * oversampling // 2) / oversampling
    ends = [erf((offset + half) / (sigma * np.sqrt(2))) / 2 for half in (0.5, -0.5)]
    return np.outer(ends[0] - ends[1], ends[0] - ends[1])


def test_a_drizzled_psf_is_the_mean_over_all_positions_in_a_pixel():
    fine, half, steps = gaussian(0.6), 12, 24
    sums = Sums((31, 31), 1, 0.7)
    knots = np.linspace(0, 2 * half, 4)
    for k in range(steps**2):
        x, y = (k % steps + 0.5) / steps - 0.5, (k // steps + 0.5) / steps - 0.5
        u, v = np.meshgrid(knots - half - x, knots - half - y)
        on_tile = np.stack([TURN[0, 0] * u + TURN[0, 1] * v + 15, TURN[1, 0] * u + TURN[1, 1] * v + 15])
        rows = slice(0, 2 * half + 1)
        star = native_star(fine, 8, half, x, y)
        sums.add([([star], np.ones(star.shape, np.float32), PixelMap(rows, rows, knots, knots, on_tile))])
    found = drizzled_psf(fine, 8, TURN, 0.7, 31)
    assert found.sum() == pytest.approx(1, abs=1e-3)
    np.testing.assert_allclose(found, sums.means()[0], atol=2e-3 * found.max())


def test_a_finer_step_samples_the_same_psf():
    fine = gaussian(0.6)
    coarse, half = drizzled_psf(fine, 8, TURN, 0.7, 31), drizzled_psf(fine, 8, TURN, 0.7, 61, 0.5)
    np.testing.assert_allclose(half[::2, ::2], coarse, atol=1e-6)


@pytest.mark.parametrize("position", [(0.5, 0.5), (0.3, 0.62)])
def test_a_star_on_a_coadd_equals_drizzled_galsim_stars(small, position):
    """GalSim draws the star on each exposure, and the drizzle package combines them with romandask's pixel maps."""
    product = coadds(small.product, small.tiles, small.settings)
    box = small.region
    ra = box.ra_min + position[0] * (box.ra_max - box.ra_min)
    dec = box.dec_min + position[1] * (box.dec_max - box.dec_min)
    found = coadd_psf(product, ra, dec, "H158", stamp=41)
    tile = next(tile for tile in small.tiles if tile.name == found.attrs["tile"])
    header = tile.header(product.make.pixels, small.roman.coadd_scale)
    x, y = (float(value) for value in WCS(header).all_world2pix(ra, dec, 0))
    low = np.rint([x - found.attrs["x"], y - found.attrs["y"]])
    target = WCS({**header, "CRPIX1": header["CRPIX1"] - low[0], "CRPIX2": header["CRPIX2"] - low[1]})
    oracle = Drizzle(kernel="square", fillval="0", out_shape=(81, 81), disable_ctx=True)
    wide = WCS({**header, "CRPIX1": header["CRPIX1"] - low[0] + 20, "CRPIX2": header["CRPIX2"] - low[1] + 20})
    shares, scale = flat_shares(small.roman.bandpass("H158")), small.roman.pixel_scale
    seen = [small.exposures[small.product.names.index(name)] for name in found.attrs["exposures"]]
    assert len(seen) >= 1
    for exposure in seen:
        source = WCS(small.roman.header(exposure))
        sx, sy = (float(value) for value in source.all_world2pix(ra, dec, 0))
        column, row, half = round(sx), round(sy), 24
        star = galsim.ImageD(galsim.BoundsI(-half, half, -half, half), scale=scale)
        for share, profile in zip(shares, small.roman.profiles(exposure, sx, sy), strict=True):
            shifted = profile.shift((sx - column) * scale, (sy - row) * scale) * share
            shifted.drawImage(image=star, add_to_image=True)
        rows, columns = slice(row - half, row + half + 1), slice(column - half, column + half + 1)
        on_tile = pixel_map(source, wide, rows, columns).dense()
        area = abs(
            np.linalg.det(
                [on_tile[half, half + 1] - on_tile[half, half], on_tile[half + 1, half] - on_tile[half, half]]
            )
        )
        oracle.add_image(
            (star.array / area).astype(np.float32),
            exptime=1.0,
            pixmap=on_tile,
            pixfrac=0.7,
            in_units="cps",
            weight_map=np.full(star.array.shape, exposure.exptime, np.float32),
        )
    expected = oracle.out_img[20:-20, 20:-20]
    assert target.wcs.crpix[0] == wide.wcs.crpix[0] - 20
    np.testing.assert_allclose(found.values, expected, atol=5e-3 * expected.max())
    assert np.abs(found.values - expected).std() < 1e-3 * expected.max()


def test_a_redder_star_is_wider(small):
    product = coadds(small.product, small.tiles, small.settings)
    ra, dec = small.region.centre
    blue, red = (
        coadd_psf(product, ra, dec, "H158", stamp=61, scale=0.0575, spectrum=lambda wave, power=power: wave**power)
        for power in (-6.0, 6.0)
    )
    assert blue.max() > 1.02 * red.max()
    for image in (blue, red):
        assert float(image.sum()) == pytest.approx(1, abs=0.06)
        assert image.attrs["x"] == image.attrs["y"] == 30


def test_missing_positions_and_bands_are_reported(small):
    product = coadds(small.product, small.tiles, small.settings)
    ra, dec = small.region.centre
    with pytest.raises(UserError, match=r"band 'K213': this survey has H158"):
        coadd_psf(product, ra, dec, "K213")
    with pytest.raises(UserError, match="outside the tiles"):
        coadd_psf(product, 10.0, 10.0, "H158")
    with pytest.raises(UserError, match="none negative"):
        coadd_psf(product, ra, dec, "H158", spectrum=lambda wave: -wave)
    renderer = replace(small.product.renderer, instrument=SimpleNamespace(coadd="draw"))
    exposures = replace(small.product, renderer=renderer)
    with pytest.raises(UserError, match="only for drizzled coadds"):
        coadd_psf(replace(product, maker=replace(product.maker, exposures=exposures)), ra, dec, "H158")
