"""Accuracy of the Fourier renderer: objects, a scene, photon shooting and chromatic PSFs compared with GalSim."""

from dataclasses import replace
from functools import lru_cache

import galsim
import galsim.roman
import numpy as np
import pytest

from romandask.instruments.exposure import Exposure
from romandask.instruments.psf_image import flat_shares, psf_image
from romandask.instruments.roman.roman import Roman, RomanSettings
from romandask.kernels.rendering.draw import draw
from romandask.kernels.rendering.fourier import DEVAUCOULEURS, EXPONENTIAL, KNOTS, POINT
from romandask.kernels.rendering.galsim_engine import component_profile, object_profile
from romandask.kernels.rendering.stamps import Scene, plan_stamps
from romandask.model.settings import RenderSettings

pytestmark = pytest.mark.slow

BANDS = ("Y106", "J129", "H158", "F184")
ROMAN = Roman(RomanSettings())
COLOURS = {"red": (0.05, 0.15, 0.2, 0.25, 0.35), "blue": (0.35, 0.25, 0.2, 0.15, 0.05)}
"""Fractions of the photons at each node."""
# type, half-light radius (arcsec), shear, position on the SCA, colour, AB magnitude
GRID = [
    ("star", 0, (0.0, 0.0), (2043.31, 2044.77), "blue", 18.0),
    ("star", 0, (0.0, 0.0), (200.96, 3900.49), "red", 18.0),
    ("star", 0, (0.0, 0.0), (3999.5, 100.01), "blue", 21.0),
    ("disk", 0.15, (0.0, 0.0), (1000.25, 1500.75), "red", 22.0),
    ("disk", 0.4, (0.5, 0.1), (3000.0, 700.5), "blue", 20.0),
    ("disk", 0.8, (-0.2, 0.4), (500.13, 500.87), "red", 23.0),
    ("bulge", 0.1, (0.1, 0.0), (3500.6, 3500.4), "red", 19.0),
    ("bulge", 0.4, (0.3, -0.2), (1500.5, 2500.5), "blue", 22.0),
    ("both", 0.5, (0.2, 0.3), (2500.9, 1200.1), "red", 20.0),
    ("both", 0.3, (-0.4, 0.0), (900.3, 3300.2), "blue", 24.0),
    ("knots", 0.5, (0.1, 0.2), (3700.4, 2000.6), "blue", 21.0),
]


def exposure(band):
    return Exposure(visit=1, detector=7, band=band, mjd=61541.0, exptime=139.8, ra=53.0, dec=-40.0, pa=120.0)


@lru_cache(maxsize=4)
def sky_noise(band):
    one = exposure(band)
    return ROMAN.sky_noise(one, ROMAN.background(one, ROMAN.header(one), slice(2000, 2010), slice(2000, 2010)))


def one_object(kind, hlr, shear, position, colour, electrons):
    """Return a scene of one object; an object of kind "both" has a bulge and a disk of different colours."""
    matrix = galsim.Shear(g1=shear[0], g2=shear[1]).getMatrix() * hlr / ROMAN.pixel_scale
    parts = {"star": [POINT], "disk": [EXPONENTIAL], "bulge": [DEVAUCOULEURS], "both": [DEVAUCOULEURS, EXPONENTIAL]}
    kinds = parts.get(kind, [EXPONENTIAL, KNOTS])
    n, other = len(kinds), COLOURS["blue" if colour == "red" else "red"]
    photons = np.array([COLOURS[colour], other][:n]) * electrons / n
    is_knots = np.array(kinds)[:, None, None] == KNOTS
    return Scene(
        x=np.array([position[0]]),
        y=np.array([position[1]]),
        key=np.array([77], np.uint64),
        owner=np.zeros(n, int),
        kind=np.array(kinds),
        matrix=np.repeat(matrix[None], n, axis=0),
        smoothing=np.where(is_knots, np.eye(2) * 0.2 / ROMAN.pixel_scale, 0.0),
        knots=np.where(is_knots[:, 0, 0], 8, 0),
        photons=photons,
    )


