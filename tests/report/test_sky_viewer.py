"""Sky viewer: its pictures show the coadds at their positions, also in a browser."""

import re
import shutil
import subprocess
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import romandask
from romandask.report.sky_viewer import Layer, _halved, _plane, write_sky_viewer

BROWSERS = ("chromium", "chromium-browser", "google-chrome")
BROWSER_OPTIONS = (
    "--headless",
    "--no-sandbox",
    "--disable-gpu",
    "--disable-quic",
    "--no-first-run",
    "--disable-sync",
    "--disable-background-networking",
    "--disable-component-update",
    "--virtual-time-budget=5000",
)


@pytest.fixture(scope="module")
def survey(tiny_store):
    return romandask.open(tiny_store)


@pytest.fixture(scope="module")
def page(survey, tmp_path_factory) -> Path:
    return write_sky_viewer(survey, tmp_path_factory.mktemp("page"))


@pytest.fixture(scope="module")
def star(survey) -> tuple[float, float]:
    """Position (degrees) of the brightest Roman point source, whose centroid is hardly affected by noise."""
    objects = survey.objects("roman").compute()
    brightest = objects.loc[objects.loc[objects["extendedness"] == 0, "H158_psfFlux"].idxmax()]
    return float(brightest["coord_ra"]), float(brightest["coord_dec"])


@pytest.mark.parametrize("name", ["roman", "rubin"])
def test_a_picture_has_the_pixels_of_the_tiles_that_own_its_positions(survey, name):
    layer = Layer(survey.output(f"coadds/{name}"), _plane(survey))
    row, column = 0, 0
    planes = layer.sampled(row, column)
    ra, dec = layer.plane.sky(layer.finest, row, column)
    finite = np.argwhere(np.isfinite(planes).all(axis=0))
    assert len(finite) > 1000
    dataset = survey.coadds(name)
    grid = survey.pipeline.coadds.grid()
    for y, x in finite[:: len(finite) // 25]:
        owner = grid.owner(ra[y, x], dec[y, x])
        number = next(k for k, tile in enumerate(survey.tiles) if tile.id == owner)
        pixel = layer.coadds.wcs(number).all_world2pix(ra[y, x], dec[y, x], 0)
        i, j = (int(np.rint(float(value))) for value in pixel)
        for plane, band in zip(planes, layer.bands, strict=True):
            expected = dataset["image"].isel(tile=number, y=j, x=i).sel(band=band).values
            assert plane[y, x] == pytest.approx(expected / layer.noise[band], rel=1e-6)


def test_a_coarser_picture_is_the_mean_of_the_finite_pixels():
    planes = np.arange(48, dtype=np.float32).reshape(3, 4, 4)
    planes[0, :2, :2] = np.nan
    planes[1, 0, 0] = np.nan
    halved = _halved(planes)
    assert np.isnan(halved[0, 0, 0])
    assert halved[1, 0, 0] == pytest.approx(planes[1, [0, 1, 1], [1, 0, 1]].mean())
    np.testing.assert_allclose(halved[2], planes[2].reshape(2, 2, 2, 2).mean(axis=(1, 3)))


def test_every_level_down_to_the_pixels_of_each_survey_is_written(survey, page):
    for name, finest in (("roman", 0), ("rubin", 1)):
        levels = sorted(int(path.name) for path in (page.parent / name).iterdir())
        assert levels == list(range(finest, _plane(survey).top + 1))
        assert len(list((page.parent / name / str(levels[-1])).iterdir())) == 1
    assert not re.search(r"(src|href)=.?https?:", page.read_text())


def test_a_browser_shows_an_object_at_its_catalog_position(page, star, tmp_path):
    browser = next((found for name in BROWSERS if (found := shutil.which(name))), None)
    if browser is None:
        pytest.skip(f"needs a browser: {', '.join(BROWSERS)}")
    for name in ("roman", "rubin"):
        address = f"{page.as_uri()}#{star[0]},{star[1]},0.0575,{name}"
        arguments = [browser, *BROWSER_OPTIONS, f"--user-data-dir={tmp_path}/{name}", "--window-size=600,500"]
        shot = tmp_path / f"{name}.png"
        subprocess.run([*arguments, f"--screenshot={shot}", address], capture_output=True, timeout=120, check=True)
        done = subprocess.run(
            [*arguments, "--dump-dom", address], capture_output=True, text=True, timeout=120, check=True
        )
        counts = {key: int(value) for key, value in re.findall(r'data-(\w+)="(\d+)"', done.stdout)}
        assert counts["shown"] > 0
        assert (counts["coming"], counts["lost"]) == (0, 0)
        assert f"RA {star[0]:.6f}° Dec {star[1]:.6f}°" in done.stdout
        picture = np.asarray(Image.open(shot).convert("L"), float)
        assert picture.shape == (500, 600)
        middle = picture[210:291, 260:341]
        y, x = np.mean(np.argwhere(middle >= middle.max() - 5), axis=0) - 40
        assert np.hypot(y, x) < 4, "within one Rubin pixel"
        assert middle.max() > 150
