"""Image products divided into patches: whole images on disk, units that are patches, windows across patches."""

from dataclasses import replace

import numpy as np
import pytest
import xarray as xr
import zarr

from romandask.model.tiles import PatchGrid
from romandask.products.images import ImageProduct
from romandask.products.units import Unit
from romandask.storage.arrays import Variable
from romandask.storage.manifest import Record, write_record
from romandask.storage.store import Store

PIXELS = 101
TILES, BANDS = 2, 3
RNG = np.random.default_rng(5)
TRUTH = {
    "image": RNG.normal(size=(TILES, BANDS, PIXELS, PIXELS)).astype(np.float32),
    "noise": RNG.normal(size=(TILES, BANDS, 2, PIXELS, PIXELS)).astype(np.float32),
    "plain": RNG.normal(size=(TILES, BANDS, PIXELS, PIXELS)).astype(np.float32),
}


def product(patch_pixels: int = 34) -> ImageProduct:
    """Return a product of two tiles in three bands whose units are patches of TRUTH."""
    patches = PatchGrid(PIXELS, patch_pixels)
    count = patches.count
    variables = (
        Variable("image", "float32", (PIXELS, PIXELS), ("y", "x"), {}),
        Variable("noise", "float32", (2, PIXELS, PIXELS), ("realisation", "y", "x"), {}),
        Variable("plain", "float32", (PIXELS, PIXELS), ("y", "x"), {}, compress=False),
        Variable("psf", "float32", (5, 5), ("v", "u"), {}),
    )

    def make(index):
        tile, band, row, column = np.unravel_index(index, (TILES, BANDS, count, count))
        window = patches.window(int(row), int(column))
        made = {name: array[tile, band][(..., *window)].copy() for name, array in TRUTH.items()}
        return {**made, "noise": lambda: made["noise"], "psf": np.full((5, 5), index, np.float32)}

    units = tuple(Unit(f"u{k}", k) for k in range(TILES * BANDS * count**2))
    return ImageProduct(
        stage="coadds/x",
        units=units,
        make=make,
        variables=variables,
        axes=("tile", "band"),
        lengths=(TILES, BANDS),
        coordinates=lambda: {"tile": (("tile",), np.arange(TILES), {})},
        patches=patches,
    )


def stored(tmp_path, chosen=None, patch_pixels: int = 34) -> ImageProduct:
    """Return the product with the chosen units stored, by default all."""
    store, lazy = Store(tmp_path), product(patch_pixels)
    lazy.prepare(store)
    for index in range(len(lazy.units)) if chosen is None else chosen:
        made = lazy.write(index, store)
        write_record(store, Record("coadds/x", f"u{index}", "", made.output, 0, 0, 0.0, 0))
    return lazy.stored(store)


@pytest.mark.parametrize(
    ("pixels", "patch_pixels"), [(8825, 2048), (2540, 2048), (101, 34), (10, 3), (7, 100), (33, 8)]
)
def test_patches_cover_an_image_once_and_have_an_even_side(pixels, patch_pixels):
    patches = PatchGrid(pixels, patch_pixels)
    covered = np.zeros((pixels, pixels), int)
    for row in range(patches.count):
        for column in range(patches.count):
            window = patches.window(row, column)
            assert covered[window].size > 0
            covered[window] += 1
    assert (covered == 1).all()
    assert patches.side % 2 == 0


def test_the_tiles_of_the_paper_have_sixteen_patches_and_those_of_rubin_one():
    assert (PatchGrid(8825, 2048).count, PatchGrid(8825, 2048).side) == (4, 2208)
    assert PatchGrid(2540, 2048).count == 1


def test_the_patches_that_touch_a_window_are_those_with_pixels_in_it():
    patches = PatchGrid(101, 34)
    owner = np.zeros((101, 101), int)
    for row in range(patches.count):
        for column in range(patches.count):
            owner[patches.window(row, column)] = row * patches.count + column
    for window in [(slice(0, 1), slice(0, 1)), (slice(30, 40), slice(60, 101)), (slice(None), slice(34, 35))]:
        expected = [divmod(int(k), patches.count) for k in np.unique(owner[window])]
        assert patches.touching(window) == expected
    assert patches.touching((slice(5, 5), slice(0, 9))) == []


def test_a_tile_is_one_array_whose_shards_are_patches(tmp_path):
    read = stored(tmp_path)
    group = zarr.open_group(read.store.images("coadds/x"), mode="r")
    for name, expected in TRUTH.items():
        np.testing.assert_array_equal(group[name][...], expected)
    assert group["image"].shards == (1, 1, 34, 34)
    assert group["image"].chunks == (1, 1, 17, 17)
    assert group["noise"].shards == (1, 1, 2, 34, 34)
    assert group["plain"].chunks == (1, 1, 17, 34)
    assert group["psf"].metadata.dimension_names == ("tile", "band", "patch_y", "patch_x", "v", "u")
    np.testing.assert_array_equal(group["psf"][..., 0, 0].ravel(), np.arange(len(read.units)))


