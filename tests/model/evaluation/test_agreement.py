"""Correlations and accuracies: against scipy, and what is too little to say anything."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from hypothesis.extra.numpy import arrays
from scipy import stats

from hma_model.evaluation import agreement
from hma_model.evaluation.agreement import (
    accuracy,
    alike_pairs,
    auroc,
    correlations,
    episode_correlation,
    mmrv,
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
    for found in [*same.values(), correlations(true[[0, 0, 2, 2, 5]], true[[0, 0, 2, 2, 5]])["pearson"]]:
        assert found.value == pytest.approx(1) and 0.3 < found.low < 1  # of 20 episodes nothing is certain
    assert 0 < mmrv(true, true).high < 0.1 and mmrv(100 * true, -100 * true).high > 50  # of scores, in px
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
    [((2, 20), "2 of at least 3 policies"), ((4, 5), "5 of at least 8 episodes"), ((4, 9), "equal in")],
)
def test_too_little_is_said_and_not_computed(shape: tuple[int, int], said: str) -> None:
    one, still = np.random.default_rng(4).random(shape), np.zeros(shape)
    for found in (*correlations(one, still).values(), mmrv(still, one)):
        assert found.value is None and said in found.reason and said in str(found)
    few = auroc(still > 0, one).reason
    assert few == ("all episodes have the same outcome" if shape[1] > 8 else said)


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
    rng, draws = np.random.default_rng(0), 200
    for successes in (1, 3, 8, 24):
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
    precision, recall = precision_recall(true[None], judged[None])
    assert (precision.value, recall.value) == (pytest.approx(20 / 41), pytest.approx(20 / 30))
    assert precision.low == pytest.approx(0.329, abs=1e-3) and precision.high == pytest.approx(
        0.649, abs=1e-3
    )
    nothing, none = precision_recall(true[None] & False, judged[None] & False)
    assert nothing.value is None and none.value is None and "nothing truly succeeds" in none.reason


def test_scores_of_episodes_correlate_with_an_interval() -> None:
    rng = np.random.default_rng(0)
    one = rng.random((1, 96))
    found, chance = (
        episode_correlation(one, one + 0.2 * rng.random((1, 96))),
        episode_correlation(one, rng.random((1, 96))),
    )
    assert found.low is not None and found.low > 0.8 and chance.low is not None and chance.low < 0
    assert episode_correlation(one, np.exp(9 * one)).value == pytest.approx(1)  # of ranks
    for sign in (1, -1):  # 12 that all agree are not certain
        ends = episode_correlation(one[:, :12], sign * one[:, :12])
        assert sorted(np.abs([ends.low, ends.high])) == pytest.approx([share_interval(12, 12)[0], 1])
    assert episode_correlation(one, one * 0).reason and episode_correlation(one[:, :7], one[:, :7]).reason
    alone = np.zeros((1, 96))
    alone[0, 0] = 1  # most resamples lack this episode, and all their scores are equal
    rare = episode_correlation(alone, alone)
    assert (rare.value, rare.low, rare.high) == (pytest.approx(1), -1, 1)


def drawn_scores(kind: str, rng: np.random.Generator, policies: int, count: int) -> tuple[np.ndarray, ...]:
    """Return scores (M, N) of a model and a simulator that agree well."""
    one, noise = rng.normal(size=(2, policies, count))
    if kind == "scenes":  # that tell most of all policies' scores
        one, noise = (0.9 * rng.normal(size=(1, count)) + 0.44 * values for values in (one, noise))
    other = 0.9 * one + 0.44 * noise
    lost = rng.random((policies, count)) < 0.05
    if kind == "outliers":
        other = np.where(lost, 10 * rng.normal(size=one.shape), other)
    if kind == "outcomes":
        one, other = 10 * (one > 0.5) + noise / 4, 10 * ((one > 0.5) ^ lost) + rng.normal(size=one.shape) / 4
    return (np.round(np.maximum(one, 0)), np.round(np.maximum(other, 0))) if kind == "ties" else (one, other)


@pytest.mark.parametrize("kind", ["plain", "outliers", "outcomes", "ties", "scenes"])
def test_intervals_of_correlating_scores_hold_the_true_one(kind: str, monkeypatch) -> None:
    """With one outlier in twenty episodes, that of Pearson's correlation held it in 66 %, and 0 often."""
    monkeypatch.setattr(agreement, "RESAMPLES", 400)
    monkeypatch.setattr(agreement, "BATCHES", 1)
    policies, draws = 5 if kind == "scenes" else 1, 100
    true = stats.spearmanr(*(v.ravel() for v in drawn_scores(kind, np.random.default_rng(1), 5, 40_000)))[0]
    rng = np.random.default_rng(0)
    found = [episode_correlation(*drawn_scores(kind, rng, policies, 30)) for _ in range(draws)]
    assert 0.9 <= np.mean([one.low <= true <= one.high for one in found]) <= 0.99
    assert np.mean([one.low > 0 for one in found]) > 0.8  # few useful models are refused


