"""Exposures that are drawn only for the part of the detector that the tiles need (`exposures.area: region`)."""

from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from romandask.instruments.exposure import Exposure, footprint
from romandask.instruments.roman.roman import Roman, RomanSettings
from romandask.instruments.rubin.rubin import Rubin, RubinSettings
from romandask.kernels.detectors.simple_detector import NOT_DRAWN, NOT_DRAWN_VALUE, WHOLE
from romandask.model.settings import CoaddSettings, RenderSettings, TruthSettings
from romandask.model.sky import Region
from romandask.pipeline import load_pipeline
from romandask.stages.coadds.coadds import coadds
from romandask.stages.coadds.tile_maker import Coadds
from romandask.stages.exposures.drawn_area import drawn_area
from romandask.stages.exposures.exposures import Exposures, exposures
from romandask.stages.pointings import CORNERS
from romandask.stages.truth.catalogs import truth
from romandask.stages.truth_index import truth_index
from romandask.survey import Survey

SIDE = 1536


@dataclass(frozen=True)
class Pair:
    """The same exposures of detectors of 1536 pixels, drawn whole and in part, and their coadds."""

    whole: Exposures
    part: Exposures
    whole_coadds: Coadds
    part_coadds: Coadds


@pytest.fixture(scope="module")
def pair() -> Pair:
    roman = replace(Roman(RomanSettings(bands=("H158",), psf_degree=1), n_waves=3), shape=(SIDE, SIDE))
    base = Exposure(visit=0, detector=7, band="H158", mjd=61541.0, exptime=139.8, ra=53.0, dec=-40.0, pa=120.0)
    chosen = [replace(base, visit=k, dec=-40.0 + k * 5 / 3600, mjd=61541.0 + k) for k in range(3)]
    corners = np.stack([footprint(roman.header(one), roman.shape) for one in chosen])
    rows = [vars(one) | dict(zip(CORNERS, c.ravel(), strict=True)) for one, c in zip(chosen, corners, strict=True)]
    table = pd.DataFrame(rows)
    ra, dec = corners[..., 0].mean(), corners[..., 1].mean()
    region = Region(ra - 1.2e-2, ra + 1.2e-2, dec - 2e-2, dec + 2e-3)
    bandpasses = {"H158": roman.bandpass("H158"), "i": Rubin(RubinSettings(bands=("i",)), n_waves=3).bandpass("i")}
    # objects far around the region, so that whole detectors show more than the parts
    catalogs = truth(TruthSettings(order=11, margin=60.0, nside=64), Path("."), region, bandpasses, 5)
    settings = CoaddSettings(pixels=360, overlap=30)
    grid = settings.grid()
    # one tile near an edge of the detectors
    tiles = grid.covering(Region(ra - 1e-4, ra + 1e-4, dec - 1.51e-2, dec - 1.5e-2))[:1]
    area = drawn_area(table, tiles, grid.side, grid.pixels(roman.coadd_scale), roman.coadd_scale)
    render = RenderSettings(n_waves=3)
    whole, part = (exposures(table, catalogs, roman, render, 5, area=each) for each in (None, area))
    return Pair(whole, part, coadds(whole, tiles, settings), coadds(part, tiles, settings))


def outside(window: tuple[slice, slice]) -> np.ndarray:
    mask = np.ones((SIDE, SIDE), bool)
    mask[window] = False
    return mask


def test_the_part_that_is_drawn_has_the_pixels_of_the_whole_detector(pair):
    for index in range(3):
        window = pair.part.renderer.view(index).window
        assert 0.05 < 1 - outside(window).mean() < 0.8
        whole, part = pair.whole.load(index), pair.part.load(index)
        for name in ("image", "truth", "dq"):
            np.testing.assert_array_equal(part[name][window], whole[name][window])
            assert part[name].dtype == whole[name].dtype