def test_no_two_units_write_the_same_file(tmp_path):
    lazy, store, contents = product(), Store(tmp_path), {}
    lazy.prepare(store)
    for index in range(len(lazy.units)):
        lazy.write(index, store)
        files = {path: path.read_bytes() for path in store.images("coadds/x").rglob("c/**/*") if path.is_file()}
        # the files of the units before are as they were
        assert all(files[path] == content for path, content in contents.items())
        assert len(files) > len(contents)
        contents = files


def test_a_window_of_a_patch_is_read_or_made_alike(tmp_path):
    read, lazy = stored(tmp_path), product()
    for index in (0, 5, 8, 31):
        for window in [(), (slice(3, 9), slice(0, 400)), (slice(None), slice(2, 3))]:
            one, other = (each.load(index, ("image", "noise", "plain"), window) for each in (read, lazy))
            for name in one:
                np.testing.assert_array_equal(one[name], other[name])
        np.testing.assert_array_equal(read.load(index)["psf"], lazy.load(index)["psf"])
    first_plane = read.reader(4)("noise", (slice(0, 1), slice(None), slice(0, 2)))
    np.testing.assert_array_equal(first_plane, lazy.load(4)["noise"][:1, :, :2])


@pytest.mark.parametrize("chosen", [None, [], [0, 4, 9, 10, 17]])
def test_a_window_across_patches_is_read_where_stored_and_made_elsewhere(tmp_path, chosen):
    read = stored(tmp_path, chosen)
    for window in [(), (slice(20, 90), slice(33, 35)), (slice(0, 34), slice(34, 68)), (slice(5, 5), slice(0, 9))]:
        for name in ("image", "plain", "noise"):
            np.testing.assert_array_equal(read.image(0, 1)(name, window), TRUTH[name][0, 1][(..., *window)])
    plane = read.image(1, 2)("noise", (slice(1, 2), slice(30, 70), slice(None)))
    np.testing.assert_array_equal(plane, TRUTH["noise"][1, 2][1:2, 30:70])


def test_a_patch_that_is_not_stored_is_made_once_for_all_windows():
    lazy, calls = product(), []
    counted = replace(lazy, make=lambda index: calls.append(index) or lazy.make(index))
    image = counted.image(1, 0)
    for low in (0, 20, 40):
        image("image", (slice(low, low + 30), slice(0, 50)))
        image("noise", (slice(low, low + 30), slice(0, 50)))
    assert sorted(calls) == sorted(set(calls))
    assert len(calls) == 6


def test_what_belongs_to_patches_has_no_window_of_the_whole_image():
    with pytest.raises(ValueError, match="belongs to patches"):
        product().image(0, 0)("psf")


def test_the_lazy_dataset_has_whole_images_in_chunks_of_patches(tmp_path):
    for each in (product(), stored(tmp_path)):
        dataset = each.dataset
        assert dataset["image"].dims == ("tile", "band", "y", "x")
        assert dataset["noise"].dims == ("tile", "band", "realisation", "y", "x")
        assert dataset["psf"].dims == ("tile", "band", "patch_y", "patch_x", "v", "u")
        assert dataset["image"].chunks == ((1, 1), (1, 1, 1), (34, 34, 33), (34, 34, 33))
        for name, expected in TRUTH.items():
            np.testing.assert_array_equal(dataset[name].values, expected)
        assert dataset["psf"].values[..., 2, 3].ravel().tolist() == list(range(len(each.units)))
    reopened = xr.open_zarr(each.store.images("coadds/x"), consolidated=False)
    np.testing.assert_array_equal(reopened["image"].values, TRUTH["image"])


def test_stored_bytes_are_those_of_the_arrays():
    lazy = product()
    arrays = sum(array.nbytes for array in TRUTH.values())
    assert lazy.stored_bytes == arrays + len(lazy.units) * 100


def test_other_patches_replace_the_arrays(tmp_path):
    stored(tmp_path)
    read = stored(tmp_path, patch_pixels=50)
    group = zarr.open_group(read.store.images("coadds/x"), mode="r")
    assert group["image"].shards == (1, 1, 52, 52)
    np.testing.assert_array_equal(group["image"][...], TRUTH["image"])


def test_damage_to_a_patch_is_that_of_its_unit_alone(tmp_path):
    read = stored(tmp_path)
    hashes = [read.verify(index, read.store) for index in range(len(read.units))]
    path = read.store.images("coadds/x") / "image" / "c" / "1" / "2" / "0" / "2"
    content = bytearray(path.read_bytes())
    content[len(content) // 3] ^= 4
    path.write_bytes(bytes(content))
    broken = int(np.ravel_multi_index((1, 2, 0, 2), read.layout.unit_lengths))
    for index in range(len(read.units)):
        if index == broken:
            with pytest.raises(Exception, match="damaged"):
                read.verify(index, read.store)
        else:
            assert read.verify(index, read.store) == hashes[index]
