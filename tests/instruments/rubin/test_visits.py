"""Rubin's visits: variation of the PSF, the silicon model, and warped coadds against directly drawn ones."""

from dataclasses import replace
from pathlib import Path

import galsim
import numpy as np
import pandas as pd
import pytest
import sep

from romandask.instruments.exposure import Exposure, footprint
from romandask.instruments.psf_image import flat_shares, psf_image
from romandask.instruments.rubin.psf import DEGREE
from romandask.instruments.rubin.rubin import Rubin, RubinSettings
from romandask.kernels.coadding.warp import REACH
from romandask.kernels.rendering.psf import place_grid
from romandask.kernels.rendering.seeing import (
    ATMOSPHERE_RMS,
    FIELD_RADIUS,
    TELESCOPE_ELLIPTICITY_RMS,
    TELESCOPE_SIZE_GROWTH,
    pattern,
)
from romandask.kernels.rendering.silicon import MIN_ELECTRONS
from romandask.model.seeds import rng
from romandask.model.settings import CoaddSettings, RenderSettings, TruthSettings
from romandask.model.sky import Region
from romandask.stages.coadds.coadds import coadds
from romandask.stages.exposures.exposures import exposures
from romandask.stages.pointings import CORNERS
from romandask.stages.truth.catalogs import truth

SHAPE = (600, 616)
VISITS = 12
HALF_SIDE = 30 / 3600
REGION = Region(53 - HALF_SIDE / 0.766, 53 + HALF_SIDE / 0.766, -40 - HALF_SIDE, -40 + HALF_SIDE)


def rubin_of(mode: str, **settings) -> Rubin:
    """Return Rubin with small detectors."""
    return replace(Rubin(RubinSettings(bands=("i",), mode=mode, **settings), n_waves=3, seed=5), shape=SHAPE)


def visits(count: int = VISITS) -> list[Exposure]:
    """Return visits of the central detector, dithered by some arcseconds and rotated."""
    random = rng(3, "visits")
    shift, angle = random.uniform(-8 / 3600, 8 / 3600, (count, 2)), random.uniform(0, 360, count)
    seeing, airmass = random.uniform(0.5, 0.8, count), random.uniform(1, 1.4, count)
    return [
        Exposure(
            visit=k,
            detector=94,
            band="i",
            mjd=61000.0 + k,
            exptime=30.0,
            ra=53 + shift[k, 0] / 0.766,
            dec=-40 + shift[k, 1],
            pa=angle[k],
            seeing=seeing[k],
            airmass=airmass[k],
            sky_brightness=20.3,
        )
        for k in range(count)
    ]


def table_of(rubin: Rubin, exposures: list[Exposure]) -> pd.DataFrame:
    """Return the pointings table of some exposures."""
    corners = [footprint(rubin.header(exposure), rubin.shape).ravel() for exposure in exposures]
    return pd.DataFrame([vars(e) | dict(zip(CORNERS, c, strict=True)) for e, c in zip(exposures, corners, strict=True)])


def survey(mode: str, chosen: list[Exposure] | None = None, **settings):
    """Return the lazy exposures, the lazy coadds and the tile of a crowded field of stars and galaxies."""
    rubin = rubin_of(mode, **settings)
    catalogs = truth(
        TruthSettings(order=11, margin=20.0, nside=64, stars=80, galaxies=150),
        Path("."),
        REGION,
        {"i": rubin.bandpass("i")},
        5,
    )
    product = exposures(table_of(rubin, chosen or visits()), catalogs, rubin, RenderSettings(n_waves=3), 5)
    grid = CoaddSettings(pixels=1000, overlap=60)
    tile = next(tile for tile in grid.grid().covering(REGION) if tile.id == grid.grid().owner(53.0, -40.0))
    return product, coadds(product, [tile], grid), tile


@pytest.fixture(scope="module")
def both():
    """The tile warped from visits, the same tile drawn directly, and its definition."""
    (_, warped, tile), (_, drawn, _) = survey("visits"), survey("coadd")
    return warped.load(0), drawn.load(0), tile


