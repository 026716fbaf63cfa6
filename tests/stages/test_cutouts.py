"""Cutouts of objects: pixels, positions, PSFs, Jacobians and laziness; MEDS files compared with those of GalSim."""

import dask
import galsim
import galsim.des
import galsim.roman
import numpy as np
import pandas as pd
import pytest
from astropy.io import fits
from astropy.wcs import WCS

from romandask.export.meds import Catalog, write_meds
from romandask.instruments.psf_image import flat_shares
from romandask.kernels.detectors.simple_detector import NO_DATA
from romandask.model.errors import UserError
from romandask.model.sky import Cone, Region, covering_pairs
from romandask.stages.coadds.coadds import coadds
from romandask.stages.cutouts import cutouts
from romandask.stages.wanted import Positions, located

SIZE = 32
LAYERS = ("image", "truth", "dq", "background", "weight", "psf")


@pytest.fixture(scope="module")
def objects(small) -> pd.DataFrame:
    """Thirty galaxies, some of which lie outside all detectors or near an edge."""
    rows = small.truth.galaxies.all_rows()
    return rows.iloc[:: len(rows) // 30][["galaxy_id", "ra", "dec"]].set_axis(["id", "ra", "dec"], axis=1)


@pytest.fixture(scope="module")
def found(small, objects):
    return cutouts(small.product, objects.reset_index(drop=True), LAYERS, size=SIZE).compute()


def test_every_image_that_contains_the_centre_of_an_object_has_a_cutout_of_it(small, objects, found):
    expected = set()
    for exposure in small.exposures:
        x, y = WCS(small.roman.header(exposure)).all_world2pix(objects["ra"], objects["dec"], 0)
        inside = (x >= -0.5) & (x < 299.5) & (y >= -0.5) & (y < 299.5)
        expected |= {(exposure.name, number) for number in objects["id"][inside]}
    assert 10 < len(expected) < 3 * len(objects)
    pairs = list(zip(found["unit"].to_numpy().tolist(), found["id"].to_numpy().tolist(), strict=True))
    assert len(pairs) == len(set(pairs))
    assert set(pairs) == expected


def test_pixels_are_those_of_the_image_and_nothing_beyond_its_edge(small, found):
    beyond = 0
    for k in range(3):
        whole = small.product.load(k)
        for n in np.flatnonzero(found["unit"].to_numpy() == small.exposures[k].name):
            one = found.isel(cutout=n)
            rows, columns = (int(one[name]) + np.arange(SIZE) for name in ("row", "column"))
            y, x = np.meshgrid(rows, columns, indexing="ij")
            inside = (x >= 0) & (x < 300) & (y >= 0) & (y < 300)
            beyond += (~inside).sum()
            for name in ("image", "truth", "dq"):
                np.testing.assert_array_equal(one[name].to_numpy()[inside], whole[name][y[inside], x[inside]])
            assert (one["image"].to_numpy()[~inside] == 0).all()
            assert (one["dq"].to_numpy()[~inside] == NO_DATA).all()
            assert (one["weight"].to_numpy()[~inside] == 0).all()
            # the object is in the middle
            assert abs(float(one["x_image"] - one["column"]) - (SIZE - 1) / 2) <= 0.5
            assert abs(float(one["y_image"] - one["row"]) - (SIZE - 1) / 2) <= 0.5
    assert beyond > 0


def test_weights_are_the_inverse_variance_of_an_empty_pixel(small, found):
    exposure = small.exposures[0]
    one = found.isel(cutout=int(np.flatnonzero((found["dq"] == 0).all(("y", "x")))[0]))
    background = small.roman.background(exposure, small.roman.header(exposure))
    level = float(background.mean())
    np.testing.assert_allclose(one["background"], level, rtol=2e-3)
    np.testing.assert_allclose(one["weight"], 1 / (one["background"] + galsim.roman.read_noise**2), rtol=1e-6)


def test_psf_and_jacobian_equal_those_of_galsim_at_the_object(small, found):
    shares = flat_shares(small.roman.bandpass("H158"))
    n = found.sizes["cutout"] // 2
    one = found.isel(cutout=n)
    exposure = next(e for e in small.exposures if e.name == str(one["unit"].to_numpy()))
    profiles = small.roman.profiles(exposure, float(one["x_image"]), float(one["y_image"]))
    psf = galsim.Sum([profile * share for profile, share in zip(profiles, shares, strict=True)])
    expected = psf.drawImage(nx=SIZE, ny=SIZE, scale=0.11, offset=(0.5, 0.5), dtype=float).array
    assert np.abs(one["psf"] - expected).max() < 2e-3 * expected.max()
    wcs = galsim.FitsWCS(header=galsim.FitsHeader(small.roman.header(exposure)))
    local = wcs.local(galsim.PositionD(float(one["x_image"]) + 1, float(one["y_image"]) + 1))
    np.testing.assert_allclose(one["jacobian"], local.getMatrix(), atol=2e-7)


def test_cutouts_are_lazy_and_read_each_image_once(small, objects, monkeypatch):
    made = []
    monkeypatch.setattr(
        type(small.product.product),
        "load",
        lambda self, index, names, window: made.append(index) or _blank(names, window),
    )
    rows = objects.reset_index(drop=True)
    lazy = cutouts(small.product, rows, ("image", "truth"), size=SIZE)
    assert not made
    with dask.config.set(scheduler="sync"):
        dask.compute(lazy["image"].data, lazy["truth"].data)
        assert sorted(made) == [0, 1, 2]
        made.clear()
        here = lazy["unit"].to_numpy() == small.exposures[1].name
        lazy["image"][np.flatnonzero(here)].compute()
    assert made == [1]


def _blank(names, window):
    return {name: np.zeros((300, 300), np.float32)[window] for name in names}


def test_bands_choose_images(small, objects):
    with pytest.raises(UserError, match="band 'F184': the images have H158"):
        cutouts(small.product, objects, bands=("F184",))


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"layers": ("image", "depth")}, "layer 'depth': exposures/roman has image, truth, dq, background"),
        ({"size": 33}, "size 33: an even number"),
        ({"size": 1000}, "size 1000: an even number"),
    ],
)
def test_invalid_arguments_are_reported(small, objects, arguments, message):
    with pytest.raises(UserError, match=message):
        cutouts(small.product, objects, **arguments)


