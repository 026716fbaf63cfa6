"""The Fourier renderer compared with GalSim drawing the same profiles."""

import galsim
import galsim.roman
import numpy as np
import pandas as pd
import pytest
from astropy.wcs import WCS

from romandask.ingest.spectra import galaxy_templates
from romandask.instruments.exposure import Exposure
from romandask.instruments.roman.roman import Roman, RomanSettings
from romandask.kernels.rendering import draw as render
from romandask.kernels.rendering.fourier import DEVAUCOULEURS, EXPONENTIAL, KNOTS, POINT, knot_offset
from romandask.kernels.rendering.galsim_sampling import sample_model
from romandask.kernels.rendering.scene import bind, build_scene, magnification, pixel_positions, shape_matrices
from romandask.kernels.rendering.seeing import kolmogorov_transfer, radial_model
from romandask.kernels.rendering.stamps import Scene, plan_stamps, stamp_sizes
from romandask.model.tiles import tangent_header

SHARES = np.array([0.2, 0.5, 0.3])
"""Fractions of the light at the three nodes."""
SCALE = 0.11
"""Pixel scale, arcsec."""


@pytest.fixture(scope="module")
def psfs():
    bandpass = Roman(RomanSettings(), n_waves=3).bandpass("H158")
    return [galsim.roman.getPSF(7, "H158", pupil_bin=8, wavelength=wave) for wave in bandpass.nodes]


@pytest.fixture(scope="module")
def psf_model(psfs):
    return sample_model(psfs, SCALE, 512)


def draw(scene, psf, shape, faintest):
    return render.draw(scene, psf, shape, plan_stamps(scene, psf.edges, shape, faintest, 512), faintest)


def one_component(kind, matrix, flux, x, y, smoothing=None, knots=0):
    """Return a scene of one object with one component."""
    return Scene(
        x=np.array([x]),
        y=np.array([y]),
        key=np.array([99], np.uint64),
        owner=np.array([0]),
        kind=np.array([kind]),
        matrix=np.array([matrix]),
        smoothing=np.zeros((1, 2, 2)) if smoothing is None else smoothing[None],
        knots=np.array([knots]),
        photons=(SHARES * flux)[None],
    )


def galsim_image(profile, psfs, flux, x, y, side):
    """Return GalSim's image of a profile (None for a point) convolved with the PSFs."""
    psf = galsim.Sum([p * share for p, share in zip(psfs, SHARES, strict=True)])
    drawn = psf if profile is None else galsim.Convolve(profile, psf)
    middle = (side - 1) / 2
    return (drawn * flux).drawImage(nx=side, ny=side, scale=SCALE, offset=(x - middle, y - middle), dtype=float).array


def moments(image):
    """Return the centroid and the second moments (xx, yy, xy), pixels, under a Gaussian window."""
    y, x = np.indices(image.shape)
    window = np.exp(-((x - 63.5) ** 2 + (y - 63.5) ** 2) / (2 * 8.0**2)) * image
    total = window.sum()
    cx, cy = (window * x).sum() / total, (window * y).sum() / total
    second = [(window * u * v).sum() / total for u, v in ((x - cx, x - cx), (y - cy, y - cy), (x - cx, y - cy))]
    return np.array([cx, cy]), np.array(second)


@pytest.mark.parametrize("kind", [POINT, EXPONENTIAL, DEVAUCOULEURS])
@pytest.mark.parametrize(("hlr", "g1", "g2"), [(0.1, 0.0, 0.0), (0.35, 0.3, -0.2), (0.8, -0.1, 0.5)])
def test_components_agree_with_galsim(psf_model, psfs, kind, hlr, g1, g2):
    flux, x, y = 2e4, 63.31, 64.77
    shear = galsim.Shear(g1=g1, g2=g2)
    profile = {
        POINT: None,
        EXPONENTIAL: galsim.Exponential(half_light_radius=hlr),
        DEVAUCOULEURS: galsim.DeVaucouleurs(half_light_radius=hlr),
    }[kind]
    profile = profile.shear(shear) if profile else None
    scene = one_component(kind, shear.getMatrix() * hlr / SCALE, flux, x, y)
    image = draw(scene, psf_model, (128, 128), 1e-4)
    expected = galsim_image(profile, psfs, flux, x, y, 128)
    assert image.sum() == pytest.approx(expected.sum(), rel=1e-3)
    # 5 per cent of the sky noise of 10 electrons
    assert np.abs(image - expected).max() < 0.5
    (centre, second), (centre_expected, second_expected) = moments(image), moments(expected)
    np.testing.assert_allclose(centre, centre_expected, atol=1e-3)
    np.testing.assert_allclose(second[:2], second_expected[:2], rtol=1e-3)


