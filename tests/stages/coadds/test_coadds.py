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

from romandask.instruments.exposure import Exposure, pixel_areas
from romandask.instruments.roman.roman import Roman, RomanSettings
from romandask.kernels.coadding.drizzle import Sums
from romandask.kernels.coadding.pixel_map import pixel_map, strips
from romandask.kernels.coadding.stack import stack
from romandask.kernels.detectors.simple_detector import SATURATED
from romandask.model.errors import UserError
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
    parts = strips(source, (300, 300), target, shape)
    dq = np.zeros((300, 300), np.uint8)
    rows, columns = np.random.default_rng(3).integers(0, 300, (2, 200))
    dq[rows, columns] = SATURATED
    dq[150, 150] = 2
    marked = np.zeros(shape, np.uint8)
    for part in parts:
        onto = pixel_map(source, target, part.rows, part.columns)
        marked.ravel()[saturated_pixels(dq, onto, shape)] = SATURATED
    sums = Sums(shape, 1, 0.7)
    light = ((dq & SATURATED) > 0).astype(np.float32)
    sums.add(
        ([light[p.rows, p.columns]], light[p.rows, p.columns], pixel_map(source, target, p.rows, p.columns))
        for p in parts
    )
    touched = sums.weight > 0
    assert touched.sum() > 100
    assert (marked[touched] == SATURATED).all()
    near = ndimage.binary_dilation(touched, np.ones((3, 3)))
    assert not marked[~near].any()


def test_flux_is_conserved_through_distortion_and_roll(small):
    """Stars of known electrons, drawn on the exposure's grid, keep their flux on the tile to a part in a thousand."""
    header = small.roman.header(small.exposures[1])
    source, (target, shape) = WCS(header), target_of(small)
    image = np.zeros(small.roman.shape, np.float32)
    image[150, 140], image[90, 200] = 1000.0, 500.0
    areas = pixel_areas(header, small.roman.shape)
    sums = Sums(shape, 1, 1.0)
    sums.add(
        (
            [(image / areas)[p.rows, p.columns]],
            np.ones_like(image)[p.rows, p.columns],
            pixel_map(source, target, p.rows, p.columns),
        )
        for p in strips(source, small.roman.shape, target, shape)
    )
    assert sums.means()[0].sum() * 0.0575**2 == pytest.approx(1500.0, rel=1e-3)


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
        sums.add(
            ([image[p.rows, p.columns]] * 2, weight[p.rows, p.columns], pixel_map(source, target, p.rows, p.columns))
            for p in strips(source, small.roman.shape, target, shape)
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
        sums.add(
            ([image[rows]], np.ones_like(image)[rows], pixel_map(source, target, rows, slice(0, 300))) for rows in parts
        )
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
    k = int(np.argmax([len(product.make.members[k, "H158"]) for k in range(len(small.tiles))]))
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
    assert strips(source, small.roman.shape, WCS(tangent_header(10.0, 20.0, 100, 0.0575)), (100, 100)) == []


@pytest.mark.parametrize("pixels", [1000, 1907, 2345, 3400])
def test_strips_cover_the_part_without_slivers(pixels):
    """Strips of exactly 512 rows would leave a strip of one row of 1025 rows."""
    exposure = Exposure(visit=0, detector=9, band="H158", mjd=61541.0, exptime=139.8, ra=53.0, dec=-40.0, pa=120.0)
    source = WCS(Roman(RomanSettings()).header(exposure))
    ra, dec = source.all_pix2world(2044, 3000, 0)
    target = WCS(tangent_header(float(ra), float(dec), pixels, 0.0575))
    found = strips(source, (4088, 4088), target, (pixels, pixels))
    rows = [part.rows for part in found]
    assert all(first.stop == second.start for first, second in itertools.pairwise(rows))
    assert min(part.stop - part.start for part in rows) >= 256
    assert max(part.stop - part.start for part in rows) <= 768


def test_a_small_target_between_the_grid_points_is_found(small):
    source = WCS(small.roman.header(small.exposures[0]))
    ra, dec = source.all_pix2world(95.0, 97.0, 0)
    parts = strips(source, small.roman.shape, WCS(tangent_header(float(ra), float(dec), 20, 0.0575)), (20, 20))
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
    lengths = [len(product.make.members[k, "H158"]) for k in range(len(small.tiles))]
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
    assert sorted(CALLS) == sorted(product.make.members[chosen, "H158"])
    np.testing.assert_array_equal(lazy.values, kept["image"].isel(**corner).values)
    assert np.abs(lazy.values).max() > 0
    table = product.stored(store).load(chosen, ("sets",))["sets"]
    count = table.groupby("set").size()
    numbers = kept["set"].values
    np.testing.assert_array_equal(
        kept["nimages"].values, np.r_[0, count.reindex(np.arange(1, 1 + numbers.max()))][numbers]
    )
    names = [small.product.names[i] for i in product.make.members[chosen, "H158"]]
    assert set(table["exposure"]) <= set(names)
    np.testing.assert_allclose(kept["input_psf"].values[: lengths[chosen]].sum(axis=(1, 2)), 1, atol=0.04)
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
