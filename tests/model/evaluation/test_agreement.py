"""Correlations and accuracies: against scipy, and what is too little to say anything."""

import numpy as np
import pytest
from scipy import stats

from hma_model.evaluation.agreement import (
    accuracy,
    alike_pairs,
    correlations,
    episode_correlation,
    precision_recall,
    share_interval,
)


@pytest.mark.parametrize(("successes", "count"), [(0, 8), (1, 8), (17, 32), (32, 32), (11, 192)])
def test_the_interval_of_a_share_is_scipys_exact_one(successes: int, count: int) -> None:
    wanted = stats.binomtest(successes, count).proportion_ci(0.95, "exact")
    np.testing.assert_allclose(share_interval(successes, count), wanted, atol=1e-9)
    assert wanted.high - wanted.low > 0.05  # never certain


def test_policies_and_episodes_are_drawn_jointly_for_both_judgements() -> None:
    rng = np.random.default_rng(3)
    true = (rng.random((6, 20)) < np.linspace(0.1, 0.9, 6)[:, None]).astype(float)
    same = correlations(true, true)
    for found in same.values():  # a judgement agrees with itself in every resample
        assert found.value == pytest.approx(1) and found.low == pytest.approx(1)
    noisy = correlations(true, true + rng.normal(0, 1, true.shape))["pearson"]
    assert noisy.low < noisy.value < 1 and noisy.high > noisy.value
    assert correlations(true, true + 1, seed=5) == correlations(true, true + 1, seed=5)


def test_policies_that_one_episode_parts_have_no_certain_correlation() -> None:
    alike = np.zeros((6, 24))
    alike[0, 0] = 1  # most resamples lack this episode or this policy, and their means are constant
    for found in correlations(alike, alike).values():
        assert (found.value, found.low, found.high) == (pytest.approx(1), -1, 1)


@pytest.mark.parametrize(
    ("shape", "said"),
    [
        ((2, 20), "2 of at least 3 policies"),
        ((4, 5), "5 of at least 8 episodes"),
        ((4, 9), "alike in"),
    ],
)
def test_too_little_is_said_and_not_computed(shape: tuple[int, int], said: str) -> None:
    one = np.random.default_rng(4).random(shape)
    for found in correlations(one, np.zeros(shape)).values():
        assert found.value is None and said in found.reason and said in str(found)


def test_three_or_four_policies_have_a_correlation_without_an_interval() -> None:
    one = np.random.default_rng(4).random((5, 9))
    for count, there in ((3, False), (4, False), (5, True)):
        for name, found in correlations(one[:count], one[:count] ** 2).items():
            assert found.value is not None and (found.low is not None) == there, name
            assert ("too few for an interval" in str(found)) != there


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


@pytest.mark.parametrize("count", [48, 192])
@pytest.mark.parametrize("says_success", [0.05, 0.15, 0.5])
def test_a_judge_that_guesses_hardly_ever_passes(count: int, says_success: float) -> None:
    """However few the successes; it need not be a fair coin."""
    rng, draws = np.random.default_rng(0), 400
    for successes in (*range(1, 13), 18, 24):
        true = np.arange(count) < successes
        passed = [accuracy(true, rng.random(count) < says_success).better_than_chance for _ in range(draws)]
        assert np.mean(passed) <= 0.05, successes


def test_successes_or_failures_too_few_for_any_judge_are_said() -> None:
    true = np.arange(8) < 1
    for outcome, word in ((true, "successes"), (~true, "failures")):
        found = accuracy(outcome, outcome)  # without error
        assert found.balanced == 1 and not found.better_than_chance
        assert found.too_few == word and f"too few {word} to tell" in str(found)
    plenty = np.arange(48) < 6
    assert not accuracy(plenty, plenty).too_few and "too few" not in str(accuracy(plenty, ~plenty))


def test_precision_and_recall_have_intervals() -> None:
    true, judged = np.zeros(96, bool), np.zeros(96, bool)
    true[:30], judged[10:51] = True, True
    precision, recall = precision_recall(true, judged)
    assert (precision.value, recall.value) == (pytest.approx(20 / 41), pytest.approx(20 / 30))
    assert precision.low == pytest.approx(0.329, abs=1e-3) and precision.high == pytest.approx(
        0.649, abs=1e-3
    )
    nothing, none = precision_recall(true & False, judged & False)
    assert nothing.value is None and none.value is None and "nothing truly succeeds" in none.reason


def test_scores_of_episodes_correlate_with_an_interval() -> None:
    rng = np.random.default_rng(0)
    one = rng.random(96)
    found, chance = (
        episode_correlation(one, one + 0.2 * rng.random(96)),
        episode_correlation(one, rng.random(96)),
    )
    assert found.low is not None and found.low > 0.8 and chance.low is not None and chance.low < 0
    assert episode_correlation(one, np.ones(96)).reason and episode_correlation(one[:7], one[:7]).reason


def test_only_episodes_with_different_outcomes_tell_policies_apart() -> None:
    success = np.zeros((3, 24), bool)
    success[1, :5] = success[2, :6] = True
    assert alike_pairs(success) == [(0, 1), (1, 2)]  # five of five is a surprise of 1 in 16, six of 1 in 32