def of_scenes(rng: np.random.Generator, policies: int, scenes: int, rate: float) -> np.ndarray:
    """Return outcomes (M, N) of which four in five are those of their scene, and the others are drawn."""
    own = rng.random((policies, scenes)) < 0.2
    return np.where(own, rng.random((policies, scenes)), rng.random(scenes)) < rate


def test_intervals_of_shares_and_scores_resample_the_scenes_with_all_their_policies() -> None:
    """Against a bootstrap in plain loops that draws whole scenes."""
    rng = np.random.default_rng(2)
    true = of_scenes(rng, 7, 100, 0.4)
    judged = true ^ of_scenes(rng, 7, 100, 0.2)
    scores = judged + rng.normal(0, 0.5, (1, 100)) + rng.normal(0, 0.2, (7, 100))
    again = true + rng.normal(0, 0.2, (7, 100))
    drawn: dict[str, list[float]] = {"accuracy": [], "precision": [], "recall": [], "correlation": []}
    for _ in range(1000):
        scenes = rng.integers(100, size=100)
        one, other = true[:, scenes].ravel(), judged[:, scenes].ravel()
        drawn["accuracy"].append((other[one].mean() + (~other[~one]).mean()) / 2)
        drawn["precision"].append(one[other].mean())
        drawn["recall"].append(other[one].mean())
        drawn["correlation"].append(stats.spearmanr(scores[:, scenes].ravel(), again[:, scenes].ravel())[0])
    found = [accuracy(true, judged), *precision_recall(true, judged), episode_correlation(scores, again)]
    for estimate, (name, values) in zip(found, drawn.items(), strict=True):
        wanted = np.percentile(values, [2.5, 97.5])
        np.testing.assert_allclose((estimate.low, estimate.high), wanted, atol=0.02, err_msg=name)
    one, other = accuracy(true.ravel(), judged.ravel()), accuracy(true, judged)
    assert one.balanced == other.balanced and other.high - other.low > 1.5 * (one.high - one.low)


def test_policies_that_all_do_the_same_tell_no_more_than_one() -> None:
    rng = np.random.default_rng(16)
    true, judged = of_scenes(rng, 1, 16, 0.4), of_scenes(rng, 1, 16, 0.5)
    alone, same = accuracy(true, judged), accuracy(true.repeat(8, axis=0), judged.repeat(8, axis=0))
    assert (same.low, same.high) == pytest.approx((alone.low, alone.high))
    assert (alone.low, alone.high) == pytest.approx((accuracy(true[0], judged[0]).low, alone.high))
    some = np.arange(8 * 8).reshape(8, 8) % 8 < 1  # one scene of eight, without a fault
    for truth in (some, ~some):
        faultless = accuracy(truth, truth)
        assert faultless.too_few and not faultless.better_than_chance
        for one in precision_recall(truth, truth):
            assert one.low == pytest.approx(share_interval(*[truth.any(axis=0).sum()] * 2)[0])
    half = np.tile(np.arange(24) < 12, (8, 1))
    assert auroc(half, half * 1.0).low == pytest.approx(share_interval(12, 12)[0])


def test_an_interval_of_several_policies_holds_the_true_accuracy_as_often_as_it_says() -> None:
    rng, draws = np.random.default_rng(0), 200
    for wrong in (0.05, 0.5):
        held, passed = 0, 0
        for _ in range(draws):
            true = of_scenes(rng, 6, 24, 0.4)
            found = accuracy(true, true ^ of_scenes(rng, 6, 24, wrong))
            held += found.balanced is None or found.low <= 1 - wrong <= found.high
            passed += found.better_than_chance
        assert held >= 0.92 * draws, wrong  # 0.6 of them, were the policies independent
        assert wrong < 0.5 or passed <= 0.05 * draws


def test_only_episodes_with_different_outcomes_tell_policies_apart() -> None:
    success = np.zeros((3, 24), bool)
    success[1, :5] = success[2, :6] = True
    assert alike_pairs(success[:2]) == [(0, 1)]  # five of five is a surprise of 1 in 16
    assert alike_pairs(success[[0, 2]]) == []  # six of six of 1 in 32
    assert alike_pairs(success) == [(0, 1), (0, 2), (1, 2)]  # which is none among three pairs
    assert alike_pairs(success[:1]) == []


