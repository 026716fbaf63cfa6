"""Zero points from stars with known true magnitudes."""

import numpy as np
import pandas as pd
import pytest

from romandask.stages.detections.zero_points import FLUXES, corrected, offsets


def stars(count: int, dimming: float, scatter: float) -> pd.DataFrame:
    """Return stars of 15 to 22 mag in one band whose measured fluxes are too faint by `dimming` magnitudes."""
    random = np.random.default_rng(4)
    true = 10 ** ((31.4 - random.uniform(15, 22, count)) / 2.5)
    columns = {"flux_H158": true}
    for k, flux in enumerate(FLUXES):
        columns[f"H158_{flux}"] = true * 10 ** (-0.4 * (dimming + 0.1 * k + random.normal(0, scatter, count)))
    return pd.DataFrame(columns)


def test_offsets_are_the_medians_of_stars_in_the_range_and_are_taken_out():
    table = stars(4000, 0.2, 0.05)
    # saturated and faint stars have other offsets and are not used, nor is a star without flux
    outside = (table["flux_H158"] > 10 ** ((31.4 - 17) / 2.5)) | (table["flux_H158"] <= 10 ** ((31.4 - 20) / 2.5))
    table.loc[outside, "H158_kronFlux"] *= 0.3
    table.loc[table.index[~outside][0], "H158_kronFlux"] = -1.0
    found = offsets(table, ("H158",)).set_index("flux")
    for k, flux in enumerate(FLUXES):
        assert found.loc[flux, "offset"] == pytest.approx(0.2 + 0.1 * k, abs=4 * found.loc[flux, "error"])
        assert found.loc[flux, "error"] == pytest.approx(1.2533 * 0.05 / np.sqrt((~outside).sum()), rel=0.1)
    assert found.loc["apFlux", "stars"] == (~outside).sum()
    assert found.loc["kronFlux", "stars"] == (~outside).sum() - 1
    objects = pd.DataFrame({"objectId": [1], "H158_kronFlux": [100.0], "H158_kronFluxErr": [2.0]})
    after = corrected(objects, found.reset_index())
    scale = 10 ** (0.4 * found.loc["kronFlux", "offset"])
    assert after.loc[0, ["H158_kronFlux", "H158_kronFluxErr"]].tolist() == pytest.approx([100 * scale, 2 * scale])
    assert list(after) == list(objects)


def test_without_stars_nothing_is_changed():
    found = offsets(stars(0, 0, 0), ("H158",))
    assert found["offset"].tolist() == [0.0] * len(FLUXES)
    assert found["stars"].tolist() == [0] * len(FLUXES)
    assert found["error"].isna().all()
