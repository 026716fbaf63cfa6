"""Drizzling of exposures onto tiles, and the lazy computation of exposures and coadds."""

import itertools
from dataclasses import dataclass, replace
from types import SimpleNamespace

import dask
import numpy as np
import pytest
import xarray as xr
from astropy.wcs import WCS
from drizzle.resample import Drizzle
from scipy import ndimage

from romandask.instruments.exposure import Exposure
from romandask.instruments.roman.roman import Roman, RomanSettings
from romandask.kernels.coadding.drizzle import Sums
from romandask.kernels.coadding.pixel_map import STRIP_ROWS, pixel_map, strips
from romandask.kernels.coadding.stack import stack
from romandask.kernels.detectors.simple_detector import SATURATED
from romandask.model.errors import UserError
from romandask.model.sky import covering_sums
from romandask.model.tiles import tangent_header
from romandask.stages.coadds.coadds import coadds
from romandask.stages.coadds.drizzled import saturated_pixels
from romandask.stages.coadds.pixfrac import CHOICES, TEST_SQUARE_PIXELS, advice, coverage
from romandask.stages.exposures.exposures import wcs_of
from romandask.stages.exposures.render import RenderExposure
from romandask.storage.store import Store

CALLS: list[int] = []


@dataclass(frozen=True)
class Counting(RenderExposure):
    """Renders exposures, and records their indices in CALLS."""

    def __call__(self, index):
        CALLS.append(index)
        return super().__call__(index)


def exposures_for_drawn_coadds(small):
    """Return the small exposures with an instrument whose coadds are not drizzled."""
    renderer = replace(small.product.renderer, instrument=SimpleNamespace(coadd="draw"))
    return replace(small.product, renderer=renderer)


def target_of(small, pixels=500):
    ra, dec = small.region.centre
    return WCS(tangent_header(ra, dec, pixels, 0.0575)), (pixels, pixels)


def window_of(shape):
    return slice(0, shape[0]), slice(0, shape[1])


def whole_map(source, target):
    """Return the map of a whole small exposure."""
    return pixel_map(source, target, slice(0, 300), slice(0, 300))


def areas_of(positions):
    """Return the areas on the target of pixels at given positions, shape (ny, nx, 2), from differences."""
    along_y, along_x = np.gradient(positions, axis=(0, 1))
    return np.abs(along_x[..., 0] * along_y[..., 1] - along_x[..., 1] * along_y[..., 0]).astype(np.float32)


def test_the_interpolated_map_is_exact_to_a_thousandth_of_a_pixel():
    exposure = Exposure(visit=0, detector=9, band="H158", mjd=61541.0, exptime=139.8, ra=53.0, dec=-40.0, pa=120.0)
    header = Roman(RomanSettings()).header(exposure)
    source = WCS(header)
    ra, dec = source.all_pix2world(2044, 2044, 0)
    target = WCS(tangent_header(float(ra), float(dec), 8825, 0.0575))
    rows, columns = slice(1000, 1512), slice(0, 4088)
    found = pixel_map(source, target, rows, columns).dense()
    y, x = np.mgrid[1000:1512:37, 0:4088:53]
    exact = target.all_world2pix(*source.all_pix2world(x.ravel(), y.ravel(), 0), 0)
    for plane in range(2):
        assert np.abs(found[y - 1000, x, plane].ravel() - exact[plane]).max() < 1e-3


@pytest.mark.parametrize("rows", [slice(10, 11), slice(299, 300), slice(5, 8)])
def test_the_map_of_a_few_rows_equals_the_map_of_all(small, rows):
    """The last strip of an exposure may be a single row."""
    source, (target, _) = WCS(small.roman.header(small.exposures[0])), target_of(small)
    whole = pixel_map(source, target, slice(0, 300), slice(0, 300)).dense()
    np.testing.assert_allclose(pixel_map(source, target, rows, slice(0, 300)).dense(), whole[rows], atol=1e-6)
    np.testing.assert_allclose(pixel_map(source, target, slice(0, 300), rows).dense(), whole[:, rows], atol=1e-6)