def test_statistics_of_the_psf_patterns():
    every = np.stack([pattern(rng(1, "psf", k)).atmosphere([0.0, 4000.0], [0.0, -2000.0]) for k in range(2000)])
    size, plus = every[..., :2].mean(axis=-1), (every[..., 0] - every[..., 1]) / 2
    for part in (size, plus, every[..., 2]):
        assert part.mean() == pytest.approx(0, abs=4 * ATMOSPHERE_RMS / np.sqrt(2000))
        assert part.std() == pytest.approx(ATMOSPHERE_RMS, rel=0.1)
    # turbulence is correlated over short distances and uncorrelated over long ones
    near = np.stack([pattern(rng(1, "psf", k)).atmosphere([0.0, 20.0], [0.0, 0.0]) for k in range(500)])[..., 2]
    assert np.corrcoef(near.T)[0, 1] > 0.98
    assert abs(np.corrcoef(every[..., 2].T)[0, 1]) < 0.3
    middle, edge = (
        np.stack([pattern(rng(1, "psf", k)).telescope(np.array([r]), np.array([0.0])) for k in range(500)])[:, 0]
        for r in (0.0, FIELD_RADIUS)
    )
    growth = edge[:, :2].mean() - middle[:, :2].mean()
    assert growth == pytest.approx(TELESCOPE_SIZE_GROWTH, rel=1e-6)
    assert (middle[:, 0] - middle[:, 1]).std() / 2 == pytest.approx(TELESCOPE_ELLIPTICITY_RMS * np.sqrt(0.5), rel=0.15)


def test_psf_over_a_detector_agrees_with_galsim():
    """At the edge of the field, where the PSF varies most: the polynomial model against GalSim profiles."""
    rubin = Rubin(RubinSettings(bands=("i",), mode="visits"), n_waves=2, seed=5)
    exposure = replace(visits(1)[0], detector=3)
    shares = flat_shares(rubin.bandpass("i"))
    model, moments = rubin.psf(exposure), []
    assert len(place_grid(rubin.shape, DEGREE)) > 6
    for x, y in ((200.0, 300.0), (3900.0, 3500.0), (2035.5, 1999.5)):
        weights = model.weights(shares[None], np.array([x]), np.array([y]))[0]
        mean = np.tensordot(weights, model.modes, 1)
        nodes = rubin.profiles(exposure, x, y)
        psf = galsim.Sum([one * share for one, share in zip(nodes, shares, strict=True)])
        with_pixel = galsim.Convolve(psf, galsim.Pixel(0.2))
        rows, columns = (axis / 0.2 for axis in model.core.axes())
        chosen = [(40, 10), (128, 0), (150, 25), (120, 40)]
        expected = [with_pixel.kValue(columns[i], rows[j]) for j, i in chosen]
        np.testing.assert_allclose([mean[j, i] for j, i in chosen], expected, atol=1e-3)
        exact = psf_image(rubin, exposure, x, y)
        moments.append(galsim.hsm.FindAdaptiveMom(galsim.ImageD(exact.astype(float))))
    shapes = np.array([[one.moments_sigma, one.observed_shape.g1, one.observed_shape.g2] for one in moments])
    assert np.ptp(shapes, axis=0).max() > 2e-3


def test_an_exposure_has_raw_data_and_a_calibrated_image():
    # an exposure long enough for some cosmic rays on a small detector
    chosen = [replace(visits(1)[0], exptime=900.0)]
    product, _, _ = survey("visits", chosen)
    made = product.load(0)
    assert made["raw"].dtype == np.int32
    assert made["raw"].min() > 20_000
    again = survey("visits", chosen)[0].load(0)
    for name, plane in made.items():
        np.testing.assert_array_equal(plane, again[name])
    view = product.renderer.view(0)
    rays = (made["dq"] & 256) > 0
    assert 0 < rays.sum() < 0.01 * rays.size
    good = made["dq"] == 0
    pull = (made["image"] - made["truth"] - view.background)[good] / np.sqrt(made["variance"][good])
    # robust statistics, because the last pixels of a blooming trail are not full and not flagged
    assert np.median(pull) == pytest.approx(0, abs=0.01)
    assert 1.4826 * np.median(np.abs(pull)) == pytest.approx(1, abs=0.01)


