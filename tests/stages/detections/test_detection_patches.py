"""Detection by patches, compared with detection on a tile in one piece."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from scipy import ndimage

from romandask.model.seeds import rng
from romandask.model.settings import CoaddSettings, DetectionSettings
from romandask.model.sky import Region
from romandask.stages.coadds.coadds import coadds
from romandask.stages.detections.coadd_noise import coadd_noise, sample_windows
from romandask.stages.detections.detections import NUMBER_BITS, Detections, detections
from romandask.stages.detections.tile_field import BORDER

PIXELS, PATCH = 1400, 350


def sky(pixels: int) -> np.ndarray:
    """Return galaxies, many of them blended, and some bright stars with wings."""
    random = rng(11, "sky")
    image = np.zeros((pixels, pixels))
    count = pixels**2 // 1500
    flux = 10 ** random.uniform(1.6, 3.6, count)
    flux[:6] = 3e5
    for value, x, y in zip(flux, *random.integers(0, pixels, (2, count)), strict=True):
        size = random.uniform(1.2, 3.0) if value < 1e5 else 1.5
        half = 40 if value < 1e5 else 150
        v, u = np.mgrid[max(y - half, 0) : min(y + half, pixels), max(x - half, 0) : min(x + half, pixels)]
        e, phi = random.uniform(0.4, 1), random.uniform(0, np.pi)
        a = (u - x) * np.cos(phi) + (v - y) * np.sin(phi)
        b = (v - y) * np.cos(phi) - (u - x) * np.sin(phi)
        profile = np.exp(-np.hypot(a, b / e) / size)
        if value > 1e5:
            profile = profile + 0.002 * (1 + np.hypot(a, b) ** 2 / 4) ** -1.2
        image[v, u] += value * profile / profile.sum()
    return ndimage.gaussian_filter(image, 1.2)


@pytest.fixture(scope="module")
def planes():
    """Arrays of a tile: drizzled noise, half as many exposures on one side, a corner without data."""
    random = rng(12, "noise")
    weight = np.full((PIXELS, PIXELS), 4.0)
    weight[:, :500] = 2.0
    weight[900:, 1200:] = 0
    seen = weight > 0

    def realisation() -> np.ndarray:
        noise = ndimage.gaussian_filter(random.normal(size=weight.shape) * 2 / np.sqrt(np.where(seen, weight, 1)), 0.7)
        return np.where(seen, noise, 0)

    psf = np.zeros((65, 65))
    psf[32, 32] = 1
    return {
        "image": np.where(seen, sky(PIXELS) + realisation(), 0).astype(np.float32),
        "noise": realisation()[None].astype(np.float32),
        "weight": (100 * weight).astype(np.float32),
        "nimages": weight.astype(np.uint16),
        "dq": np.zeros(weight.shape, np.uint8),
        "set": np.zeros(weight.shape, np.uint16),
        "psf": ndimage.gaussian_filter(psf, 1.5).astype(np.float32),
    }


def lazy(small, planes, method: str, patch_pixels: int) -> Detections:
    """Return the detections of one tile with these planes, in patches of about `patch_pixels` a side."""
    settings = CoaddSettings(pixels=PIXELS, overlap=100, patch_pixels=patch_pixels)
    instrument = replace(small.roman, detection=method)
    exposures = replace(small.product, renderer=replace(small.product.renderer, instrument=instrument))
    made = coadds(exposures, settings.grid().covering(small.region)[:1], settings)
    layout = made.product.layout

    def make(index: int) -> dict[str, np.ndarray]:
        window = layout.patches.window(*layout.place(index)[-2:])
        return {name: plane if name == "psf" else plane[(..., *window)] for name, plane in planes.items()}

    made = replace(made, product=replace(made.product, make=make))
    (tile,), half = made.tiles, settings.grid().inner / 3600
    region = Region(tile.ra - half, tile.ra + half, tile.dec - half, tile.dec + half)
    return detections(made, coadd_noise(made), DetectionSettings(), region)


@pytest.fixture(scope="module", params=["median", "peaks"])
def both(request, small, planes) -> tuple[Detections, Detections]:
    """The same tile in one piece and in patches, with the two methods of detection."""
    return lazy(small, planes, request.param, PIXELS), lazy(small, planes, request.param, PATCH)


@pytest.fixture(scope="module")
def made(both) -> tuple[pd.DataFrame, pd.DataFrame]:
    """Objects of the tile in one piece and in patches, by objectId."""
    one, many = both
    assert len(one.units) == 1
    assert len(many.units) == 16
    return one.tile_objects(0).set_index("objectId"), many.tile_objects(0).set_index("objectId")


def test_objects_of_patches_are_those_of_the_tile_in_one_piece(made):
    whole, parts = made
    assert len(whole) > 300
    assert (whole["flags"] & 1).sum() > 50, "many are blended"
    assert parts.index.is_unique
    common = whole.index.intersection(parts.index)
    a, b = whole.loc[common], parts.loc[common]
    near = np.hypot(a["x"] - b["x"], a["y"] - b["y"]) < 0.1
    alike = np.abs(b["H158_kronFlux"] / a["H158_kronFlux"] - 1) < 0.01
    assert (near & alike).sum() >= 0.995 * len(whole)
    assert len(parts) <= 1.005 * len(whole)


def test_every_object_has_the_patch_of_its_peak_and_a_number_that_says_where_it_is(both, made):
    many, (_, parts) = both[1], made
    numbers = parts.index.to_numpy() & ((1 << NUMBER_BITS) - 1)
    y, x = np.divmod(numbers - 1, PIXELS)
    assert np.median(np.hypot(x - parts["x"], y - parts["y"])) < 1
    side = many.coadds.settings.patch_pixels
    assert (parts["patch"] == [f"r{j // side}c{i // side}" for i, j in zip(x, y, strict=True)]).all()
    assert parts["patch"].nunique() == 16


def test_the_segmentation_of_patches_fits_together_at_their_borders(both, made):
    """A pixel of one patch may belong to an object of another."""
    (one, many), (_, parts) = both, made
    whole = one.load(0)["segmentation"]
    grid = many.product.patches
    patches = np.block(
        [[many.load(row * 4 + column)["segmentation"] for column in range(grid.count)] for row in range(grid.count)]
    )
    assert patches.shape == whole.shape
    assert (patches != whole).sum() <= 0.005 * (whole > 0).sum()
    side = grid.side
    left, right = patches[:, side - 1], patches[:, side]
    across = (left > 0) & (left == right)
    assert across.sum() > 10
    numbers = set((parts.index.to_numpy() & ((1 << NUMBER_BITS) - 1)).tolist())
    assert len(numbers & set(left[across].tolist())) > 3


def test_a_patch_reads_only_the_coadds_under_it_and_its_border(both):
    many = both[1]
    units = [[name for stage, name in unit.inputs if stage.startswith("coadds")] for unit in many.units]
    reach = -(-round(BORDER / many.instrument.coadd_scale) // many.product.patches.side)
    assert reach == 1
    expected = {0: 4, 1: 6, 5: 9}
    assert {k: len(units[k]) for k in expected} == expected
    assert all((many.noise.stage, many.tiles[0].name) in unit.inputs for unit in many.units)


@pytest.mark.parametrize("pixels", [100, 2048, 2538, 8825])
def test_noise_is_sampled_in_windows_of_one_size_inside_the_tile(pixels):
    windows = sample_windows(pixels)
    sizes = {(rows.stop - rows.start, columns.stop - columns.start) for rows, columns in windows}
    assert len(sizes) == 1
    seen = np.zeros((pixels, pixels), bool)
    for rows, columns in windows:
        assert 0 <= rows.start < rows.stop <= pixels
        assert 0 <= columns.start < columns.stop <= pixels
        seen[rows, columns] = True
    assert seen.sum() == min(pixels**2, 4 * 10**6 + 194_304), "windows do not overlap"
