"""Light outside the stamps of objects, compared with GalSim: stars and galaxies of every magnitude, large galaxies."""

from functools import lru_cache

import galsim
import numpy as np
import pytest
from test_draw_accuracy import COLOURS, ROMAN, exposure, galsim_image, one_object, sky_noise, star

from romandask.instruments.roman.roman import Roman, RomanSettings
from romandask.kernels.rendering.draw import draw
from romandask.kernels.rendering.fourier import DEVAUCOULEURS, EXPONENTIAL
from romandask.kernels.rendering.galsim_engine import component_profile, draw_objects
from romandask.kernels.rendering.profiles import light_radius, profile_tables, surface_brightness
from romandask.kernels.rendering.stamps import component_extents, component_radii, plan_stamps
from romandask.kernels.rendering.wings import add_wings

pytestmark = pytest.mark.slow

SIDE = 1024
MIDDLE = (512.7, 512.2)
RADII = (5, 10, 20, 40, 80, 160)
"""Radii, pixels, of the circles whose light is compared."""


@lru_cache(maxsize=1)
def setting():
    """Return the PSF in the middle of an SCA, the surface brightness at the edge of stamps and the zero point."""
    psf = Roman(RomanSettings(psf_degree=0)).psf(exposure("H158"))
    return psf, 0.04 * sky_noise("H158"), ROMAN.bandpass("H158").ab_photons() * 139.8


def drawn(scene, shape=(SIDE, SIDE)):
    psf, faintest, _ = setting()
    return draw(scene, psf, shape, plan_stamps(scene, psf.edges, shape, faintest, 2048), faintest)


def in_circles(image, centre):
    y, x = np.indices(image.shape)
    radius = np.hypot(x - centre[0], y - centre[1])
    return np.array([image[radius < limit].sum(dtype=float) for limit in RADII])


@pytest.mark.parametrize(
    ("kind", "hlr", "magnitudes"),
    [
        ("star", 0, (15.5, 18, 20, 22, 24, 26, 28)),
        ("disk", 0.3, (17, 19, 21, 23, 25, 27)),
        ("disk", 0.8, (19, 22, 25, 27)),
        ("bulge", 0.2, (17, 19, 21, 23, 25, 27)),
        ("both", 0.5, (18, 20, 22, 24, 26)),
        ("knots", 0.4, (22, 25)),
    ],
)
def test_the_light_of_every_magnitude_is_complete_and_where_galsim_draws_it(kind, hlr, magnitudes):
    """All light to 1e-3; within circles to 7e-3, and to 1e-3 where they end inside the stamp, pixels to 2% of noise."""
    _, faintest, zero = setting()
    shear, expected = (0.2, 0.1), None
    for magnitude in magnitudes:
        scene = one_object(kind, hlr, shear, MIDDLE, "red", zero * 10 ** (-0.4 * magnitude))
        flux, image = scene.photons.sum(), drawn(scene)
        if expected is None:
            expected = galsim_image(scene, "H158", SIDE, MIDDLE, (2043.5, 2043.5)).array / flux
        case = str((kind, hlr, magnitude))
        assert image.sum(dtype=float) == pytest.approx(flux, rel=1e-3), case
        light, galsim_light = in_circles(image, MIDDLE) / flux, in_circles(expected, MIDDLE)
        np.testing.assert_allclose(light, galsim_light, atol=7e-3, err_msg=case)
        if magnitude < 24:
            np.testing.assert_allclose(light, galsim_light, atol=2.5e-3, err_msg=case)
        np.testing.assert_allclose(image, expected * flux, atol=0.02 * faintest / 0.04, rtol=1e-3, err_msg=case)


@pytest.mark.parametrize(("kind", "hlr", "magnitude"), [("disk", 4, 17), ("disk", 30, 15), ("disk", 30, 20)])
@pytest.mark.parametrize("engine", ["fourier", "galsim"])
def test_large_disks_are_drawn_to_their_ends(kind, hlr, magnitude, engine):
    check_large(kind, hlr, magnitude, engine)