def test_knots_are_gaussians_at_the_positions_of_knot_offset(psf_model, psfs):
    matrix = galsim.Shear(g1=0.2, g2=0.1).getMatrix() * 0.4
    offsets = [matrix @ np.array(knot_offset(np.uint64(99), k)) for k in range(12)]
    profile = galsim.Sum([galsim.Gaussian(sigma=0.2).shift(*offset) / 12 for offset in offsets])
    scene = one_component(KNOTS, matrix / SCALE, 2e4, 63.2, 63.9, np.eye(2) * 0.2 / SCALE, 12)
    image = draw(scene, psf_model, (128, 128), 1e-4)
    expected = galsim_image(profile, psfs, 2e4, 63.2, 63.9, 128)
    assert np.abs(image - expected).max() < 0.05


def test_knot_offsets_follow_a_gaussian_of_half_light_radius_1():
    offsets = np.array([knot_offset(np.uint64(key), k) for key in range(300) for k in range(30)])
    assert np.mean(np.hypot(*offsets.T) < 1.0) == pytest.approx(0.5, abs=0.02)
    np.testing.assert_allclose(np.cov(offsets.T), np.eye(2) / (2 * np.log(2)), atol=0.03)


def test_kolmogorov_transfer_agrees_with_galsim():
    profile = galsim.Convolve(galsim.Kolmogorov(fwhm=0.7), galsim.Gaussian(fwhm=0.4))
    frequency = np.linspace(0, 12, 40)
    expected = [profile.kValue(k, 0).real for k in frequency]
    np.testing.assert_allclose(kolmogorov_transfer(frequency, np.array(0.7), np.array(0.4)), expected, atol=2e-5)


def test_radial_model_agrees_with_galsim():
    frequency = np.linspace(0, 50, 3000)
    transfer = kolmogorov_transfer(frequency, np.array(0.7), np.array(0.4))
    psf_model = radial_model(frequency, np.array([transfer] * 3), 0.2, 256)
    image = draw(one_component(POINT, np.zeros((2, 2)), 1e4, 63.3, 63.6), psf_model, (128, 128), 1e-3)
    profile = galsim.Convolve(galsim.Kolmogorov(fwhm=0.7), galsim.Gaussian(fwhm=0.4)) * 1e4
    expected = profile.drawImage(nx=128, ny=128, scale=0.2, offset=(-0.2, 0.1), dtype=float).array
    assert np.abs(image - expected).max() < 0.3


def galaxies(**columns):
    """Return a truth row of a round, unlensed disk of 0.4 arcsec, with some columns replaced."""
    row = {
        "ra": 53.0,
        "dec": -40.0,
        "size_disk_true": 0.4,
        "size_minor_disk_true": 0.4,
        "position_angle_unlensed": 0.0,
        "shear_1": 0.0,
        "shear_2": 0.0,
        "convergence": 0.0,
    }
    return pd.DataFrame([row | columns])


def image_on_the_sky(psf_model, frame):
    """Return the image of a galaxy through the WCS of a north-up image, on which x increases towards the west."""
    wcs = WCS(tangent_header(53.0, -40.0, 129, SCALE))
    x, y, to_pixels = pixel_positions(wcs, frame["ra"], frame["dec"])
    shape, lens = shape_matrices(frame, "disk")
    scene = one_component(EXPONENTIAL, (to_pixels @ lens @ shape)[0], 1e4, x[0], y[0])
    return draw(scene, psf_model, (129, 129), 1e-3)


def position_angle(image):
    """Return the position angle, degrees east of north, from moments; x increases towards the west."""
    y, x = np.indices(image.shape) - 64.0
    weight = image * np.exp(-(x**2 + y**2) / (2 * 10.0**2))
    xx, yy, xy = ((weight * u * v).sum() for u, v in ((x, x), (y, y), (x, y)))
    return np.degrees(0.5 * np.arctan2(2 * -xy, yy - xx)) % 180


