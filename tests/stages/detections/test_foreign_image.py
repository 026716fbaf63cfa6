"""Detection and photometry of an image that romandask did not make: a FITS file drawn by GalSim."""

import galsim
import numpy as np
import pytest
from astropy.io import fits
from astropy.wcs import WCS

import romandask as rd
from romandask.kernels.measurement.detected_objects import FLAGS
from romandask.model.settings import DetectionSettings
from romandask.model.tiles import tangent_header

PIXELS, SCALE, NOISE = 700, 0.11, 3.0
PSF = galsim.Moffat(beta=3.0, fwhm=0.3)


@pytest.fixture(scope="module")
def sources() -> list[tuple[float, float, float, float]]:
    """Column, row, flux (nJy) and half-light radius (arcsec; 0 for a star) of isolated sources on a grid."""
    random = np.random.default_rng(3)
    places = [(60 + 58 * i, 60 + 58 * j) for i in range(11) for j in range(11)]
    fluxes = 10 ** random.uniform(3.2, 4.5, len(places))
    radii = np.where(np.arange(len(places)) % 2, random.uniform(0.1, 0.25, len(places)), 0.0)
    shifts = random.uniform(-0.5, 0.5, (len(places), 2))
    return [(x + dx, y + dy, f, r) for (x, y), (dx, dy), f, r in zip(places, shifts, fluxes, radii, strict=True)]


@pytest.fixture(scope="module")
def file(sources, tmp_path_factory):
    """The image as another program would hand it over: SCI, WHT, NOISE and PSF in one file."""
    image = galsim.ImageF(PIXELS, PIXELS, scale=SCALE)
    for x, y, flux, radius in sources:
        profile = PSF if radius == 0 else galsim.Convolve(galsim.Exponential(half_light_radius=radius), PSF)
        stamp = profile.withFlux(flux).drawImage(nx=57, ny=57, scale=SCALE, center=galsim.PositionD(x + 1, y + 1))
        bounds = stamp.bounds & image.bounds
        image[bounds] += stamp[bounds]
    random = np.random.default_rng(7)
    noisy = image.array + random.normal(0, NOISE, image.array.shape)
    realisation = random.normal(0, NOISE, image.array.shape)
    weight = np.full(image.array.shape, 1 / NOISE**2)
    star = PSF.drawImage(nx=41, ny=41, scale=SCALE).array
    header = fits.Header(list(tangent_header(ra=53.0, dec=-40.0, pixels=PIXELS, scale=SCALE).items()))
    planes = [fits.ImageHDU(noisy.astype(np.float32), header, name="SCI")]
    for name, plane in (("WHT", weight), ("NOISE", realisation), ("PSF", star)):
        planes.append(fits.ImageHDU(plane.astype(np.float32), name=name))
    path = tmp_path_factory.mktemp("foreign") / "image.fits"
    fits.HDUList([fits.PrimaryHDU(), *planes]).writeto(path)
    return path


def test_objects_of_a_fits_image_by_galsim_are_found_and_measured(file, sources):
    with fits.open(file) as hdus:
        planes = {name: hdus[name].data.astype(np.float32) for name in ("SCI", "WHT", "NOISE", "PSF")}
        wcs = WCS(hdus["SCI"].header)
    names = {"image": "SCI", "weight": "WHT", "noise": "NOISE", "psf": "PSF"}
    field = rd.ArrayField(
        bands=("J",),
        detection_bands=("J",),
        method="median",
        pixel_scale=SCALE,
        aperture=0.6,
        electrons_per_njy={"J": 0.0},
        weight_is_exposure_time=True,
        images={"J": {ours: planes[theirs] for ours, theirs in names.items()}},
    )
    objects, segmentation = rd.detect_and_measure(field, wcs, DetectionSettings())
    assert segmentation.shape == (PIXELS, PIXELS)
    x, y, flux, radius = np.array(sources).T
    gap = np.hypot(objects["x"].to_numpy()[:, None] - x, objects["y"].to_numpy()[:, None] - y)
    nearest = gap.argmin(axis=1)
    real = gap.min(axis=1) < 2
    # all sources, each once, and nothing else
    assert real.all()
    assert sorted(nearest) == list(range(len(sources)))
    assert (objects["flags"] & ~FLAGS["kron_nonpositive"] == 0).all()
    np.testing.assert_array_equal(
        segmentation[np.rint(y).astype(int), np.rint(x).astype(int)][nearest], objects["label"]
    )
    true, star = flux[nearest], radius[nearest] == 0
    pulls = ((objects["J_psfFlux"] - true) / objects["J_psfFluxErr"])[star]
    assert abs(pulls.mean()) < 4 / np.sqrt(star.sum())
    assert pulls.std() == pytest.approx(1, abs=0.3)
    # a Kron aperture of 2.5 radii holds 90 to 100% of the light
    ratio = objects["J_kronFlux"] / true
    assert 0.93 < np.median(ratio[star]) < 1.01
    assert 0.88 < np.median(ratio[~star]) < 1.01
    ra, dec = wcs.all_pix2world(objects["x"], objects["y"], 0)
    np.testing.assert_allclose(objects["coord_ra"], ra)
    np.testing.assert_allclose(objects["coord_dec"], dec)
    assert objects["extendedness"][~star].mean() > 0.9
    assert objects["extendedness"][star].mean() < 0.1
