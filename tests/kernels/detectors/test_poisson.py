"""Poisson numbers against the distribution itself."""

import numpy as np
import pytest
from scipy import stats

from romandask.kernels.detectors.poisson import MAX_TABLE_MEAN, poisson


@pytest.mark.parametrize("mean", [0.02, 0.7, 1.0, 7.25, 118.6, 1023.5, MAX_TABLE_MEAN - 0.1, MAX_TABLE_MEAN, 3e4])
def test_frequencies_are_those_of_the_distribution(mean):
    # its float32 is the mean that is drawn
    mean = float(np.float32(mean))
    found = poisson(np.full((500, 800), mean), np.random.default_rng(1))
    # some thirty classes of about equal expectation
    law = stats.poisson(mean)
    edges = np.unique(law.ppf(np.linspace(0, 1, 32)[1:-1]))
    expected = np.diff(np.concatenate([[0.0], law.cdf(edges), [1.0]])) * found.size
    counts = np.bincount(np.searchsorted(edges, found.ravel()), minlength=len(edges) + 1)
    keep = expected > 5
    chi2 = ((counts - expected)[keep] ** 2 / expected[keep]).sum()
    assert stats.chi2(max(1, keep.sum() - 1)).sf(chi2) > 1e-4
    assert found.mean() == pytest.approx(mean, abs=5 * np.sqrt(mean / found.size))
    assert found.var() == pytest.approx(mean, rel=5 * np.sqrt((2 + 1 / mean) / found.size))
    assert (found == np.rint(found)).all()


def test_tails_are_there():
    """Rare numbers come as often as they should: the ten-thousandth parts on both sides."""
    law = stats.poisson(140.4)
    found = poisson(np.full(4_000_000, 140.4), np.random.default_rng(2))
    low, high = law.ppf(1e-4), law.isf(1e-4)
    for count, share in (((found < low).sum(), law.cdf(low - 1)), ((found > high).sum(), law.sf(high))):
        assert abs(count - share * found.size) < 5 * np.sqrt(share * found.size)


def test_each_pixel_has_its_own_mean_and_none_the_others():
    mean = np.random.default_rng(3).uniform(0, 3 * MAX_TABLE_MEAN, (300, 700)).astype(np.float32)
    mean[:, :5] = 0
    found = poisson(mean, np.random.default_rng(4))
    pulls = (found - mean)[:, 5:] / np.sqrt(mean[:, 5:])
    assert (found[:, :5] == 0).all()
    assert abs(pulls.mean()) < 5 / np.sqrt(pulls.size)
    assert pulls.var() == pytest.approx(1, abs=0.02)
    assert abs((pulls[:, 1:] * pulls[:, :-1]).mean()) < 5 / np.sqrt(pulls.size)
    np.testing.assert_array_equal(found, poisson(mean, np.random.default_rng(4)))


@pytest.mark.parametrize("mean", [-1e-3, np.nan])
def test_a_mean_that_is_none_is_refused(mean):
    with pytest.raises(ValueError, match="lam"):
        poisson(np.array([3.0, mean]), np.random.default_rng(1))