def test_objects_on_no_image_have_no_cutouts(small):
    nowhere = pd.DataFrame({"id": [1], "ra": [10.0], "dec": [10.0]})
    lazy = cutouts(small.product, nowhere, ("image", "psf"), size=SIZE)
    assert lazy["image"].shape == (0, SIZE, SIZE)
    assert lazy.compute().sizes["cutout"] == 0


def test_cutouts_of_coadds_are_pixels_of_the_tiles(small, objects):
    product = coadds(small.product, small.tiles[:2], small.settings)
    lazy = cutouts(product, objects.reset_index(drop=True), ("image", "weight", "noise"), size=SIZE)
    assert lazy.sizes["cutout"] > 0
    for n in range(lazy.sizes["cutout"]):
        one = lazy.isel(cutout=n)
        tile = next(t for t in small.tiles if str(one["unit"].to_numpy()) == f"{t.name}-H158")
        x, y = WCS(tile.header(260, 0.0575)).all_world2pix(float(one["ra"]), float(one["dec"]), 0)
        np.testing.assert_allclose([one["x_image"], one["y_image"]], [x, y], atol=1e-6)
    one = lazy.isel(cutout=slice(0, 1)).compute()
    k = product.image_names.index(str(one["unit"][0].to_numpy()))
    row, column = int(one["row"][0]), int(one["column"][0])
    low, left = max(row, 0), max(column, 0)
    whole = product.load(k)["image"][low : row + SIZE, left : column + SIZE]
    np.testing.assert_array_equal(one["image"][0, low - row :, left - column :][: len(whole), : whole.shape[1]], whole)
    noise = product.load(k)["noise"][0, low : row + SIZE, left : column + SIZE]
    np.testing.assert_array_equal(one["noise"][0, low - row :, left - column :][: len(noise), : noise.shape[1]], noise)
    with pytest.raises(UserError, match="layer 'psf': coadds/roman has image, weight, noise, nimages"):
        cutouts(product, objects, ("psf",))


def test_objects_are_found_by_id_and_by_position(small):
    tables = (
        Positions(small.truth.galaxies, "galaxy_id", "ra", "dec"),
        Positions(small.truth.stars, "id", "ra", "dec"),
    )
    rows = small.truth.galaxies.all_rows()
    ids = rows["galaxy_id"].to_numpy()[[7, 3, 7]]
    found = located(ids, tables, "truth")
    assert found["id"].tolist() == ids[:2].tolist()
    np.testing.assert_array_equal(found["ra"], rows["ra"].to_numpy()[[7, 3]])
    cone = Cone(rows["ra"].iloc[5], rows["dec"].iloc[5], 8.0)
    stars = small.truth.stars.all_rows()
    expected = [*rows["galaxy_id"][cone.contains(rows["ra"], rows["dec"])]]
    expected += [*stars["id"][cone.contains(stars["ra"], stars["dec"])]]
    assert sorted(located(cone, tables, "truth")["id"]) == sorted(expected)
    with pytest.raises(UserError, match="1 of 2 ids are not in truth, the first is 5"):
        located([5, ids[0]], tables, "truth")
    with pytest.raises(UserError, match="columns dec are missing"):
        located(pd.DataFrame({"id": [1], "ra": [2.0]}), tables, "truth")
    with pytest.raises(UserError, match="whole numbers"):
        located([1.5], tables, "truth")
    assert located(Region(10, 11, 10, 11), tables, "truth").empty