@pytest.mark.parametrize(("hlr", "magnitude", "tolerance"), [(4, 17, 1e-3), (10, 15, 1e-3), (30, 15, 3e-3)])
def test_large_bulges_are_drawn_to_their_ends(hlr, magnitude, tolerance):
    check_large("bulge", hlr, magnitude, "fourier", tolerance)


def check_large(kind, hlr, magnitude, engine, tolerance=1e-3):
    """Compare a galaxy with GalSim's profile: light to a tolerance, and no edge at the stamp."""
    psf, faintest, zero = setting()
    shape, position = (2048, 2048), (1023.7, 1024.2)
    scene = one_object(kind, hlr, (0.2, 0.1), position, "red", zero * 10 ** (-0.4 * magnitude))
    stamps = plan_stamps(scene, psf.edges, shape, faintest, 2048)
    if engine == "fourier":
        image = draw(scene, psf, shape, stamps, faintest)
    else:
        nodes = ROMAN.profiles(exposure("H158"), 2043.5, 2043.5)
        image = draw_objects(scene, lambda x, y: ((0, 0), nodes), shape, stamps, ROMAN.pixel_scale)
        add_wings(image, scene, (component_extents(scene), component_radii(scene, faintest)), psf.rings, stamps)
    profile = component_profile(scene, 0, 0) * scene.photons.sum()
    centre = galsim.PositionD(position[0] + 1, position[1] + 1)
    expected = profile.drawImage(nx=2048, ny=2048, scale=1.0, center=centre, method="no_pixel", dtype=float).array
    assert image.sum(dtype=float) == pytest.approx(expected.sum(), rel=tolerance)
    # the wings of the PSF matter near the centre only
    y, x = np.indices(shape)
    radius = np.hypot(x - position[0], y - position[1])
    assert np.abs(image - expected)[radius > 240].max() < 0.25 * faintest / 0.04
    for low, high in ((240, 262), (262, 300), (300, 500), (500, 1000)):
        ring = (radius > low) & (radius < high)
        assert image[ring].mean() == pytest.approx(expected[ring].mean(), rel=0.02, abs=0.02 * faintest / 0.04)


@pytest.mark.parametrize(("kind", "hlr", "magnitude", "x"), [("disk", 10, 15, -400.3), ("bulge", 4, 17, -300.3)])
def test_large_galaxies_beyond_the_edge_shine_into_the_image(kind, hlr, magnitude, x):
    _, faintest, zero = setting()
    electrons = zero * 10 ** (-0.4 * magnitude)
    image = drawn(one_object(kind, hlr, (0.2, 0.1), (x, 300.0), "red", electrons), (600, 600))
    whole = drawn(one_object(kind, hlr, (0.2, 0.1), (x + 512, 300.0), "red", electrons), (600, 1112))
    assert image.sum() > 100 * faintest
    np.testing.assert_allclose(image, whole[:, 512:], atol=0.1 * faintest, rtol=1e-5)


def test_a_faint_star_beyond_the_edge_shines_into_the_image():
    image = drawn(star((-20.0, 100.0), 400.0, COLOURS["red"]), (200, 200))
    whole = drawn(star((44.0, 100.0), 400.0, COLOURS["red"]), (200, 264))
    np.testing.assert_allclose(image, whole[:, 64:], atol=1e-5)
    assert image.sum() > 0.4


def test_tables_of_profiles_agree_with_galsim():
    profiles = galsim.Exponential(half_light_radius=1), galsim.DeVaucouleurs(half_light_radius=1)
    for kind, profile in zip((EXPONENTIAL, DEVAUCOULEURS), profiles, strict=True):
        for radius in (0.02, 0.3, 1.0, 4.0, 20.0):
            value = surface_brightness(profile_tables(), kind, radius**2)
            assert value == pytest.approx(profile.xValue(radius, 0), rel=2e-3)
        image = profile.drawImage(nx=512, ny=512, scale=0.05, method="no_pixel", dtype=float).array
        y, x = np.indices(image.shape)
        radius = light_radius(np.array([kind]), np.array([0.2]))[0]
        assert image[np.hypot(x - 255.5, y - 255.5) * 0.05 < radius].sum() == pytest.approx(0.8, abs=5e-3)
