"""Oversampled PSF images of exposures, compared with GalSim."""

from dataclasses import replace

import galsim
import galsim.roman
import numpy as np
import pytest

from romandask.instruments.exposure import Exposure
from romandask.instruments.psf_image import OVERSAMPLING, PSF_IMAGE_PIXELS, flat_shares, psf_image
from romandask.instruments.roman.roman import RomanSettings
from romandask.instruments.rubin.rubin import Rubin, RubinSettings
from romandask.kernels.rendering.seeing import fried, kolmogorov_transfer, von_karman_transfer
from romandask.stages.psf_images import psfs


def drawn(instrument, exposure, x, y):
    """Return GalSim's image of a star of flat f_nu: the PSFs at a position, weighted by the light at each PSF node."""
    shares = flat_shares(instrument.bandpass(exposure.band))
    profiles = instrument.profiles(exposure, x, y)
    psf = galsim.Sum([profile * share for profile, share in zip(profiles, shares, strict=True)])
    seen = galsim.Convolve(psf, galsim.Pixel(instrument.pixel_scale))
    side, scale = PSF_IMAGE_PIXELS * OVERSAMPLING, instrument.pixel_scale / OVERSAMPLING
    # the star is centred on a sample, and each sample is the light in a native pixel
    image = seen.drawImage(nx=side, ny=side, scale=scale, offset=(0.5, 0.5), method="no_pixel", dtype=float)
    return image.array * OVERSAMPLING**2


def test_an_image_is_galsims_in_the_middle_of_the_detector(small):
    middle = (galsim.roman.n_pix - 1) / 2
    image = psf_image(small.roman, small.exposures[0], middle, middle)
    expected = drawn(small.roman, small.exposures[0], middle, middle)
    # at this sampling GalSim's interpolation of its PSF has a little power beyond the diffraction limit
    assert np.abs(image - expected).max() < 1e-3 * expected.max()
    assert image[4::OVERSAMPLING, 4::OVERSAMPLING].sum() == pytest.approx(expected[4::8, 4::8].sum(), rel=1e-3)


def test_an_image_depends_on_the_position(small):
    corner, middle = 300.0, (galsim.roman.n_pix - 1) / 2
    expected = drawn(small.roman, small.exposures[0], corner, corner)
    assert np.abs(psf_image(small.roman, small.exposures[0], corner, corner) - expected).max() < 1e-3 * expected.max()
    of_the_middle = psf_image(small.roman, small.exposures[0], middle, middle)
    assert np.abs(of_the_middle - expected).max() > 5e-3 * expected.max()


def test_without_variation_an_image_is_that_of_the_middle(small):
    roman = replace(small.roman, settings=RomanSettings(bands=("H158",), psf_degree=0))
    middle = (galsim.roman.n_pix - 1) / 2
    images = [psf_image(roman, small.exposures[0], x, x) for x in (300.0, middle)]
    np.testing.assert_array_equal(*images)


def test_images_are_lazy_over_exposures(small):
    dataset = psfs(small.product).dataset
    assert dataset["psf"].dims == ("exposure", "v", "u")
    assert dataset.sizes["exposure"] == 3
    assert set(dataset["psf"].chunks[0]) == {1}
    first = dataset["psf"].sel(exposure=small.exposures[0].name).compute()
    # the centre of the small detector is near the corner of the real one
    np.testing.assert_array_equal(first, psf_image(small.roman, small.exposures[0], 149.5, 149.5))
    assert first.attrs["pixel_scale"] == pytest.approx(galsim.roman.pixel_scale / 8)


@pytest.mark.parametrize("atmosphere", ["kolmogorov", "von_karman"])
def test_rubins_image_is_galsims(atmosphere):
    rubin = Rubin(RubinSettings(bands=("i",), atmosphere=atmosphere), n_waves=2)
    pointing = {"visit": 0, "detector": 5, "band": "i", "mjd": 61000.0, "exptime": 30.0, "ra": 53.0, "dec": -40.0}
    exposure = Exposure(**pointing, pa=0.0, seeing=0.65, airmass=1.2, sky_brightness=20.5)
    image, expected = psf_image(rubin, exposure, 100.0, 100.0), drawn(rubin, exposure, 100.0, 100.0)
    assert np.abs(image - expected).max() < 1e-3 * expected.max()


@pytest.mark.parametrize("outer_scale", [10.0, 25.0, 100.0])
def test_the_von_karman_transfer_is_galsims(outer_scale):
    frequency = np.linspace(0, 15, 50)
    profile = galsim.VonKarman(lam=620.0, r0=fried(0.7, 620.0), L0=outer_scale)
    seen = galsim.Convolve(profile, galsim.Gaussian(fwhm=0.4))
    transfer = von_karman_transfer(frequency, np.array(0.7), np.array(0.4), 620.0, outer_scale)
    np.testing.assert_allclose(transfer, [seen.kValue(k, 0).real for k in frequency], atol=1e-9)
    # an outer scale makes seeing sharper
    assert (transfer >= kolmogorov_transfer(frequency, np.array(0.7), np.array(0.4)) - 1e-4).all()
