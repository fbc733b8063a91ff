"""Correlations and accuracies: against scipy, and what is too little to say anything."""

import numpy as np
import pytest
from scipy import stats

from hma_model.evaluation.agreement import accuracy, correlations, mean_interval, pearson, ranks, spearman


@pytest.fixture
def series() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    one = rng.integers(0, 6, (20, 9)).astype(float)  # with ties
    return one, 0.5 * one + rng.normal(0, 1, one.shape).round(1)


def test_correlations_are_those_of_scipy(series: tuple[np.ndarray, np.ndarray]) -> None:
    one, other = series
    np.testing.assert_allclose(ranks(one), stats.rankdata(one, axis=1))
    for own, theirs in ((pearson, stats.pearsonr), (spearman, stats.spearmanr)):
        wanted = [theirs(*pair).statistic for pair in zip(one, other, strict=True)]
        np.testing.assert_allclose(own(one, other), wanted, atol=1e-12)
    assert np.isnan(pearson([1, 1, 1], [1, 2, 3]))


def test_an_interval_is_that_of_scipys_bootstrap() -> None:
    values = np.random.default_rng(1).exponential(3.0, 40)
    wanted = stats.bootstrap((values,), np.mean, method="percentile", n_resamples=5000, rng=2)
    np.testing.assert_allclose(mean_interval(values), wanted.confidence_interval, atol=0.12)


def test_policies_and_episodes_are_drawn_jointly_for_both_judgements() -> None:
    rng = np.random.default_rng(3)
    true = (rng.random((6, 20)) < np.linspace(0.1, 0.9, 6)[:, None]).astype(float)
    same = correlations(true, true)
    for found in same.values():  # a judgement agrees with itself in every resample
        assert found.value == pytest.approx(1) and found.low == pytest.approx(1)
    noisy = correlations(true, true + rng.normal(0, 1, true.shape))["pearson"]
    assert noisy.low < noisy.value < 1 and noisy.high > noisy.value
    assert correlations(true, true + 1, seed=5) == correlations(true, true + 1, seed=5)


@pytest.mark.parametrize(
    ("shape", "said"),
    [((2, 20), "2 of the 3 policies"), ((4, 5), "5 of the 8 episodes"), ((4, 9), "alike in")],
)
def test_too_little_is_said_and_not_computed(shape: tuple[int, int], said: str) -> None:
    one = np.random.default_rng(4).random(shape)
    for found in correlations(one, np.zeros(shape)).values():
        assert found.value is None and said in found.reason and said in str(found)


def test_accuracy_counts_successes_and_failures_alike() -> None:
    true = np.arange(40) < 10
    always = accuracy(true, np.ones(40, bool))
    assert (always.balanced, always.share, always.successes) == (0.5, 0.25, 10)
    assert not always.better_than_chance and accuracy(true, true).better_than_chance
    judged = true.copy()
    judged[[0, 1, 20]] ^= True
    found = accuracy(true, judged)
    assert found.balanced == pytest.approx((0.8 + 29 / 30) / 2) and found.low < found.balanced < found.high
    assert not accuracy(np.ones(9, bool), np.ones(9, bool)).better_than_chance  # all alike: nothing is known
