"""Patches of coadds: the pixels of a drizzled tile do not depend on how it is divided."""

from dataclasses import dataclass, replace

import numpy as np
import pytest

from romandask.export.asdf import tile_sets
from romandask.instruments.exposure import EXPOSURE_COLUMNS
from romandask.instruments.roman.roman import Roman, RomanSettings
from romandask.kernels.coadding.background import background_mesh
from romandask.kernels.detectors.simple_detector import DQ_FLAGS, SATURATED
from romandask.model.sky import touching_pairs
from romandask.model.tiles import PatchGrid
from romandask.stages.coadds.coadds import coadds, patch_members
from romandask.stages.exposures.render import RenderExposure
from romandask.stages.pointings import corners_of

ARRAYS = ("image", "weight", "noise", "nimages", "dq")


@dataclass(frozen=True)
class RandomExposures(RenderExposure):
    """Makes exposures of random pixels, of which some are bad or saturated."""

    def __call__(self, index):
        random = np.random.default_rng(index)
        image = random.poisson(100, self.instrument.shape).astype(np.int32)
        dq = np.zeros(image.shape, np.uint8)
        dq[random.random(image.shape) < 0.01] = SATURATED
        dq[random.random(image.shape) < 0.01] = DQ_FLAGS["no_data"] if "no_data" in DQ_FLAGS else 1
        return {"image": image, "dq": dq, "truth": image, "background_mesh": background_mesh(image, dq > 0)}


@pytest.fixture(scope="module")
def random_exposures(small):
    renderer = RandomExposures(**vars(small.product.renderer))
    return replace(small.product, product=replace(small.product.product, make=renderer), renderer=renderer)


def busiest(product):
    """Return the tile with the most exposures in H158."""
    return max(range(len(product.tiles)), key=lambda k: len(product.tile_members(k, "H158")))


def made(exposures, small, patch_pixels, tile):
    """Return the product with patches of a given size, and the whole arrays of a tile in H158."""
    product = coadds(exposures, small.tiles, small.settings.model_copy(update={"patch_pixels": patch_pixels}))
    return product, product.read(tile, "H158", ARRAYS)


def test_the_pixels_of_a_tile_do_not_depend_on_its_patches(small, random_exposures):
    tile = busiest(coadds(random_exposures, small.tiles, small.settings))
    one, whole = made(random_exposures, small, 4096, tile)
    assert one.patches.count == 1
    assert whole["nimages"].max() >= 2
    assert whole["dq"].any()
    for patch_pixels in (small.settings.pixels // 2, small.settings.pixels // 3 + 1):
        product, divided = made(random_exposures, small, patch_pixels, tile)
        assert product.patches.count > 1
        for name in ARRAYS:
            np.testing.assert_array_equal(divided[name], whole[name], err_msg=f"{name} {patch_pixels}")


def test_the_sets_of_a_patch_are_those_of_its_pixels(small, random_exposures):
    settings, found = small.settings.model_copy(update={"patch_pixels": 130}), 0
    product = coadds(random_exposures, small.tiles, settings)
    tile = busiest(product)
    for unit in product.units_of(tile, "H158"):
        loaded = product.load(unit, ("set", "sets", "nimages"))
        table = loaded["sets"]
        sizes = table.groupby("set").size()
        numbers = np.unique(loaded["set"])
        assert set(sizes.index) == set(numbers[numbers > 0])
        for number in numbers[numbers > 0]:
            inside = loaded["set"] == number
            assert (loaded["nimages"][inside] == sizes[number]).all()
            assert (table.loc[table["set"] == number, "pixels"] == inside.sum()).all()
            found += 1
        names = [random_exposures.names[i] for i in product.patch(unit).members]
        assert set(table["exposure"]) <= set(names)
    assert found


def test_units_are_named_by_tile_band_and_patch(small):
    product = coadds(small.product, small.tiles, small.settings)
    name = small.tiles[0].name
    assert product.names[0] == f"{name}-H158-r0c0"
    divided = coadds(small.product, small.tiles, small.settings.model_copy(update={"patch_pixels": 60}))
    patch = divided.patch(divided.index(1, "H158", 2, 1))
    assert divided.names[divided.index(1, "H158", 2, 1)] == f"{small.tiles[1].name}-H158-r2c1"
    assert (patch.row, patch.column, patch.tile) == (2, 1, small.tiles[1])


def test_the_members_of_a_patch_have_all_exposures_that_touch_it(small):
    roman = Roman(RomanSettings(bands=("H158",)))
    roman = replace(roman, shape=small.roman.shape)
    table = small.product.table
    patches = PatchGrid(small.settings.grid().pixels(0.0575), 60)
    members = patch_members(table, small.tiles, patches, roman)
    product = coadds(small.product, small.tiles, small.settings.model_copy(update={"patch_pixels": 60}))
    assert len(members) == len(small.tiles) * patches.count**2
    footprints = np.stack([product.patch(k).footprint for k in range(len(members))])
    e, p = touching_pairs(corners_of(table), footprints)
    extra = 0
    for unit in range(len(members)):
        assert set(e[p == unit]) <= set(members[unit])
        extra += len(members[unit]) - (p == unit).sum()
    assert 0 < extra < members.counts.sum() / 2, "the margin adds few"
    assert set(EXPOSURE_COLUMNS) <= set(table)


def test_the_sets_of_a_tile_are_those_of_all_its_patches(small, random_exposures):
    """An exported mosaic has one numbering of sets, although each patch has its own."""
    product = coadds(random_exposures, small.tiles, small.settings.model_copy(update={"patch_pixels": 130}))
    tile = busiest(product)
    numbers, sets = tile_sets(product, tile, "H158")
    count = product.read(tile, "H158", ("nimages",))["nimages"]
    sizes = sets.groupby("set").size().reindex(range(numbers.max() + 1), fill_value=0).to_numpy()
    np.testing.assert_array_equal(sizes[numbers], count)
    assert (sets.groupby("set")["pixels"].first() == np.bincount(numbers.ravel())[sets["set"].unique()]).all()
