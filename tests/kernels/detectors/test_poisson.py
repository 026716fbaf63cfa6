"""Poisson numbers, compared with the Poisson distribution."""

import numpy as np
import pytest
from scipy import stats

from romandask.kernels.detectors.poisson import MAX_TABLE_MEAN, poisson


@pytest.mark.parametrize("mean", [0.02, 0.7, 1.0, 7.25, 118.6, 1023.5, MAX_TABLE_MEAN - 0.1, MAX_TABLE_MEAN, 3e4])
def test_frequencies_follow_the_distribution(mean):
    # means are rounded to float32
    mean = float(np.float32(mean))
    numbers = poisson(np.full((500, 800), mean), np.random.default_rng(1))
    # about thirty classes of nearly equal expectation
    distribution = stats.poisson(mean)
    edges = np.unique(distribution.ppf(np.linspace(0, 1, 32)[1:-1]))
    expected = np.diff(np.concatenate([[0.0], distribution.cdf(edges), [1.0]])) * numbers.size
    counts = np.bincount(np.searchsorted(edges, numbers.ravel()), minlength=len(edges) + 1)
    keep = expected > 5
    chi2 = ((counts - expected)[keep] ** 2 / expected[keep]).sum()
    assert stats.chi2(max(1, keep.sum() - 1)).sf(chi2) > 1e-4
    assert numbers.mean() == pytest.approx(mean, abs=5 * np.sqrt(mean / numbers.size))
    assert numbers.var() == pytest.approx(mean, rel=5 * np.sqrt((2 + 1 / mean) / numbers.size))
    assert (numbers == np.rint(numbers)).all()


def test_the_tails_have_the_right_frequency():
    """Count the numbers beyond the 1e-4 quantiles on both sides."""
    distribution = stats.poisson(140.4)
    numbers = poisson(np.full(4_000_000, 140.4), np.random.default_rng(2))
    low, high = distribution.ppf(1e-4), distribution.isf(1e-4)
    for count, share in (
        ((numbers < low).sum(), distribution.cdf(low - 1)),
        ((numbers > high).sum(), distribution.sf(high)),
    ):
        assert abs(count - share * numbers.size) < 5 * np.sqrt(share * numbers.size)


def test_pixels_have_their_own_means_and_are_independent():
    mean = np.random.default_rng(3).uniform(0, 3 * MAX_TABLE_MEAN, (300, 700)).astype(np.float32)
    mean[:, :5] = 0
    numbers = poisson(mean, np.random.default_rng(4))
    pulls = (numbers - mean)[:, 5:] / np.sqrt(mean[:, 5:])
    assert (numbers[:, :5] == 0).all()
    assert abs(pulls.mean()) < 5 / np.sqrt(pulls.size)
    assert pulls.var() == pytest.approx(1, abs=0.02)
    assert abs((pulls[:, 1:] * pulls[:, :-1]).mean()) < 5 / np.sqrt(pulls.size)
    np.testing.assert_array_equal(numbers, poisson(mean, np.random.default_rng(4)))


@pytest.mark.parametrize("mean", [-1e-3, np.nan])
def test_a_negative_or_nan_mean_raises(mean):
    with pytest.raises(ValueError, match="lam"):
        poisson(np.array([3.0, mean]), np.random.default_rng(1))
