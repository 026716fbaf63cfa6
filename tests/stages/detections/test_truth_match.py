"""Counterparts against a loop over all pairs, and completeness and purity."""

import numpy as np
import pandas as pd
import pytest

from romandask.kernels.measurement.counterparts import NEIGHBOURS, counterparts
from romandask.model.sky import unit_vectors
from romandask.stages.detections.truth_match import BINS, completeness

ARCSEC = np.pi / 180 / 3600


def crowd(count: int, seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Return unit vectors and magnitudes of objects in a square of 6 arcsec around RA 0, where RA wraps."""
    random = np.random.default_rng(seed)
    ra, dec = random.uniform(-3, 3, count) / 3600, random.uniform(-3, 3, count) / 3600
    return unit_vectors(ra % 360, dec), random.uniform(20, 26, count)


def test_counterparts_are_those_of_a_loop_over_all_pairs():
    (measured, magnitude), (true, true_magnitude) = crowd(60, 1), crowd(50, 2)
    magnitude[5], true_magnitude[7] = np.nan, np.nan
    found = counterparts(measured, magnitude, true, true_magnitude, ARCSEC)
    alone = 0
    for n, vector in enumerate(measured):
        distance = np.arccos(np.clip(true @ vector, -1, 1))
        near = [k for k in np.argsort(distance)[:NEIGHBOURS] if distance[k] <= ARCSEC]
        assert found.candidates[n] == len(near)
        if not near:
            alone += 1
            assert found.row[n] == -1
            assert np.isnan(found.separation[n])
            continue
        known = [k for k in near if np.isfinite(true_magnitude[k] - magnitude[n])]
        best = min(known, key=lambda k: abs(true_magnitude[k] - magnitude[n])) if known else near[0]
        assert found.row[n] == best
        assert found.separation[n] == pytest.approx(distance[best], rel=1e-3)
    assert 0 < alone < 60
    assert (found.candidates == NEIGHBOURS).any()


def test_empty_catalogs_have_no_counterparts():
    vectors, magnitude = crowd(4, 3)
    nothing = np.empty((0, 3)), np.empty(0)
    assert (counterparts(vectors, magnitude, *nothing, ARCSEC).row == -1).all()
    assert len(counterparts(*nothing, vectors, magnitude, ARCSEC).row) == 0


def test_completeness_counts_true_and_purity_measured_objects():
    flux = 10 ** ((31.4 - np.array([20.1, 20.2, 20.3, 24.1, 24.2])) / 2.5)
    summary = pd.DataFrame({"flux_H158": flux, "objectId": [5, 6, 0, 0, 9]})
    matched = pd.DataFrame({"magnitude": [20.4, 20.2, 24.3, 24.4, np.nan], "truth_id": [1, 2, 3, -1, -1]})
    found = completeness(summary, matched, "H158").set_index("magnitude")
    assert len(found) == len(BINS) - 1
    assert found.loc[20.25, ["true", "found", "objects", "real"]].tolist() == [3, 2, 2, 2]
    assert found.loc[24.25, "completeness"] == 0.5
    assert found.loc[24.25, "purity"] == 0.5
    assert np.isnan(found.loc[18.25, "completeness"])
