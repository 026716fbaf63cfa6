"""Images matched in their PSFs and subtracted: against images that GalSim draws with both PSFs."""

import galsim
import numpy as np
import pytest
from astropy.wcs import WCS

from romandask.kernels.coadding.pixel_map import pixel_map
from romandask.kernels.measurement.difference import (
    blurred,
    dipoles,
    match,
    matching_kernel,
    polynomials,
    surface,
)
from romandask.model.seeds import rng
from romandask.model.tiles import tangent_header

FINE, COARSE = 0.0575, 0.2
SIDE = 240
SHARP = galsim.OpticalPSF(lam=1060, diam=2.4, obscuration=0.3, nstruts=0)
BLUNT = galsim.Kolmogorov(fwhm=0.7)


def psf_image(psf: galsim.GSObject, scale: float, side: int) -> np.ndarray:
    return galsim.Convolve(psf, galsim.Pixel(scale)).drawImage(nx=side, ny=side, scale=scale, method="no_pixel").array


def field(psf, side, scale, sources, shift=(0.0, 0.0)):
    """Return GalSim's image of some sources (arcsec from the middle, flux, half-light radius or 0)."""
    image = galsim.ImageF(side, side, scale=scale)
    for x, y, flux, radius in sources:
        profile = galsim.DeltaFunction() if radius == 0 else galsim.Exponential(half_light_radius=radius)
        seen = galsim.Convolve(profile, psf) * flux
        place = galsim.PositionD((x + shift[0]) / scale + (side + 1) / 2, (y + shift[1]) / scale + (side + 1) / 2)
        seen.drawImage(image, center=place, add_to_image=True)
    return image.array


def sources(count: int = 60) -> list[tuple[float, float, float, float]]:
    random = rng(8, "sources")
    half = SIDE * COARSE / 2 - 4
    radius = np.where(random.random(count) < 0.5, 0, random.uniform(0.1, 0.4, count))
    return list(zip(*random.uniform(-half, half, (2, count)), 10 ** random.uniform(3, 4.5, count), radius, strict=True))


@pytest.fixture(scope="module")
def pair():
    """A template on the coarse grid, blurred by models of the PSFs, and the image that GalSim draws there."""
    every = sources()
    side = int(SIDE * COARSE / FINE) + 60
    fine = field(SHARP, side, FINE, every)
    kernel = matching_kernel(psf_image(SHARP, FINE, 105), FINE, psf_image(BLUNT, COARSE, 61), COARSE)
    onto = pixel_map(
        WCS(tangent_header(53.0, -40.0, SIDE, COARSE)),
        WCS(tangent_header(53.0, -40.0, side, FINE)),
        slice(0, SIDE),
        slice(0, SIDE),
    )
    template = blurred(lambda rows, columns: fine[rows, columns], fine.shape, kernel, onto, (COARSE / FINE) ** 2)
    return every, template, field(BLUNT, SIDE, COARSE, every)


def pixels(every) -> tuple[np.ndarray, np.ndarray]:
    return tuple(np.array([source[k] for source in every]) / COARSE + (SIDE - 1) / 2 for k in (0, 1))


def test_a_sharp_image_is_blurred_to_the_other(pair):
    """By the PSFs' models alone: to half a per cent of the brightest pixel of every source."""
    every, template, image = pair
    for x, y in zip(*pixels(every), strict=True):
        part = slice(int(y) - 6, int(y) + 8), slice(int(x) - 6, int(x) + 8)
        assert np.abs(template - image)[part].max() < 0.006 * image[part].max()
    assert template.sum() == pytest.approx(image.sum(), rel=5e-3)


def test_the_difference_is_noise_and_what_is_new_keeps_its_flux(pair):
    """The image has a wider and longer PSF than the models say, its sources other fluxes, and one is new."""
    every, template, _ = pair
    random = rng(9, "noise")
    psf = galsim.Convolve(BLUNT, galsim.Gaussian(sigma=0.12).shear(g1=0.2))
    coloured = [(x, y, flux * 1.1 * (1 + 0.05 * random.standard_normal()), radius) for x, y, flux, radius in every]
    alone = field(psf, SIDE, COARSE, coloured)
    # where no other is near, of whose colour something is left
    places = rng(9, "places").uniform(-16, 16, (400, 2))
    apart = np.hypot(*(places[:, k, None] - np.array([source[k] for source in every]) for k in (0, 1)))
    new = (*places[np.argmax(apart.min(axis=1))], 5000.0, 0.0)
    noise = 1.5
    image = alone + field(psf, SIDE, COARSE, [new]) + random.normal(20, noise, alone.shape).astype(np.float32)
    error = np.full(image.shape, noise, np.float32)
    found = match(image, template, error, *pixels(every))
    matched = found.image(template)
    left = image - matched - found.sky()
    assert np.median(left) == pytest.approx(0, abs=0.1)
    fit = dipoles(left, matched, error, *pixels(every))
    fluxes = np.array([source[2] for source in every])
    # colours of five per cent are left, shifts are not
    assert np.std(fit[:, 0][fluxes > 3000]) == pytest.approx(0.05, rel=0.4)
    assert np.abs(np.nanmedian(fit[:, 1:3], axis=0)).max() < 0.01
    assert np.nanmedian(np.hypot(fit[:, 1], fit[:, 2])[fluxes > 3000]) < 0.03
    x, y = ((value / COARSE) + (SIDE - 1) / 2 for value in new[:2])
    v, u = np.mgrid[:SIDE, :SIDE]
    aperture = np.hypot(v - y, u - x) < 12
    light = psf_image(psf, COARSE, 61)
    w, t = np.mgrid[:61, :61] - 30
    share = light[np.hypot(w, t) < 12].sum()
    flux = left[aperture].sum() / share
    assert flux == pytest.approx(new[2], abs=4 * noise * np.sqrt(aperture.sum()) + 0.03 * new[2])


def test_a_shift_between_the_images_shows_as_dipoles(pair):
    """No kernel takes it up: a tenth of a pixel is found as a tenth of a pixel."""
    every, template, _ = pair
    image = field(BLUNT, SIDE, COARSE, every, shift=(0.3 * COARSE, -0.1 * COARSE))
    error = np.full(image.shape, 0.5, np.float32)
    found = match(image, template, error, *pixels(every))
    matched = found.image(template)
    fit = dipoles(image - matched - found.sky(), matched, error, *pixels(every))
    assert np.nanmedian(fit[:, 1]) == pytest.approx(0.3, abs=0.03)
    assert np.nanmedian(fit[:, 2]) == pytest.approx(-0.1, abs=0.03)


def test_surfaces_are_the_sums_of_their_polynomials():
    values = rng(1, "values").normal(size=6)
    y, x = np.mgrid[:30, :40]
    expected = np.tensordot(values, polynomials(y, x, (30, 40)), 1)
    np.testing.assert_allclose(surface(values, (30, 40)), expected, atol=1e-5)
