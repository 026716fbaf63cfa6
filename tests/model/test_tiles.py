"""The tile grid."""

import numpy as np
import pytest
from astropy.wcs import WCS

from romandask.model.errors import UserError
from romandask.model.settings import CoaddSettings
from romandask.model.sky import Region, unit_vectors
from romandask.model.tiles import TileGrid


def random_sky(count: int, low: float, high: float) -> tuple[np.ndarray, np.ndarray]:
    """Return random right ascensions, and declinations between two limits, degrees."""
    random = np.random.default_rng(2)
    return random.uniform(0, 360, count), random.uniform(low, high, count)


def test_default_grid_has_the_size_and_number_of_tiles_of_the_paper():
    grid = CoaddSettings().grid()
    assert grid.inner / 7200 == pytest.approx(0.0575 * 7825 / 7200)
    assert grid.pixels(0.0575) == 8825
    assert abs(len(grid.covering(Region(51, 56, -42, -38))) - 1039) < 60


@pytest.mark.parametrize("inner", [46.0, 450.0])
def test_every_position_is_on_the_padded_image_of_its_owner(inner):
    grid = TileGrid(inner, 30.0)
    ra, dec = random_sky(400, -80, 80)
    ra[:50] = np.r_[np.linspace(359.9, 360, 25), np.linspace(0, 0.1, 25)]
    for position, owner in zip(zip(ra, dec, strict=True), grid.owner(ra, dec), strict=True):
        tile = grid.tile(owner)
        pixels = grid.pixels(0.2)
        x, y = WCS(tile.header(pixels, 0.2)).all_world2pix(*position, 0)
        assert -0.5 <= x <= pixels - 0.5
        assert -0.5 <= y <= pixels - 0.5


@pytest.mark.parametrize("ra", [(10.0, 10.3), (359.9, 0.15)])
def test_covering_tiles_own_every_position_of_the_region_and_have_unique_names(ra):
    region, grid = Region(*ra, -40.2, -40.0), TileGrid(100.0, 20.0)
    tiles = grid.covering(region)
    names = [tile.name for tile in tiles]
    assert len(set(names)) == len(names)
    random = np.random.default_rng(0)
    points = (ra[0] + random.uniform(0, region.width, 3000)) % 360, random.uniform(-40.2, -40.0, 3000)
    assert set(grid.owner(*points)) <= {tile.id for tile in tiles}


def test_corners_agree_with_the_wcs_of_the_image():
    grid = TileGrid(100.0, 20.0)
    tile = grid.tile(grid.owner(12.3, -45.6))
    pixels = grid.pixels(0.2)
    corners = WCS(tile.header(pixels, 0.2)).all_pix2world([-0.5, pixels - 0.5], [-0.5, -0.5], 0)
    expected = unit_vectors(tile.corners(pixels * 0.2)[:2, 0], tile.corners(pixels * 0.2)[:2, 1])
    np.testing.assert_allclose(unit_vectors(*corners), expected, atol=1e-10)


def test_a_region_too_close_to_the_pole_is_an_error_that_names_the_setting_to_change():
    with pytest.raises(UserError, match=r"coadds\.overlap"):
        CoaddSettings().grid().covering(Region(0, 10, 89.0, 89.5))