def test_positions_in_footprints_are_found_with_a_margin():
    square = np.array([[[0.0, -0.1], [0.2, -0.1], [0.2, 0.1], [0.0, 0.1]]])
    ra = [0.1, 0.2 + 0.5 / 3600, 0.2 + 2.0 / 3600, 359.9, 0.0 - 0.5 / 3600]
    which, point = covering_pairs(np.concatenate([square, square + [[[5.0, 0.0]]]]), ra, np.zeros(5), 1.0)
    assert (which.tolist(), point.tolist()) == ([0, 0, 0], [0, 1, 4])


def test_a_meds_file_is_what_galsim_writes(found, objects, tmp_path):
    """Tables and pixels are compared, object by object, with those of galsim.des.WriteMEDS for the same cutouts."""
    rows = objects.reset_index(drop=True)
    seen = np.unique(found["object"])
    table = rows.iloc[seen].reset_index(drop=True)
    number = np.searchsorted(seen, found["object"])
    jacobian = found["jacobian"].to_numpy()
    columns = {name: found[name].to_numpy() for name in ("column", "row")}
    columns |= {name: found[f"{name}_image"].to_numpy() for name in ("x", "y")}
    columns |= {name: jacobian[:, k // 2, k % 2] for k, name in enumerate(("dudx", "dudy", "dvdx", "dvdy"))}
    units, image = np.unique(found["unit"], return_inverse=True)
    light = (found["image"] - found["background"]).to_numpy()
    planes = {"image": light} | {name: found[name].to_numpy() for name in ("weight", "dq", "psf")}
    # image by image, as a survey is read
    limits = np.searchsorted(image, [0, 1, 2, 3])
    parts = [slice(low, high) for low, high in zip(limits[:-1], limits[1:], strict=True)]
    catalog = Catalog(
        table,
        pd.DataFrame(columns | {"object": number, "image": image}),
        pd.DataFrame({"name": units, "magzp": 31.0}),
        SIZE,
    )
    ours = tmp_path / "ours.fits"
    write_meds(ours, catalog, ((part, {k: v[part] for k, v in planes.items()}) for part in parts))

    every = []
    for k in range(len(table)):
        own = np.flatnonzero(number == k)
        wcs = [galsim.AffineTransform(*jacobian[n].ravel()) for n in own]
        every.append(
            galsim.des.MultiExposureObject(
                images=[galsim.Image(light[n].astype(np.float32), wcs=w) for n, w in zip(own, wcs, strict=True)],
                weight=[galsim.Image(planes["weight"][n]) for n in own],
                psf=[galsim.Image(planes["psf"][n]) for n in own],
                wcs=wcs,
                id=int(table["id"][k]),
                cutout_row=(columns["y"] - columns["row"])[own].tolist(),
                cutout_col=(columns["x"] - columns["column"])[own].tolist(),
            )
        )
    galsim.des.WriteMEDS(every, str(tmp_path / "galsim.fits"))
    with fits.open(ours) as a, fits.open(tmp_path / "galsim.fits") as b:
        a.verify("exception")
        ours_data, theirs = a["object_data"].data, b["object_data"].data
        for name in ("id", "box_size", "psf_box_size", "ncutout"):
            np.testing.assert_array_equal(ours_data[name], theirs[name])
        np.testing.assert_array_equal(ours_data["ra"], table["ra"])
        for k, count in enumerate(ours_data["ncutout"]):
            for name in ("start_row", "psf_start_row", "cutout_row", "cutout_col"):
                np.testing.assert_allclose(ours_data[name][k, :count], theirs[name][k, :count], atol=1e-12)
            for name in ("dudrow", "dudcol", "dvdrow", "dvdcol"):
                np.testing.assert_allclose(ours_data[name][k, :count], theirs[name][k, :count], atol=1e-15)
        for name in ("image_cutouts", "weight_cutouts", "psf"):
            np.testing.assert_array_equal(a[name].data, b[name].data)
        assert a["bmask_cutouts"].data.shape == a["image_cutouts"].data.shape
        assert a["image_info"].data["image_path"].tolist() == units.tolist()
    assert not list(tmp_path.glob(".*partial"))