def test_the_map_at_some_pixels_equals_the_dense_map(small):
    source, (target, _) = WCS(small.roman.header(small.exposures[0])), target_of(small)
    onto = pixel_map(source, target, slice(100, 300), slice(20, 280))
    rows, columns = np.random.default_rng(2).integers((100, 20), (300, 280), (500, 2)).T
    np.testing.assert_allclose(onto.at(rows, columns), onto.dense()[rows - 100, columns - 20], atol=1e-9)


def test_tiles_are_flagged_where_exposures_are_saturated(small):
    """All tile pixels that a saturated pixel overlaps are flagged, and no pixels further than one pixel from them."""
    source, (target, shape) = WCS(small.roman.header(small.exposures[0])), target_of(small)
    whole = whole_map(source, target)
    parts = strips(whole, window_of(shape))
    dq = np.zeros((300, 300), np.uint8)
    rows, columns = np.random.default_rng(3).integers(0, 300, (2, 200))
    dq[rows, columns] = SATURATED
    dq[150, 150] = 2
    marked = np.zeros(shape, np.uint8)
    for part in parts:
        onto = whole.part(part.rows, part.columns)
        marked.ravel()[saturated_pixels(dq, (slice(0, 300), slice(0, 300)), onto, window_of(shape))] = SATURATED
    sums = Sums(shape, 1, 0.7)
    light = ((dq & SATURATED) > 0).astype(np.float32)
    sums.add(([light[p.rows, p.columns]], light[p.rows, p.columns], whole.part(p.rows, p.columns)) for p in parts)
    touched = sums.weight > 0
    assert touched.sum() > 100
    assert (marked[touched] == SATURATED).all()
    near = ndimage.binary_dilation(touched, np.ones((3, 3)))
    assert not marked[~near].any()


def test_flux_is_conserved_through_distortion_and_roll(small):
    """Stars of known electrons, drawn on the exposure's grid, keep their flux on the tile to a part in a thousand."""
    source, (target, shape) = WCS(small.roman.header(small.exposures[1])), target_of(small)
    image = np.zeros(small.roman.shape, np.float32)
    image[150, 140], image[90, 200] = 1000.0, 500.0
    onto = whole_map(source, target)
    sums = Sums(shape, 1, 1.0)
    sums.add(
        ([image[p.rows, p.columns]], np.ones_like(image)[p.rows, p.columns], onto.part(p.rows, p.columns))
        for p in strips(onto, window_of(shape))
    )
    assert sums.means()[0].sum() == pytest.approx(1500.0, rel=1e-3)


def test_sums_equal_the_drizzle_package_over_whole_images(small):
    target, shape = target_of(small, 300)
    random = np.random.default_rng(0)
    sums, oracle = Sums(shape, 2, 0.7), Drizzle(kernel="square", fillval="0", out_shape=shape, disable_ctx=True)
    covered = []
    for exposure in small.exposures:
        source = WCS(small.roman.header(exposure))
        image = random.normal(size=small.roman.shape).astype(np.float32)
        weight = random.uniform(0.5, 1, small.roman.shape).astype(np.float32)
        weight[random.random(weight.shape) < 0.05] = 0
        whole = pixel_map(source, target, slice(0, 300), slice(0, 300)).dense()
        oracle.add_image(image, exptime=1.0, pixmap=whole, weight_map=weight, pixfrac=0.7, in_units="cps")
        alone = Drizzle(kernel="square", fillval="0", out_shape=shape, disable_ctx=True)
        alone.add_image(image, exptime=1.0, pixmap=whole, weight_map=weight, pixfrac=0.7, in_units="cps")
        covered.append(alone.out_wht > 0)
        onto = whole_map(source, target)
        light = image * areas_of(whole)
        sums.add(
            ([light[p.rows, p.columns]] * 2, weight[p.rows, p.columns], onto.part(p.rows, p.columns))
            for p in strips(onto, window_of(shape))
        )
    # the package decides which input pixels reach the outermost output pixels from the outline of the map it is given
    inner = (slice(4, -4), slice(4, -4))
    np.testing.assert_allclose(sums.weight[inner], oracle.out_wht[inner], atol=1e-5)
    sets, numbers, count = sums.sets, sums.set, sums.count
    image, other = sums.means()
    good = oracle.out_wht[inner] > 0.05
    np.testing.assert_allclose(image[inner][good], oracle.out_img[inner][good], atol=1e-5)
    np.testing.assert_array_equal(image, other)
    # overlaps that are rounding's may be nothing to one and something to the other
    assert (count != np.sum(covered, axis=0))[inner].mean() < 1e-4
    members = np.array([[k in chosen for k in range(len(covered))] for chosen in sets])
    for k, mask in enumerate(covered):
        assert (members[numbers, k] != mask)[inner].mean() < 1e-4