def galsim_image(scene, band, size, position, psf_position):
    """Return GalSim's image of the object of a scene on its stamp, with the PSF at a position on the SCA."""
    profiles = [psf.dilate(1 / ROMAN.pixel_scale) for psf in ROMAN.profiles(exposure(band), *psf_position)]
    profile = object_profile(scene, 0, np.array([0, len(scene.owner)]), profiles)
    x0, y0 = (int(np.floor(value)) - size // 2 for value in position)
    bounds = galsim.BoundsI(x0, x0 + size - 1, y0, y0 + size - 1)
    # on a small stamp, GalSim folds light from outside the stamp into it, up to half a per cent of the light
    wide = bounds.withBorder(max(size // 2, 128))
    image = profile.drawImage(bounds=wide, scale=1.0, center=galsim.PositionD(*position), dtype=float)
    return image[bounds & galsim.BoundsI(0, 4087, 0, 4087)]


def shape_of(array, position):
    """Return centroid, second moments (xx, yy; pixels2) and ellipticity under a Gaussian window on the object."""
    y, x = np.indices(array.shape)
    window = array * np.exp(-((x - position[0]) ** 2 + (y - position[1]) ** 2) / (2 * 6.0**2))
    total = window.sum()
    cx, cy = (window * x).sum() / total, (window * y).sum() / total
    xx, yy, xy = ((window * u * v).sum() / total for u, v in ((x - cx, x - cx), (y - cy, y - cy), (x - cx, y - cy)))
    return np.array([cx, cy]), np.array([xx, yy]), np.array([xx - yy, 2 * xy]) / (xx + yy)


@pytest.mark.parametrize("band", BANDS)
def test_objects_of_every_kind_agree_with_galsim(band):
    """Flux within 256 pixels to 1e-3, pixels to 5% of the sky noise, moments to 1e-3, ellipticity to 2e-4."""
    one, noise = exposure(band), sky_noise(band)
    zero = ROMAN.bandpass(band).ab_photons() * one.exptime
    # two bands over the whole SCA, and two in its middle only, which saves time
    everywhere = band in ("Y106", "F184")
    psf = (ROMAN if everywhere else Roman(RomanSettings(psf_degree=0))).psf(one)
    for kind, hlr, shear, position, colour, magnitude in GRID:
        position = position if everywhere else (2043.5 + position[0] % 1, 2043.5 + position[1] % 1)
        scene = one_object(kind, hlr, shear, position, colour, zero * 10 ** (-0.4 * magnitude))
        faintest = RenderSettings().truncation * noise
        stamps = plan_stamps(scene, psf.edges, ROMAN.shape, faintest, 2048)
        psf_position = position if everywhere else (2043.5, 2043.5)
        expected = galsim_image(scene, band, max(int(stamps.size[0]), 256), position, psf_position)
        b = expected.bounds
        image = draw(scene, psf, ROMAN.shape, stamps, faintest)[b.ymin : b.ymax + 1, b.xmin : b.xmax + 1]
        case = str((band, kind, hlr, magnitude))
        assert image.sum() == pytest.approx(expected.array.sum(), rel=1e-3), case
        assert np.abs(image - expected.array).max() < 0.05 * noise, case
        on_stamp = (position[0] - b.xmin, position[1] - b.ymin)
        shape, expected_shape = shape_of(image, on_stamp), shape_of(expected.array, on_stamp)
        np.testing.assert_allclose(shape[0], expected_shape[0], atol=1e-3, err_msg=case)
        np.testing.assert_allclose(shape[1], expected_shape[1], rtol=1e-3, err_msg=case)
        if hlr >= 0.3:
            np.testing.assert_allclose(shape[2], expected_shape[2], atol=2e-4, err_msg=case)


def test_both_engines_draw_the_same_scene(small):
    """All objects on a detector, at the density of the sky, drawn by both engines through the same interface."""
    view = small.product.renderer.view(0)
    assert (view.stamps.size > 0).sum() > 150
    fourier = view.expected()
    by_galsim = replace(view, render=RenderSettings(engine="galsim", n_waves=3)).expected()
    noise = small.roman.sky_noise(small.exposures[0], view.background)
    assert np.abs(fourier - by_galsim).max() < 0.05 * noise
    assert fourier.sum() == pytest.approx(by_galsim.sum(), rel=1e-3)


def test_bright_stars_have_finer_pupils_and_twelve_diffraction_spikes():
    """The image, with its spikes, agrees with GalSim's for the same pupil out to the edge of the stamp."""
    roman = Roman(RomanSettings(bands=("F184",), psf_degree=0), n_waves=2)
    one, position = exposure("F184"), (2043.3, 2043.6)
    zero, noise = roman.bandpass("F184").ab_photons() * one.exptime, sky_noise("F184")
    psf, bright = roman.psf(one), roman.bright_psfs(one)
    stars = [star(position, zero * 10 ** (-0.4 * magnitude)) for magnitude in (15.1, 14.0, 11.0)]
    plans = [plan_stamps(scene, psf.edges, roman.shape, 0.04 * noise, 2048, bright) for scene in stars]
    assert [int(plan.bright[0]) for plan in plans] == [-1, 0, 1]
    assert [int(plan.size[0]) for plan in plans[1:]] == [1024, 2048]
    image = draw(stars[1], psf, roman.shape, plans[1], 0.04 * noise, bright)[2043 - 512 : 2043 + 512]
    image = image[:, 2043 - 512 : 2043 + 512]
    nodes = roman.bandpass("F184").nodes
    parts = [galsim.roman.getPSF(7, "F184", pupil_bin=4, wavelength=wave) for wave in nodes]
    profile = galsim.Sum([part * flux for part, flux in zip(parts, stars[1].photons[0], strict=True)])
    convolved = galsim.Convolve(profile, galsim.Pixel(roman.pixel_scale))
    centre = galsim.PositionD(position[0] - 2043 + 512, position[1] - 2043 + 512)
    # on native pixels, GalSim loses a hundredth of the peak of this PSF, which is at frequencies that it does not fold
    fine = convolved.drawImage(
        bounds=galsim.BoundsI(0, 2047, 0, 2047),
        scale=roman.pixel_scale / 2,
        center=centre * 2,
        method="no_pixel",
        dtype=float,
    ).array
    expected = fine[::2, ::2] * 4
    assert image.sum() == pytest.approx(expected.sum(), rel=1e-3)
    assert np.abs(image - expected).max() < 1e-4 * expected.max()
    y, x = np.indices(image.shape)
    radius, angle = np.hypot(x - centre.x, y - centre.y), np.degrees(np.arctan2(y - centre.y, x - centre.x)) % 360
    ring = (radius > 60) & (radius < 200)
    light = np.bincount(angle[ring].astype(int) // 3, image[ring], 120) / np.bincount(angle[ring].astype(int) // 3)
    smooth = np.convolve(np.r_[light[-30:], light, light[:30]], np.ones(11) / 11, "same")[30:-30]
    peaks = (light > np.roll(light, 1)) & (light >= np.roll(light, -1)) & (light > 1.15 * smooth)
    assert peaks.sum() == 12


def star(position, electrons, shares=(0.6, 0.4)):
    """Return a scene of one star with fractions of its light at the nodes; by default there are two nodes."""
    zeros = np.zeros((1, 2, 2))
    return Scene(
        x=np.array([position[0]]),
        y=np.array([position[1]]),
        key=np.zeros(1, np.uint64),
        owner=np.zeros(1, int),
        kind=np.full(1, POINT),
        matrix=zeros,
        smoothing=zeros,
        knots=np.zeros(1, int),
        photons=np.array([shares]) * electrons,
    )


def test_mean_of_photon_shot_images_agrees_with_the_noiseless_image():
    """The chi2 of the differences, with the scatter of the photon-shot images, is that of pure noise."""
    position, shots, side = (2043.3, 2043.6), 40, 64
    scene = one_object("both", 0.3, (0.3, -0.2), position, "red", 3e4)
    psf = ROMAN.psf(exposure("H158"))
    image = draw(scene, psf, ROMAN.shape, plan_stamps(scene, psf.edges, ROMAN.shape, 0.05, 512), 0.05)
    image = image[2012 : 2012 + side, 2011 : 2011 + side]
    centre = galsim.PositionD(position[0] - 2011, position[1] - 2012)
    nodes = [psf.dilate(1 / ROMAN.pixel_scale) for psf in ROMAN.profiles(exposure("H158"), *position)]
    noise, bounds = galsim.BaseDeviate(77), galsim.BoundsI(0, side - 1, 0, side - 1)
    stack = np.zeros((shots, side, side))
    for c, photons in enumerate(scene.photons):
        for psf_node, flux in zip(nodes, photons, strict=True):
            # one at a time: GalSim shoots too many photons for sums of profiles with negative photons
            profile = galsim.Convolve(component_profile(scene, 0, c), psf_node) * flux
            for shot in stack:
                shot += profile.drawImage(bounds=bounds, scale=1.0, center=centre, method="phot", rng=noise).array
    lit = image > 3
    mean, scatter = stack.mean(axis=0)[lit], stack.std(axis=0, ddof=1)[lit] / np.sqrt(shots)
    chi2 = np.sum(((mean - image[lit]) / scatter) ** 2) / lit.sum()
    # with a measured scatter the differences follow Student's t distribution, whose variance is n / (n - 2)
    assert lit.sum() > 500
    assert chi2 == pytest.approx((shots - 1) / (shots - 3), abs=4 * np.sqrt(2 / lit.sum()))
    # the test would detect 3 per cent of the light shifted by a pixel
    shifted = np.roll(image, 1, axis=0) * 0.03 + image * 0.97
    assert np.sum(((mean - shifted[lit]) / scatter) ** 2) / lit.sum() > 1.2


def test_chromatic_psf_of_red_and_blue_stars_agrees_with_galsim():
    """The chromatic minus the achromatic PSF of red and of blue stars (Troxel et al. 2023, figure 5)."""
    one, band = exposure("H158"), ROMAN.bandpass("H158")
    whole = galsim.roman.getBandpasses(AB_zeropoint=True)["H158"]
    middle = (galsim.roman.n_pix - 1) / 2
    effective = psf_at_wave(one, whole.effective_wavelength)
    centre_change = {}
    for name, slope in (("red", 6.0), ("blue", -6.0)):
        wave = band.wave
        photons = (wave / whole.effective_wavelength) ** slope
        light = (photons * band.weights) @ band.node_weights()
        change = psf_image(ROMAN, one, middle, middle, light) - effective
        # direct sum over many wavelengths
        fine = np.linspace(whole.blue_limit, whole.red_limit, 41)
        weight = whole(fine) * (fine / whole.effective_wavelength) ** slope
        expected = (
            sum(w * psf_at_wave(one, lam) for lam, w in zip(fine, weight / weight.sum(), strict=True)) - effective
        )
        # figure 5 shows changes of some per cent of the peak
        assert 0.01 < np.abs(expected).max() / effective.max() < 0.2
        assert np.abs(change - expected).max() < 0.08 * np.abs(expected).max()
        centre_change[name] = expected[256, 256]
    # the PSF is wider in red light
    assert centre_change["red"] < 0 < centre_change["blue"]
    assert flat_shares(band).sum() == pytest.approx(1.0)


def psf_at_wave(one, wave):
    """Return GalSim's image of a unit star at a wavelength, oversampled by 8."""
    psf = galsim.roman.getPSF(one.detector, one.band, pupil_bin=8, wavelength=wave)
    convolved = galsim.Convolve(psf, galsim.Pixel(ROMAN.pixel_scale))
    image = convolved.drawImage(
        nx=512, ny=512, scale=ROMAN.pixel_scale / 8, offset=(0.5, 0.5), method="no_pixel", dtype=float
    )
    return image.array * 64
