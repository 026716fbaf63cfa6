"""Image differences, tested with images that GalSim draws with a sharp and a blunt PSF."""

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
    """Return a PSF of unit flux, (side, side), integrated over pixels of `scale` arcsec."""
    return galsim.Convolve(psf, galsim.Pixel(scale)).drawImage(nx=side, ny=side, scale=scale, method="no_pixel").array


def field(psf, side, scale, sources, shift=(0.0, 0.0)):
    """Draw sources with GalSim: each (x and y from the middle in arcsec, flux, half-light radius in arcsec or 0)."""
    image = galsim.ImageF(side, side, scale=scale)
    for x, y, flux, radius in sources:
        profile = galsim.DeltaFunction() if radius == 0 else galsim.Exponential(half_light_radius=radius)
        convolved = galsim.Convolve(profile, psf) * flux
        centre = galsim.PositionD((x + shift[0]) / scale + (side + 1) / 2, (y + shift[1]) / scale + (side + 1) / 2)
        convolved.drawImage(image, center=centre, add_to_image=True)
    return image.array


def sources(count: int = 60) -> list[tuple[float, float, float, float]]:
    random = rng(8, "sources")
    half = SIDE * COARSE / 2 - 4
    radius = np.where(random.random(count) < 0.5, 0, random.uniform(0.1, 0.4, count))
    return list(zip(*random.uniform(-half, half, (2, count)), 10 ** random.uniform(3, 4.5, count), radius, strict=True))


@pytest.fixture(scope="module")
def pair():
    """Sources, a template blurred with the PSF models onto the coarse grid, and the image that GalSim draws there."""
    catalog = sources()
    side = int(SIDE * COARSE / FINE) + 60
    fine = field(SHARP, side, FINE, catalog)
    kernel = matching_kernel(psf_image(SHARP, FINE, 105), FINE, psf_image(BLUNT, COARSE, 61), COARSE)
    onto = pixel_map(
        WCS(tangent_header(53.0, -40.0, SIDE, COARSE)),
        WCS(tangent_header(53.0, -40.0, side, FINE)),
        slice(0, SIDE),
        slice(0, SIDE),
    )
    template = blurred(lambda rows, columns: fine[rows, columns], fine.shape, kernel, onto, (COARSE / FINE) ** 2)
    return catalog, template, field(BLUNT, SIDE, COARSE, catalog)


def pixels(catalog) -> tuple[np.ndarray, np.ndarray]:
    """Return x and y of the sources in pixels of the coarse grid."""
    return tuple(np.array([source[k] for source in catalog]) / COARSE + (SIDE - 1) / 2 for k in (0, 1))


def test_a_sharp_image_is_blurred_to_the_other_psf(pair):
    """The PSF models alone give an agreement of about half a per cent of the brightest pixel of each source."""
    catalog, template, image = pair
    for x, y in zip(*pixels(catalog), strict=True):
        part = slice(int(y) - 6, int(y) + 8), slice(int(x) - 6, int(x) + 8)
        assert np.abs(template - image)[part].max() < 0.006 * image[part].max()
    assert template.sum() == pytest.approx(image.sum(), rel=5e-3)


def test_the_difference_is_noise_and_a_new_source_keeps_its_flux(pair):
    """The image has a wider and more elongated PSF than the model, sources of other fluxes, and a new source."""
    catalog, template, _ = pair
    random = rng(9, "noise")
    psf = galsim.Convolve(BLUNT, galsim.Gaussian(sigma=0.12).shear(g1=0.2))
    coloured = [(x, y, flux * 1.1 * (1 + 0.05 * random.standard_normal()), radius) for x, y, flux, radius in catalog]
    without_new = field(psf, SIDE, COARSE, coloured)
    # a position far from the other sources, whose changes in flux leave residuals
    positions = rng(9, "places").uniform(-16, 16, (400, 2))
    distance = np.hypot(*(positions[:, k, None] - np.array([source[k] for source in catalog]) for k in (0, 1)))
    new = (*positions[np.argmax(distance.min(axis=1))], 5000.0, 0.0)
    noise = 1.5
    image = (
        without_new + field(psf, SIDE, COARSE, [new]) + random.normal(20, noise, without_new.shape).astype(np.float32)
    )
    error = np.full(image.shape, noise, np.float32)
    fit = match(image, template, error, *pixels(catalog))
    matched = fit.image(template)
    difference = image - matched - fit.sky()
    assert np.median(difference) == pytest.approx(0, abs=0.1)
    residuals = dipoles(difference, matched, error, *pixels(catalog))
    fluxes = np.array([source[2] for source in catalog])
    # differences in flux of 5% remain, shifts do not
    assert np.std(residuals[:, 0][fluxes > 3000]) == pytest.approx(0.05, rel=0.4)
    assert np.abs(np.nanmedian(residuals[:, 1:3], axis=0)).max() < 0.01
    assert np.nanmedian(np.hypot(residuals[:, 1], residuals[:, 2])[fluxes > 3000]) < 0.03
    x, y = ((value / COARSE) + (SIDE - 1) / 2 for value in new[:2])
    v, u = np.mgrid[:SIDE, :SIDE]
    aperture = np.hypot(v - y, u - x) < 12
    light = psf_image(psf, COARSE, 61)
    w, t = np.mgrid[:61, :61] - 30
    share = light[np.hypot(w, t) < 12].sum()
    flux = difference[aperture].sum() / share
    assert flux == pytest.approx(new[2], abs=4 * noise * np.sqrt(aperture.sum()) + 0.03 * new[2])


def test_a_shift_between_the_images_is_measured_from_dipoles(pair):
    """The matching kernel does not absorb a shift: it is recovered to 0.03 pixels."""
    catalog, template, _ = pair
    image = field(BLUNT, SIDE, COARSE, catalog, shift=(0.3 * COARSE, -0.1 * COARSE))
    error = np.full(image.shape, 0.5, np.float32)
    fit = match(image, template, error, *pixels(catalog))
    matched = fit.image(template)
    residuals = dipoles(image - matched - fit.sky(), matched, error, *pixels(catalog))
    assert np.nanmedian(residuals[:, 1]) == pytest.approx(0.3, abs=0.03)
    assert np.nanmedian(residuals[:, 2]) == pytest.approx(-0.1, abs=0.03)


def test_a_surface_is_the_sum_of_its_polynomial_terms():
    values = rng(1, "values").normal(size=6)
    y, x = np.mgrid[:30, :40]
    expected = np.tensordot(values, polynomials(y, x, (30, 40)), 1)
    np.testing.assert_allclose(surface(values, (30, 40)), expected, atol=1e-5)