def test_position_angles_are_east_of_north(psf_model):
    frame = galaxies(size_disk_true=0.8, size_minor_disk_true=0.2, position_angle_unlensed=30.0)
    assert position_angle(image_on_the_sky(psf_model, frame)) == pytest.approx(30.0, abs=0.5)


@pytest.mark.parametrize(
    ("shear_1", "shear_2", "angle"), [(0.4, 0.0, 90.0), (-0.4, 0.0, 0.0), (0.0, 0.4, 135.0), (0.0, -0.4, 45.0)]
)
def test_shear_follows_the_sky_convention_of_galsim(psf_model, shear_1, shear_2, angle):
    """GalSim's sky frame is (west, north): positive g1 stretches east-west, positive g2 north-west to south-east."""
    image = image_on_the_sky(psf_model, galaxies(shear_1=shear_1, shear_2=shear_2))
    assert (position_angle(image) - angle + 90) % 180 - 90 == pytest.approx(0, abs=0.5)
    wcs = galsim.AffineTransform(SCALE, 0, 0, SCALE)
    profile = galsim.Exponential(half_light_radius=0.4).shear(g1=shear_1, g2=shear_2)
    drawn = galsim.Convolve(profile, galsim.Gaussian(sigma=0.05)).drawImage(nx=129, ny=129, wcs=wcs).array
    assert (position_angle(drawn) - angle + 90) % 180 - 90 == pytest.approx(0, abs=0.5)


def test_lensing_agrees_with_galsim(psf_model, psfs):
    frame = galaxies(
        shear_1=0.05,
        shear_2=-0.08,
        convergence=0.1,
        size_disk_true=0.6,
        size_minor_disk_true=0.3,
        position_angle_unlensed=70.0,
    )
    g1, g2 = 0.05 / 0.9, -0.08 / 0.9
    mu = magnification(frame)[0]
    assert mu == pytest.approx(1 / (0.9**2 - 0.05**2 - 0.08**2))
    profile = galsim.Exponential(half_light_radius=np.sqrt(0.6 * 0.3)).shear(q=0.5, beta=160 * galsim.degrees)
    expected = galsim_image(profile.lens(g1, g2, mu), psfs, 1e4, 64, 64, 129)
    image = image_on_the_sky(psf_model, frame) * mu
    assert image.sum() == pytest.approx(expected.sum(), rel=1e-3)
    # the north-up image and GalSim's plane differ only by the tiny distortion of the gnomonic projection
    assert np.abs(image - expected).max() < 0.3