def test_the_order_and_cut_of_strips_do_not_matter(small):
    target, shape = target_of(small, 300)
    source = WCS(small.roman.header(small.exposures[0]))
    image = np.random.default_rng(0).normal(size=small.roman.shape).astype(np.float32)
    made = []
    for cuts in ([0, 300], [0, 70, 71, 300]):
        sums = Sums(shape, 1, 0.7)
        parts = [slice(low, high) for low, high in itertools.pairwise(cuts)]
        onto = whole_map(source, target)
        sums.add(([image[rows]], np.ones_like(image)[rows], onto.part(rows, slice(0, 300))) for rows in parts)
        made.append((sums.weight.copy(), *sums.means()))
    for first, second in zip(*made, strict=True):
        np.testing.assert_allclose(first, second, atol=2e-5)


def test_pixfrac_is_recommended_from_the_weights_of_the_drizzle_package(small):
    """A pixfrac is good if the drizzled weight is even and nowhere zero."""
    product = coadds(small.product, small.tiles, small.settings)
    results = coverage(product)
    assert [result.pixfrac for result in results] == CHOICES.tolist()
    assert all(first.uneven > second.uneven for first, second in itertools.pairwise(results))
    assert all(first.empty >= second.empty for first, second in itertools.pairwise(results))
    result = results[4]
    centres = np.array([(tile.ra, tile.dec) for tile in small.tiles])
    k = int(np.argmax(covering_sums(small.product.footprints, *centres.T)))
    target = WCS(tangent_header(small.tiles[k].ra, small.tiles[k].dec, TEST_SQUARE_PIXELS, 0.0575))
    oracle = Drizzle(kernel="square", fillval="0", out_shape=(TEST_SQUARE_PIXELS, TEST_SQUARE_PIXELS), disable_ctx=True)
    for exposure in small.exposures:
        whole = pixel_map(WCS(small.roman.header(exposure)), target, slice(0, 300), slice(0, 300)).dense()
        plane = np.ones(small.roman.shape, np.float32)
        oracle.add_image(plane, exptime=1.0, pixmap=whole, weight_map=plane, pixfrac=result.pixfrac, in_units="cps")
    weight = oracle.out_wht[2:-2, 2:-2]
    assert result.uneven == pytest.approx(weight.std() / np.median(weight), rel=0.05)
    assert result.empty == pytest.approx((weight <= 0).mean(), abs=2e-3)
    assert advice(results) is None or advice(results) in CHOICES
    good = [replace(result, empty=0.0, uneven=0.3 if result.pixfrac < 0.6 else 0.1) for result in results]
    assert advice(good) == 0.6
    with pytest.raises(UserError, match="no Roman"):
        coverage(replace(product, maker=replace(product.maker, exposures=exposures_for_drawn_coadds(small))))


def test_an_image_elsewhere_has_no_strips(small):
    source = WCS(small.roman.header(small.exposures[0]))
    onto = whole_map(source, WCS(tangent_header(10.0, 20.0, 100, 0.0575)))
    assert strips(onto, window_of((100, 100))) == []


