"""Truth index: objects on an exposure, their positions and magnitudes, and the reasons why some are not drawn."""

from dataclasses import replace

import numpy as np
import pandas as pd
import pytest
from astropy.wcs import WCS

from romandask.kernels.rendering.scene import BAD_FLUX, BAD_LENSING, BAD_SIZE, NO_POSITION
from romandask.stages.exposures.render import RenderExposure
from romandask.stages.truth_index import truth_index


@pytest.fixture(scope="module")
def index(small) -> pd.DataFrame:
    return truth_index(small.product).load(0)


def test_positions_agree_with_the_wcs(small, index):
    truth = small.truth.galaxies.all_rows().set_index("galaxy_id")
    rows = index[(index["kind"] == "galaxy") & index["drawn"]]
    true = truth.loc[rows["id"]]
    x, y = WCS(small.roman.header(small.exposures[0])).all_world2pix(true["ra"], true["dec"], 0)
    np.testing.assert_allclose(rows["x"], x, atol=1e-6)
    np.testing.assert_allclose(rows["y"], y, atol=1e-6)
    assert (rows["stamp"] > 0).all()


def test_magnitudes_are_those_of_the_truth(small, index):
    truth = small.truth.galaxies.all_rows().set_index("galaxy_id")
    rows = index[(index["kind"] == "galaxy") & index["drawn"]]
    expected = 31.4 - 2.5 * np.log10(truth.loc[rows["id"], "flux_H158"].to_numpy())
    np.testing.assert_allclose(rows["mag"], expected, atol=2e-3)


def test_every_object_inside_is_listed_and_drawn(small, index):
    truth = small.truth.galaxies.all_rows()
    x, y = WCS(small.roman.header(small.exposures[0])).all_world2pix(truth["ra"], truth["dec"], 0)
    inside = truth["galaxy_id"][(x > -0.5) & (x < 299.5) & (y > -0.5) & (y < 299.5)]
    listed = index[index["kind"] == "galaxy"].set_index("id")
    assert listed.loc[inside, "drawn"].all()
    assert (index["reason"] == "").all()


def test_the_flux_of_what_is_drawn_is_in_the_image(small, index):
    image = small.product.load(0, ("truth",))["truth"]
    inside = index.query("x > 20 and x < 280 and y > 20 and y < 280")["flux"].sum()
    assert inside < image.sum() < index["flux"].sum()


def test_objects_that_cannot_be_drawn_have_a_reason_and_no_light(small, index):
    source: RenderExposure = small.product.renderer
    wrong = {
        "size_disk_true": (np.nan, BAD_SIZE),
        "size_minor_disk_true": (-0.1, BAD_SIZE),
        "convergence": (1.5, BAD_LENSING),
        "shear_1": (np.nan, BAD_LENSING),
        "disk_magnorm": (-60.0, BAD_FLUX),
        # behind the projection, and at its pole
        "ra": (233.0, NO_POSITION),
        "dec": (90.0, NO_POSITION),
    }
    inside = index.query("kind == 'galaxy' and 40 < x < 260 and 40 < y < 260")
    ids = inside.nlargest(len(wrong), "flux")["id"].to_numpy()

    class Spoiled:
        def near(self, *cones):
            truth = source.truth.near(*cones)
            galaxies = truth.galaxies.copy()
            for number, (column, (value, _)) in zip(ids, wrong.items(), strict=True):
                galaxies.loc[galaxies["galaxy_id"] == number, column] = value
            return replace(truth, galaxies=galaxies)

    spoiled = replace(source, truth=Spoiled())
    found = truth_index(replace(small.product, renderer=spoiled)).load(0).set_index("id")
    assert found.loc[ids, "reason"].tolist() == [reason for _, reason in wrong.values()]
    assert not found.loc[ids, "drawn"].any()
    assert (found.loc[ids, "flux"] == 0).all()
    assert found.loc[ids, "mag"].isna().all()
    image = spoiled.view(0).expected()
    assert np.isfinite(image).all()
    whole = source.view(0).expected()
    lost = index.set_index("id").loc[ids, "flux"].sum()
    assert whole.sum() - image.sum() == pytest.approx(lost, rel=0.05)
