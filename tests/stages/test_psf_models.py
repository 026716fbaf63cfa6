"""PSF models as a stage: what is read from a store is what the instrument computes, bit by bit."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest

from romandask.instruments.exposure import Exposure
from romandask.instruments.psf_image import centre_image
from romandask.instruments.roman.roman import Roman, RomanSettings
from romandask.kernels.rendering.draw import draw
from romandask.kernels.rendering.psf import Grid
from romandask.kernels.rendering.psf_layout import PsfLayout, padded, trimmed
from romandask.model.errors import UserError
from romandask.model.settings import RenderSettings
from romandask.pipeline import load_pipeline
from romandask.stages.coadds.coadds import coadds
from romandask.stages.exposures.exposures import exposures
from romandask.stages.psf_images import psfs
from romandask.stages.psf_models import ExposurePsfs, SharedPsfs, build_psf_models, psfs_for
from romandask.stages.truth_index import truth_index
from romandask.storage.manifest import Record, write_record
from romandask.storage.paths import bytes_below
from romandask.storage.store import Store
from romandask.survey import Survey

BANDS = ("Y106", "F184")


@pytest.fixture(scope="module")
def roman() -> Roman:
    settings = RomanSettings(bands=BANDS, psf_degree=1, bright_stars={15.0: 4})
    return Roman(settings, n_waves=2)


@pytest.fixture(scope="module")
def pair(roman, small) -> tuple[SharedPsfs, list[Exposure]]:
    """The PSFs of two bands without a store, and exposures in these bands."""
    chosen = [replace(small.exposures[0], band=band) for band in (*BANDS, BANDS[1])]
    table = small.table.assign(band=[one.band for one in chosen])
    return psfs_for(roman, table), chosen


@pytest.fixture(scope="module")
def stored(pair, tmp_path_factory) -> SharedPsfs:
    """The same PSFs, read from a store."""
    store = Store(tmp_path_factory.mktemp("psfs"))
    product = pair[0].product
    product.prepare(store)
    for index, name in enumerate(product.names):
        made = product.write(index, store)
        write_record(store, Record(product.stage, name, "", made.output, made.bytes, made.rows, 1.0, 0))
        assert product.verify(index, store) == made.output
    return pair[0].stored(store)


def test_there_is_a_unit_for_each_detector_and_band(pair):
    lazy, chosen = pair
    assert lazy.product.names == ("F184-7", "Y106-7")
    assert lazy.inputs(chosen[0]) == (("psf_models/roman", "Y106-7"),)
    assert all(lazy.product.dataset[name].sizes["model"] == 2 for name in ("nodes", "modes", "centre"))


@pytest.mark.parametrize("band", range(2))
def test_stored_models_are_those_of_the_instrument(roman, pair, stored, band):
    exposure = pair[1][band]
    expected, found = roman.psf(exposure), stored.model(exposure)
    assert stored.product.has(stored.product.names.index(f"{exposure.band}-7"))
    for name in ("nodes", "modes", "mixing", "peaks"):
        np.testing.assert_array_equal(getattr(found, name), getattr(expected, name), strict=True)
    for name in ("grid", "core", "degree", "shape", "edges"):
        assert getattr(found, name) == getattr(expected, name)
    assert stored.edges(exposure) == roman.psf_edges(exposure) == expected.edges
    np.testing.assert_array_equal(stored.centre(exposure), centre_image(roman, exposure), strict=True)


def test_stored_psfs_of_bright_stars_are_those_of_the_instrument(roman, pair, stored):
    exposure = pair[1][1]
    (expected,), (found,) = roman.bright_psfs(exposure), stored.bright(exposure)
    assert (found.grid, found.min_electrons) == (expected.grid, expected.min_electrons)
    np.testing.assert_array_equal(found.shares, expected.shares)
    assert len(found.nodes) == len(expected.nodes) == 2
    for one, other in zip(found.nodes, expected.nodes, strict=True):
        np.testing.assert_array_equal(one, other, strict=True)
    with pytest.raises(IndexError):
        found.nodes[2]


def test_psfs_of_bright_stars_that_one_exposure_may_need_are_not_stored(roman, pair, stored):
    assert stored.stored_bright == (1, 0)
    assert not stored.product.load(1, ("bright_0_0",))["bright_0_0"].any()
    (expected,), (found,) = roman.bright_psfs(pair[1][0]), stored.bright(pair[1][0])
    np.testing.assert_array_equal(found.nodes[1], expected.nodes[1], strict=True)


def test_psfs_of_brighter_stars_are_stored_for_more_exposures(small):
    roman = Roman(RomanSettings(bands=("H158",)), n_waves=3)
    bright = {n: psfs_for(roman, pd.concat([small.table[:1]] * n)).stored_bright for n in (1, 2, 7, 8)}
    assert bright == {1: (0,), 2: (1,), 7: (1,), 8: (2,)}
    names = [variable.name for variable in psfs_for(roman, small.table).product.variables]
    assert "bright_0_2" in names
    assert not any(name.startswith("bright_1") for name in names)


def test_without_a_store_they_are_made_by_the_same_path(pair, stored):
    lazy, chosen = pair
    assert not lazy.product.has(0)
    for name in ("nodes", "modes", "mixing", "peaks"):
        np.testing.assert_array_equal(getattr(lazy.model(chosen[1]), name), getattr(stored.model(chosen[1]), name))


def test_what_a_smaller_band_leaves_empty_takes_no_room(stored):
    raw = stored.product.stored_bytes
    assert bytes_below(stored.product.store.root) < 0.75 * raw


def test_units_name_the_models_that_they_are_made_from(small):
    exposure_units = small.product.units
    model = ("psf_models/roman", "H158-7")
    assert all(model in unit.inputs for unit in exposure_units)
    assert model in truth_index(small.product).units[0].inputs
    tile = coadds(small.product, small.tiles, small.settings)
    drawn = next(unit for unit in tile.units if unit.inputs)
    assert drawn.inputs.count(model) == 1
    assert psfs(small.product).names == small.product.names


def test_exposures_draw_with_the_psfs_that_they_are_given(small):
    """The image is that of the PSF that is read: another PSF in its place shows."""

    constant = Roman(RomanSettings(bands=("H158",), psf_degree=0), n_waves=3)
    given = ExposurePsfs(constant)
    others = exposures(small.table, small.truth, small.roman, RenderSettings(n_waves=3), 5, psfs=given)
    view = others.renderer.view(0)
    expected = draw(view.scene, constant.psf(view.exposure), small.roman.shape, view.stamps, view.faintest)
    np.testing.assert_array_equal(others.load(0, ("truth",))["truth"], expected)
    assert (others.load(0, ("truth",))["truth"] != small.product.load(0, ("truth",))["truth"]).any()


def test_psfs_that_differ_between_visits_have_no_stage(small):
    survey = Survey(load_pipeline("tiny", ["rubin.mode=visits", "roman=null", "rubin.bands=[i]"]))
    with pytest.raises(UserError, match="PSF of its own"):
        build_psf_models(survey, "rubin")
    rubin = survey.instruments["rubin"]
    found = psfs_for(rubin, small.table)
    assert isinstance(found, ExposurePsfs)
    exposure = replace(small.exposures[0], band="i", seeing=0.7, airmass=1.1)
    assert found.inputs(exposure) == ()
    assert found.bright(exposure) == ()
    assert found.edges(exposure) == rubin.psf_edges(exposure)


def test_settings_of_the_psf_make_other_units(roman, pair, small):
    other = replace(roman, settings=roman.settings.model_copy(update={"charge_diffusion": 0.3}))
    changed = psfs_for(other, small.table.assign(band="Y106"))
    assert changed.product.units[0].settings != pair[0].product.units[1].settings


def test_an_array_is_padded_and_trimmed():
    values = np.arange(6, dtype=np.complex64).reshape(2, 3)
    whole = padded(values, (3, 4))
    assert whole.shape == (3, 4)
    assert np.count_nonzero(whole) == 5
    np.testing.assert_array_equal(trimmed(whole, (2, 3)), values, strict=True)
    assert padded(values, (2, 3)) is values
    assert PsfLayout(2, Grid(512, 3)).edge_sizes == [16, 32, 64, 128, 256, 512]