def test_stamps_end_where_a_star_is_fainter_than_the_limit(psf_model):
    for flux in (1e2, 1e4, 1e6):
        scene = one_component(POINT, np.zeros((2, 2)), flux, 100.5, 100.5)
        size = int(stamp_sizes(scene, psf_model.edges, 0.2, 512)[0])
        assert flux * psf_model.edges[size] <= 0.2 or size == 512
        image = draw(scene, psf_model, (600, 600), 0.2)
        assert image[100, 100 + size // 2 - 1] < 0.5


def test_objects_outside_the_image_contribute_light(psf_model):
    image = draw(one_component(POINT, np.zeros((2, 2)), 1e5, -3.0, 20.0), psf_model, (64, 64), 0.1)
    whole = draw(one_component(POINT, np.zeros((2, 2)), 1e5, 61.0, 84.0), psf_model, (192, 192), 0.1)
    np.testing.assert_allclose(image[:60, :60], whole[64:124, 64:124], atol=1e-2)


@pytest.mark.slow
def test_a_truth_row_agrees_with_galsim_in_spectra_lensing_and_wcs():
    """A redshifted, lensed galaxy of two components with different spectra, drawn by GalSim's chromatic classes."""
    roman = Roman(RomanSettings(psf_degree=0), n_waves=3)
    exposure = Exposure(visit=0, detector=7, band="H158", mjd=61541.0, exptime=139.8, ra=53.0, dec=-40.0, pa=120.0)
    header = roman.header(exposure)
    wcs = WCS(header)
    ra, dec = wcs.all_pix2world(3000.3, 1200.6, 0)
    row = {
        "galaxy_id": 5,
        "ra": float(ra),
        "dec": float(dec),
        "redshift": 0.6,
        "shear_1": 0.03,
        "shear_2": -0.05,
        "convergence": 0.05,
        "size_bulge_true": 0.2,
        "size_minor_bulge_true": 0.15,
        "size_disk_true": 0.5,
        "size_minor_disk_true": 0.25,
        "position_angle_unlensed": 25.0,
        "bulge_magnorm": 21.0,
        "disk_magnorm": 21.0,
        "knots_magnorm": np.inf,
        "n_knots": 0,
        "bulge_av": 0.0,
        "bulge_rv": 3.1,
        "disk_av": 0.0,
        "disk_rv": 3.1,
        "MW_av": 0.0,
        "MW_rv": 3.1,
        "bulge_sed": 0,
        "disk_sed": 3,
        "knots_sed": 3,
        "sed_val_bulge": [],
        "sed_val_disk": [],
        "sed_val_knots": [],
    }
    no_stars = pd.DataFrame({name: np.empty(0) for name in ("id", "ra", "dec", "magnorm", "sed", "MW_av", "MW_rv")})
    library = galaxy_templates(("CWW_E", "CWW_Sbc", "CWW_Scd", "CWW_Im"), 1)
    truth = bind(pd.DataFrame([row]), no_stars, library, (), "rest")
    scene = build_scene(truth, wcs, roman.bandpass("H158"), exposure.exptime, roman.knot_smoothing).scene
    image = draw(scene, roman.psf(exposure), roman.shape, 0.01)[1200 - 48 : 1200 + 49, 3000 - 48 : 3000 + 49]

    band = galsim.roman.getBandpasses(AB_zeropoint=True)["H158"]
    at_500 = galsim.Bandpass(
        galsim.LookupTable([499.95, 500.05], [1.0, 1.0], interpolant="linear"), "nm"
    ).withZeropoint("AB")
    celestial = galsim.FitsWCS(header=galsim.FitsHeader(header))
    # FITS pixel coordinates start at 1
    local = celestial.local(galsim.PositionD(3001.3, 1201.6))
    mu = 1 / (0.95**2 - 0.03**2 - 0.05**2)

    def component(profile, major, minor, sed):
        shaped = profile(half_light_radius=np.sqrt(major * minor)).shear(
            q=minor / major, beta=(90 + 25) * galsim.degrees
        )
        spectrum = galsim.SED(f"{sed}_ext_more.sed", "Ang", "flambda").withMagnitude(21.0, at_500).atRedshift(0.6)
        return shaped.lens(0.03 / 0.95, -0.05 / 0.95, mu) * spectrum

    galaxy = component(galsim.DeVaucouleurs, 0.2, 0.15, "CWW_E") + component(galsim.Exponential, 0.5, 0.25, "CWW_Im")
    psf = galsim.roman.getPSF(7, "H158", pupil_bin=8, n_waves=3, wcs=local)
    rate = galsim.roman.collecting_area * exposure.exptime
    expected = (galsim.Convolve(galaxy, psf) * rate).drawImage(band, nx=97, ny=97, wcs=local, offset=(0.3, 0.6)).array

    assert image.sum() == pytest.approx(expected.sum(), rel=3e-3)
    assert np.abs(image - expected).max() < 4e-3 * expected.max()
    (centre, second), (centre_expected, second_expected) = (_window_moments(plane) for plane in (image, expected))
    np.testing.assert_allclose(centre, centre_expected, atol=5e-3)
    np.testing.assert_allclose(second, second_expected, rtol=5e-3, atol=2e-2)


def _window_moments(image):
    y, x = np.indices(image.shape) - 48.0
    weight = image * np.exp(-(x**2 + y**2) / (2 * 6.0**2))
    cx, cy = (weight * x).sum() / weight.sum(), (weight * y).sum() / weight.sum()
    second = [(weight * u * v).sum() / weight.sum() for u, v in ((x - cx, x - cx), (y - cy, y - cy), (x - cx, y - cy))]
    return np.array([cx, cy]), np.array(second)