@pytest.mark.parametrize("pixels", [1000, 1907, 2345, 3400])
def test_strips_cover_a_window_and_begin_at_fixed_rows(pixels):
    exposure = Exposure(visit=0, detector=9, band="H158", mjd=61541.0, exptime=139.8, ra=53.0, dec=-40.0, pa=120.0)
    source = WCS(Roman(RomanSettings()).header(exposure))
    ra, dec = source.all_pix2world(2044, 3000, 0)
    target = WCS(tangent_header(float(ra), float(dec), pixels, 0.0575))
    onto = pixel_map(source, target, slice(0, 4088), slice(0, 4088))
    found = strips(onto, window_of((pixels, pixels)))
    rows = [part.rows for part in found]
    assert all(first.stop == second.start for first, second in itertools.pairwise(rows))
    assert all(first.stop % STRIP_ROWS == 0 for first in rows[:-1])
    assert max(part.stop - part.start for part in rows) <= STRIP_ROWS
    y, x = np.mgrid[0:4088:3, 0:4088:3].reshape(2, -1)
    u, v = onto.at(y, x).T
    inside = (u > -1) & (u < pixels) & (v > -1) & (v < pixels)
    held = np.zeros(len(y), bool)
    for part in found:
        held |= (y >= part.rows.start) & (y < part.rows.stop) & (x >= part.columns.start) & (x < part.columns.stop)
    assert held[inside].all()
    assert held.sum() < 2.5 * inside.sum() + 60_000


def test_a_part_of_a_map_is_the_same_map_to_the_last_bit(small):
    source, (target, _) = WCS(small.roman.header(small.exposures[0])), target_of(small)
    whole = whole_map(source, target)
    part = whole.part(slice(17, 140), slice(55, 201))
    rows = np.arange(17, 140) + 0.35
    pieces = part.pieces
    assert whole.x[pieces.start] <= 55
    assert whole.x[pieces.stop] > 200
    np.testing.assert_array_equal(part.curves(rows), whole.curves(np.arange(300) + 0.35)[17:140, :, pieces])


def test_a_window_of_the_sums_has_the_sums_of_the_tile(small):
    target, shape = target_of(small, 300)
    random = np.random.default_rng(4)
    corner, window = (90, 121), (slice(90, 200), slice(121, 260))
    sums, part = Sums(shape, 2, 0.7), Sums((110, 139), 2, 0.7, corner)
    for exposure in small.exposures:
        onto = whole_map(WCS(small.roman.header(exposure)), target)
        planes = [random.normal(size=small.roman.shape).astype(np.float32) for _ in range(2)]
        weight = (random.random(small.roman.shape) > 0.05).astype(np.float32)
        for each, wanted in ((sums, window_of(shape)), (part, window)):
            each.add(
                (
                    [plane[p.rows, p.columns] for plane in planes],
                    weight[p.rows, p.columns],
                    onto.part(p.rows, p.columns),
                )
                for p in strips(onto, wanted)
            )
    assert part.weight.any()
    np.testing.assert_array_equal(part.weight, sums.weight[window])
    np.testing.assert_array_equal(part.count, sums.count[window])
    for one, other in zip(part.means(), sums.means(), strict=True):
        np.testing.assert_array_equal(one, other[window])


def test_a_small_target_between_the_grid_points_is_found(small):
    source = WCS(small.roman.header(small.exposures[0]))
    ra, dec = source.all_pix2world(95.0, 97.0, 0)
    onto = whole_map(source, WCS(tangent_header(float(ra), float(dec), 20, 0.0575)))
    parts = strips(onto, window_of((20, 20)))
    assert parts
    assert parts[0].rows.start <= 97 < parts[-1].rows.stop
    assert parts[0].columns.start <= 95 < parts[0].columns.stop


def test_stack_counts_and_variances():
    square = np.array([[10.0, 10.0], [30.0, 10.0], [30.0, 30.0], [10.0, 30.0]])
    layers = stack(np.stack([square, square + 10]), np.array([4.0, 1.0]), np.array([2.0, 8.0]), (50, 50))
    assert layers.count[15, 15] == 1
    assert layers.count[25, 25] == 2
    assert layers.count[5, 5] == 0
    assert layers.weight[25, 25] == pytest.approx(1 / 4 + 1)
    # sum w^2 / gain over (sum w)^2
    assert layers.source[25, 25] == pytest.approx((1 / 16 / 2 + 1 / 8) / 1.25**2, rel=1e-5)
    assert layers.count.sum() == pytest.approx(2 * 21 * 21)