def test_equal_policies_are_seldom_told_apart_among_many_pairs() -> None:
    rng = np.random.default_rng(4)
    told = [len(alike_pairs(rng.random((7, 100)) < 0.5)) < 21 for _ in range(200)]
    assert np.mean(told) < 0.1  # 0.4 without the correction


def violation_by_hand(true: list[float], made: list[float]) -> float:
    """Return SIMPLER's MMRV: for each policy, the worst pair; then the mean over policies."""
    worst = []
    for i in range(len(true)):
        pairs = [j for j in range(len(true)) if (made[i] > made[j]) != (true[i] > true[j])]
        worst.append(max((abs(true[i] - true[j]) for j in pairs), default=0.0))
    return sum(worst) / len(worst)


def area_by_hand(true: list[bool], scores: list[float]) -> float:
    good = [score for one, score in zip(true, scores, strict=True) if one]
    bad = [score for one, score in zip(true, scores, strict=True) if not one]
    return sum((a > b) + (a == b) / 2 for a in good for b in bad) / (len(good) * len(bad))


BOTH = st.tuples(st.integers(3, 6), st.integers(8, 12)).flatmap(
    lambda shape: st.tuples(
        arrays(np.float64, shape, elements=st.integers(0, 2)),
        arrays(np.float64, shape, elements=st.integers(0, 2)),
    )
)


@settings(max_examples=25, deadline=None)
@given(BOTH)
def test_every_measure_is_what_plain_loops_compute(both: tuple[np.ndarray, np.ndarray]) -> None:
    one, other = both
    violation = mmrv(one, other)
    if violation.value is not None:
        assert violation.value == pytest.approx(
            violation_by_hand(*(values.mean(axis=1).tolist() for values in both))
        )
        assert violation.low <= violation.value <= violation.high
    true = one > 0
    area = auroc(true, other)
    if area.value is None:
        assert true.all() or not true.any()
    else:
        assert area.value == pytest.approx(area_by_hand(true.ravel().tolist(), other.ravel().tolist()))
        assert 0 <= area.low <= area.high <= 1


def test_intervals_of_mmrv_and_auroc_resample_the_episodes_of_all_policies_together() -> None:
    rng = np.random.default_rng(1)
    one = (rng.random((5, 40)) < np.linspace(0.3, 0.7, 5)[:, None]).astype(float)
    other = np.abs(one - (rng.random((5, 40)) < 0.3))
    found, area = mmrv(one, other, seed=7), auroc(one > 0, other, seed=7)
    violations, areas = [], []
    for _ in range(2000):
        drawn = rng.integers(40, size=40)
        violations.append(violation_by_hand(*(v[:, drawn].mean(axis=1).tolist() for v in (one, other))))
        true, scores = one[:, drawn].ravel() > 0, other[:, drawn].ravel()
        areas.append((scores[true].mean() - scores[~true].mean() + 1) / 2)  # of scores of 0 and 1
    for one_found, drawn_values in ((found, violations), (area, areas)):
        wanted = np.percentile(drawn_values, [2.5, 97.5])
        np.testing.assert_allclose((one_found.low, one_found.high), wanted, atol=0.03)
    assert mmrv(one, one).value == 0 and auroc(one > 0, one).low < 1  # 40 starts are never certain


@pytest.mark.parametrize(("scenes", "model"), [(64, 0.6), (16, 1.0), (64, 0.05)])
def test_intervals_over_policies_hold_what_more_episodes_would_show(scenes: int, model: float) -> None:
    """The model orders all policies rightly, but parts them less: single episodes often do not show it."""
    rates = np.linspace(0.3, 0.7, 6)[:, None]
    rng, draws, held = np.random.default_rng(0), 60, {"pearson": 0, "spearman": 0, "mmrv": 0}
    for seed in range(draws):
        true = (rng.random((6, scenes)) < rates) * 1.0
        made = (rng.random((6, scenes)) < 0.5 + model * (rates - 0.5)) * 1.0
        found = correlations(true, made, seed) | {"mmrv": mmrv(true, made, seed)}
        for name, one in found.items():
            held[name] += one.low - 1e-9 <= (0 if name == "mmrv" else 1) <= one.high + 1e-9
    told = held.values() if model > 0.5 else [held["mmrv"]]  # else all resamples violate some order
    assert min(told) >= 0.85 * draws, held