def test_the_rest_is_flagged_and_looks_like_no_data(pair):
    window = pair.part.renderer.view(0).window
    part, rest = pair.part.load(0), outside(window)
    assert (part["dq"][rest] == NOT_DRAWN).all()
    assert (part["image"][rest] == NOT_DRAWN_VALUE).all()
    assert (part["truth"][rest] == NOT_DRAWN_VALUE).all()
    assert not (part["dq"][window] & NOT_DRAWN).any()
    attributes = pair.part.dataset["dq"].attrs
    assert dict(zip(attributes["flag_meanings"].split(), attributes["flag_masks"], strict=True))["not_drawn"] == 4
    assert pair.part.dataset.attrs["area"] == "region"
    assert pair.whole.dataset.attrs["area"] == "detector"
    assert pair.part.dataset["image"].attrs["not_drawn_value"] == NOT_DRAWN_VALUE
    weight = pair.part.make_layers(0, ("weight",), WHOLE, part)["weight"]
    assert (weight[rest] == 0).all()
    assert (weight[window] > 0).mean() > 0.9


def test_coadds_have_the_same_weight_and_nearly_the_same_background(pair):
    for index in range(len(pair.whole_coadds.names)):
        whole, part = pair.whole_coadds.load(index), pair.part_coadds.load(index)
        for name in ("weight", "nimages", "dq", "noise", "set", "psf"):
            np.testing.assert_array_equal(part[name], whole[name])
        seen = whole["weight"] > 0
        assert seen.mean() > 0.5
        difference = (part["image"] - whole["image"])[seen]
        # only the mesh of the background differs, because it ends where the drawn part does
        assert np.abs(difference).max() < 0.1 * whole["noise"][0][seen].std()
        assert np.abs(difference.mean()) < 0.02 * whole["noise"][0][seen].std()


def test_pixels_that_are_not_drawn_have_no_weight_in_coadds(pair):
    tiles = list(pair.whole_coadds.tiles)
    nothing = replace(pair.part.renderer.area, tiles={0: tuple(tiles)})
    # only the first exposure is drawn
    renderer = replace(pair.part.renderer, area=nothing)
    product = replace(pair.part.product, make=renderer)
    alone = coadds(replace(pair.part, renderer=renderer, product=product), tiles, pair.whole_coadds.settings)
    one, three = alone.load(0), pair.whole_coadds.load(0)
    assert one["nimages"].max() == 1
    assert three["nimages"].max() == 3
    assert (one["weight"] <= three["weight"]).all()
    assert one["weight"].sum() == pytest.approx(three["weight"].sum() / 3, rel=0.05)
    assert np.isfinite(one["image"]).all()
    assert np.abs(one["image"][one["weight"] > 0]).max() < 1e6


def test_the_truth_index_has_the_objects_of_the_part(pair):
    whole, part = (truth_index(each).load(0).set_index("id") for each in (pair.whole, pair.part))
    rows, columns = pair.part.renderer.view(0).window
    assert len(part) < len(whole)
    pd.testing.assert_frame_equal(part, whole.loc[part.index])
    inside = whole["x"].between(columns.start, columns.stop - 1) & whole["y"].between(rows.start, rows.stop - 1)
    assert inside.sum() > 20
    assert set(whole.index[inside]) <= set(part.index)


def test_a_detector_with_all_effects_is_drawn_whole():
    overrides = ["roman.bands=[H158]", "roman.pointings.dithers={H158: [1]}", "roman.detector=sca"]
    survey = Survey(load_pipeline("tiny", overrides))
    assert survey.pipeline.exposures.area == "region"
    assert survey.output("exposures/roman").renderer.area is None
    assert survey.output("exposures/roman").product.attributes["area"] == "detector"


def test_units_of_other_tiles_are_other_units(pair):
    unit, whole = pair.part.units[0], pair.whole.units[0]
    assert unit.settings != whole.settings
    assert unit.inputs == whole.inputs