def test_hundreds_of_exposures_are_counted():
    """A deep field has more exposures than fit in a byte."""
    square = np.array([[10.0, 10.0], [30.0, 10.0], [30.0, 30.0], [10.0, 30.0]])
    layers = stack(np.stack([square] * 300), np.ones(300), np.ones(300), (40, 40))
    assert layers.count[20, 20] == 300
    assert layers.weight[20, 20] == pytest.approx(300)


@pytest.fixture(scope="module")
def counted(small):
    renderer = Counting(**vars(small.product.renderer))
    return replace(small.product, product=replace(small.product.product, make=renderer), renderer=renderer)


@pytest.mark.slow
def test_a_lazy_corner_equals_the_stored_one_and_renders_only_what_it_needs(small, counted, tmp_path):
    product = coadds(counted, small.tiles, small.settings)
    store = Store(tmp_path)
    product.prepare(store)
    lengths = [len(product.tile_members(k, "H158")) for k in range(len(small.tiles))]
    chosen = next(k for k, length in enumerate(lengths) if 0 < length < 3)
    product.write(chosen, store)
    kept = xr.open_zarr(store.images(product.stage), consolidated=False).isel(tile=chosen, band=0)
    row, column = (int(axis[len(axis) // 2]) for axis in np.nonzero(kept["weight"].values))
    corner = {"y": slice(max(0, row - 40), row + 40), "x": slice(max(0, column - 40), column + 40)}
    with dask.config.set(scheduler="synchronous"):
        CALLS.clear()
        asked = product.dataset["image"].isel(tile=chosen, band=0, **corner)
        assert CALLS == [], "nothing is rendered before it is asked for"
        lazy = asked.compute()
    assert sorted(CALLS) == sorted(product.make.members[chosen])
    np.testing.assert_array_equal(lazy.values, kept["image"].isel(**corner).values)
    assert np.abs(lazy.values).max() > 0
    table = product.stored(store).load(chosen, ("sets",))["sets"]
    count = table.groupby("set").size()
    numbers = kept["set"].values
    np.testing.assert_array_equal(
        kept["nimages"].values, np.r_[0, count.reindex(np.arange(1, 1 + numbers.max()))][numbers]
    )
    names = [small.product.names[i] for i in product.make.members[chosen]]
    assert set(table["exposure"]) <= set(names)
    used = np.unique(table["input"])
    np.testing.assert_allclose(kept["input_psf"].values[0, 0, used].sum(axis=(1, 2)), 1, atol=0.04)
    assert kept["psf"].values.sum() == pytest.approx(1, abs=0.04)


def test_image_and_truth_of_an_exposure_share_one_rendering(counted):
    with dask.config.set(scheduler="synchronous"):
        CALLS.clear()
        dask.compute(*(counted.dataset[name].isel(exposure=1) for name in ("image", "truth", "dq")))
    assert CALLS == [1]


def test_the_header_of_an_exposure_is_exact(small):
    text = str(small.product.dataset["header"].values[2])
    expected = WCS(small.roman.header(small.exposures[2]))
    x, y = np.meshgrid([0.0, 150.0, 299.0], [0.0, 150.0, 299.0])
    np.testing.assert_array_equal(wcs_of(text).all_pix2world(x, y, 0), expected.all_pix2world(x, y, 0))


def test_the_observed_image_is_truth_and_sky_with_their_noise(small):
    made = small.product.load(0)
    sky = small.roman.background(small.exposures[0], small.roman.header(small.exposures[0]))
    expected = made["truth"] + sky
    pull = (made["image"] - expected) / np.sqrt(np.maximum(expected, 1) + small.roman.detector.read_noise**2)
    assert pull.mean() == pytest.approx(0, abs=0.02)
    assert pull.std() == pytest.approx(1, abs=0.02)