@pytest.mark.slow
def test_warped_and_drawn_tiles_agree(both):
    """Weights, depth and PSF agree, positions within 0.02 arcsec and fluxes within their errors."""
    warped, drawn, tile = both
    covered = (warped["nimages"] == VISITS) & (drawn["nimages"] == VISITS) & (warped["dq"] == 0)
    assert covered.mean() > 0.3
    np.testing.assert_allclose(warped["weight"][covered], drawn["weight"][covered], rtol=2e-3)
    assert np.abs(warped["psf"] - drawn["psf"]).max() < 0.01 * drawn["psf"].max()
    images = [np.ascontiguousarray(one["image"]) for one in (warped, drawn)]
    mask = ~covered
    # depth, from the scatter of aperture fluxes in the noise realisations
    random = rng(1, "apertures")
    x, y = random.uniform(20, 268, (2, 3000))
    fluxes = [sep.sum_circle(np.ascontiguousarray(one["noise"][0]), x, y, 4.0, mask=mask) for one in (warped, drawn)]
    inside = (fluxes[0][2] == 0) & (fluxes[1][2] == 0)
    depths = [np.std(flux[0][inside]) for flux in fluxes]
    assert abs(2.5 * np.log10(depths[0] / depths[1])) < 0.05
    rms = 1 / np.sqrt(np.median(drawn["weight"][covered]))
    found = sep.extract(images[1], 6 * rms, mask=mask, minarea=9)
    pairs = [sep.sum_circle(image, found["x"], found["y"], 5.0, mask=mask) for image in images]
    clean = (pairs[0][2] == 0) & (found["flag"] == 0)
    assert clean.sum() > 20
    flux = [pair[0][clean] for pair in pairs]
    error = np.sqrt(np.pi * 25 * rms**2 * 2.2 + 2 * np.maximum(flux[1], 0) * 31.4 / 1000)
    pull = (flux[0] - flux[1]) / error
    assert np.abs(np.median(pull)) < 0.6
    assert np.percentile(np.abs(pull), 90) < 3
    bright = clean.copy()
    bright[clean] = flux[1] > 60 * rms * np.sqrt(np.pi * 25)
    assert bright.sum() >= 8
    positions = [sep.winpos(image, found["x"][bright], found["y"][bright], 1.5, mask=mask)[:2] for image in images]
    offset = 0.2 * (np.array(positions[0]) - np.array(positions[1]))
    assert np.abs(np.median(offset, axis=1)).max() < 0.01
    assert np.sqrt(np.mean(offset**2)) < 0.02


def test_noise_realisations_of_warped_tiles_are_correlated(both):
    """The scatter of the noise realisation is that of uncorrelated noise after Lanczos-3 interpolation."""
    warped, drawn, _ = both
    covered = (warped["nimages"] == VISITS) & (drawn["nimages"] == VISITS)
    ratio = warped["noise"][0][covered].std() * np.sqrt(np.median(warped["weight"][covered]))
    fraction = np.linspace(0, 1, 101)[:-1, None] - np.arange(1 - REACH, REACH + 1)
    weights = np.sinc(fraction) * np.sinc(fraction / REACH)
    weights /= weights.sum(axis=1, keepdims=True)
    assert ratio == pytest.approx(np.mean((weights**2).sum(axis=1)), rel=0.03)


@pytest.mark.slow
def test_silicon_model_broadens_bright_stars_and_keeps_their_flux():
    """Isolated stars just below saturation, in the same exposure with and without the silicon model."""
    made = {}
    for sensor in ("ideal", "silicon"):
        product, _, _ = survey("visits", visits(1), sensor=sensor, cosmic_rays=False)
        made[sensor] = product.make(0)
    view = product.renderer.view(0)
    scene, fluxes = view.drawable.scene, view.drawable.scene.fluxes()
    distance = np.hypot(scene.x[:, None] - scene.x, scene.y[:, None] - scene.y) + 1e9 * (
        fluxes < 0.05 * fluxes[:, None]
    )
    np.fill_diagonal(distance, 1e9)
    edge = np.minimum(np.minimum(scene.x, SHAPE[1] - scene.x), np.minimum(scene.y, SHAPE[0] - scene.y))
    chosen = np.flatnonzero((fluxes > 4e5) & (fluxes < 1.5e6) & (distance.min(axis=1) > 25) & (edge > 40))
    assert len(chosen) >= 3
    growth = []
    for n in chosen:
        i, j = int(round(scene.x[n])), int(round(scene.y[n]))
        part = slice(j - 20, j + 21), slice(i - 20, i + 21)
        stamps = [(made[name]["image"] - view.background)[part].astype(float) for name in ("ideal", "silicon")]
        error = np.sqrt(2 * (view.background[part].sum() + fluxes[n]))
        assert stamps[1].sum() == pytest.approx(stamps[0].sum(), abs=4 * error + 0.003 * fluxes[n])
        sizes = [galsim.hsm.FindAdaptiveMom(galsim.ImageD(stamp)).moments_sigma for stamp in stamps]
        growth.append((sizes[1] / sizes[0] - 1) / fluxes[n])
    # collected charge repels later charge: the size grows by some tenths of a per cent, in proportion to the flux
    assert 1e-3 < np.median(growth) * 1e6 < 3e-2
    # the noiseless image does not depend on the sensor
    np.testing.assert_allclose(made["ideal"]["truth"], made["silicon"]["truth"], rtol=1e-4, atol=0.5)
    assert (fluxes[chosen] > MIN_ELECTRONS).all()
