"""Measure how well two judgements agree: correlations, MMRV, AUROC, accuracies, precision and recall.

All policies act in the same N scenes, so only the scenes are independent: episode n of each policy has the
same start. Correlations, MMRV and AUROC have bootstrap intervals, which draw scenes. Shares have those of
Clopper and Pearson (1934), for as many episodes as independent ones would tell as much (Korn and Graubard
1998). They stay honest for few scenes and for shares of 0 and 1: a bootstrap would call these certain.

M policies, N episodes, R resamples. All intervals hold 95 %.
"""

import math
import warnings
from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats
from scipy.special import betaincinv

from hma_data.arrays import Bools, Floats, Ints

RESAMPLES, BATCHES = 2000, 20  # a batch of ranks of single episodes fits in memory
MIN_POLICIES, MIN_EPISODES = 3, 8  # fewer say nothing about a correlation
FEW_POLICIES = 5  # fewer are drawn as the same few again and again: the interval would say nothing
TAIL = 0.025  # chance beyond either end of an interval
NEEDED = 4  # scenes with successes, and with failures, in which a judge that is always right passes


@dataclass(frozen=True)
class Estimate:
    """A figure with its interval.

    Attributes:
        value: None if it was not computed.
        low, high: of the interval; None without one.
        reason: why it was not computed; else empty.
    """

    value: float | None
    low: float | None = None
    high: float | None = None
    reason: str = ""

    def __str__(self) -> str:
        if self.value is None:
            return f"not computed: {self.reason}"
        if self.low is None:
            return f"{self.value:.2f} (too few for an interval)"
        return f"{self.value:.2f} ({self.low:.2f} to {self.high:.2f})"


@dataclass(frozen=True)
class Accuracy:
    """The shares of yes-or-no judgements that were right.

    Attributes:
        balanced: the mean of the shares of right ones among the true successes and among the failures.
        low, high: its interval, from those of both shares.
        share: the share of right ones among all.
        count, successes: judgements, and true successes among them.
        too_few: "successes" or "failures" if so few scenes have some that no judge can pass; else empty.
    """

    balanced: float | None
    low: float | None
    high: float | None
    share: float
    count: int
    successes: int
    too_few: str = ""

    @property
    def better_than_chance(self) -> bool:
        """Return whether the interval lies above 0.5, which is chance."""
        return self.low is not None and self.low > 0.5

    def __str__(self) -> str:
        counts = f"{self.count} episodes, {self.successes} success{'es' * (self.successes != 1)}"
        if self.balanced is None:
            return f"not computed: all episodes have the same outcome ({counts})"
        few = f"; too few {self.too_few} to tell" if self.too_few else ""
        return f"balanced {self.balanced:.0%} ({self.low:.0%} to {self.high:.0%}; {counts}{few})"


def pearson(one: ArrayLike, other: ArrayLike) -> Floats:
    """Return the correlation over the last axis (…, M) of two series; NaN where one is constant."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", (stats.ConstantInputWarning, stats.NearConstantInputWarning))
        return stats.pearsonr(np.asarray(one), np.asarray(other), axis=-1).statistic


def spearman(one: ArrayLike, other: ArrayLike) -> Floats:
    """Return the correlation of the ranks over the last axis (…, M) of two series."""
    return pearson(stats.rankdata(one, axis=-1), stats.rankdata(other, axis=-1))


def correlations(one: Floats, other: Floats, seed: int = 0) -> dict[str, Estimate]:
    """Return how the means of two judgements of the same episodes correlate over policies.

    A resample draws policies and episodes. The episodes are drawn jointly for all policies and both
    judgements, because they share their beginnings. Fewer than five policies have no interval.

    Args:
        one, other: (M, N).
        seed: of the resamples.

    Returns:
        "pearson" and "spearman".
    """
    if reason := _too_little(one, other):
        return dict.fromkeys(("pearson", "spearman"), Estimate(None, reason=reason))
    measures = {"pearson": pearson, "spearman": spearman}
    means = one.mean(axis=1), other.mean(axis=1)
    policies = len(one)
    if policies < FEW_POLICIES:
        return {name: Estimate(float(measure(*means))) for name, measure in measures.items()}
    rows = np.random.default_rng(seed).integers(policies, size=(RESAMPLES, policies))
    # two policies always correlate by 1 or -1, so draws of so few say nothing
    told = [len(set(drawn)) >= MIN_POLICIES for drawn in rows.tolist()]
    drawn = [np.take_along_axis(one, rows, axis=1)[told] for one in _resampled((one, other), seed)]
    found = {}
    for name, measure in measures.items():
        found[name] = _mirrored(measure(*means), measure(*drawn), -1.0, 1.0)
    return found


def _resampled(judged: Sequence[Floats], seed: int) -> list[Floats]:
    """Return the means (R, M) of judgements (M, N) over episodes that are drawn for all of them together.

    One episode is added, in which each policy's figure is any one of the judgement. Without it, few episodes
    that all agree would make the agreement certain.
    """
    rng = np.random.default_rng(seed)
    count = judged[0].shape[1]
    drawn = _drawn_episodes(count, seed)
    added = [rng.choice(values.ravel(), (RESAMPLES, len(values))) for values in judged]
    return [(drawn @ values.T + more) / (count + 1) for values, more in zip(judged, added, strict=True)]


def _mirrored(value: Floats, spread: Floats, least: float, most: float) -> Estimate:
    """Return a figure with the interval of resampled ones (R,), widened by its mirror image.

    Noise of the means weakens correlations and adds rank violations: in the figure, and once more in the
    resamples. What they are too far to one side, the figure is too.
    """
    middle = float(value)
    low, high = _ends(spread, least, most)
    below, above = min(low, 2 * middle - high), max(high, 2 * middle - low)
    return Estimate(middle, max(below, least), min(above, most))


def _ends(spread: Floats, least: float, most: float, tail: float = TAIL) -> tuple[float, float]:
    """Return the interval of resampled figures (R,), which are NaN where there is nothing to compare.

    Such a resample has all policies or outcomes alike. Dropping it would keep those in which one lucky
    episode parts them, so it widens the interval to both sides instead.
    """
    low = np.percentile(np.where(np.isnan(spread), least, spread), 100 * tail)
    high = np.percentile(np.where(np.isnan(spread), most, spread), 100 * (1 - tail))
    return float(low), float(high)


def rank_violation(true: ArrayLike, made: ArrayLike) -> Floats:
    """Return the mean maximum rank violation (MMRV) over the last axis (…, M) of policies' figures.

    A policy's violation is the largest true difference from a policy that the model orders otherwise. Ties
    count as in SIMPLER (Li et al. 2024): only "greater" and "not greater" are compared.
    """
    return _violations(true, made).max(axis=-1).mean(axis=-1)


def _violations(true: ArrayLike, made: ArrayLike) -> Floats:
    """Return the true differences (…, M, M) of policies (…, M) that the model orders otherwise, else 0."""
    true, made = np.asarray(true), np.asarray(made)
    gaps = true[..., :, None] - true[..., None, :]
    wrong = (gaps > 0) != (made[..., :, None] > made[..., None, :])
    return np.where(wrong, np.abs(gaps), 0.0)


def mmrv(true: Floats, made: Floats, seed: int = 0) -> Estimate:
    """Return the MMRV of the means of two judgements (M, N) of the same episodes.

    A resample draws episodes, jointly for all policies and both judgements; the policies stay. Where the
    model hardly parts its policies, all resamples violate some order, each another. So the interval begins
    no higher than the MMRV of those pairs that nearly all resamples violate (Bonferroni's share).
    """
    if reason := _too_little(true):
        return Estimate(None, reason=reason)
    means, drawn = (true.mean(axis=1), made.mean(axis=1)), _resampled((true, made), seed)
    found = _mirrored(rank_violation(*means), rank_violation(*drawn), 0.0, float(np.ptp(true)))
    doubt = 1 - (_violations(*drawn) > 0).mean(axis=0)
    sure = np.where(doubt < TAIL / math.comb(len(true), 2), _violations(*means), 0.0)
    return replace(found, low=min(found.low or 0.0, float(sure.max(axis=-1).mean())))


def _drawn_episodes(count: int, seed: int) -> Floats:
    """Return how often each of the episodes is drawn, (R, N)."""
    drawn = np.random.default_rng(seed).multinomial(count, np.full(count, 1 / count), RESAMPLES)
    return drawn.astype(float)


def _too_little(*judged: Floats) -> str:
    """Say why judgements (M, N), of the simulator and perhaps of the model, tell nothing; "" if they do."""
    policies, episodes = judged[0].shape
    if policies < MIN_POLICIES:
        return f"{policies} of at least {MIN_POLICIES} policies"
    if episodes < MIN_EPISODES:
        return f"{episodes} of at least {MIN_EPISODES} episodes"
    for values, where in zip(judged, ("the simulator", "the model")):
        if np.ptp(values.mean(axis=1)) < 1e-12:
            return f"all policies are equal in {where}"
    return ""


def accuracy(true: Bools, judged: Bools, among: Bools | None = None) -> Accuracy:
    """Return how often judgements (M, N) are right, or (N,) of independent episodes.

    `among` (M, N) are those that count, by default all; at least one does.
    """
    true, judged = np.atleast_2d(true, judged)
    kept = np.ones_like(true) if among is None else among
    right = judged == true
    outcomes = {"successes": true & kept, "failures": ~true & kept}
    scenes = {name: int(one.any(axis=0).sum()) for name, one in outcomes.items()}
    balanced: tuple[float | None, float | None, float | None] = None, None, None
    if all(scenes.values()):
        balanced = _balanced(right, *outcomes.values())
    faultless = _balanced(kept, *outcomes.values())[1] > 0.5
    few = "" if faultless else min(scenes, key=lambda name: scenes[name])
    counts = float(right[kept].mean()), int(kept.sum()), int(outcomes["successes"].sum())
    return Accuracy(*balanced, *counts, few)


def _balanced(right: Bools, *outcomes: Bools) -> tuple[float, float, float]:
    """Return the balanced accuracy of right judgements (M, N) of two outcomes (M, N), and its interval.

    The distances of two shares from the ends of their intervals add up in squares (Newcombe 1998), and more
    if both shares are high in the same scenes (Zou 2007). With the ends of Clopper and Pearson, a judge that
    guesses, with whatever bias, passes in less than 2.5 % of cases. An outcome that never came tells nothing.
    """
    shares = np.array([(right & one).sum() / max(one.sum(), 1) for one in outcomes])
    ends = np.array([share_interval(*independent(right & one, one)) for one in outcomes])
    away = [(right & one).sum(axis=0) - part * one.sum(axis=0) for one, part in zip(outcomes, shares)]
    together = np.linalg.norm(away, axis=1).prod()
    shared = max(float(np.dot(away[0], away[1]) / together), 0.0) if together > 0 else 0.0
    distances = np.abs(ends - shares[:, None])  # of both shares, by the ends
    below, above = np.sqrt(np.square(distances).sum(axis=0) + 2 * shared * distances.prod(axis=0)) / 2
    middle = float(shares.mean())
    return middle, middle - float(below), middle + float(above)


def independent(hits: Bools, among: Bools) -> tuple[float, float]:
    """Return hits (M, N) and the episodes (M, N) among which they are, as counts of independent episodes.

    The counts are divided by the design effect: how much more their share varies between scenes than
    that of independent episodes. One scene of hits and one of misses are added, so that few scenes which
    happen to be alike are not certain. Of one policy both counts stay.
    """
    here = among.any(axis=0)
    sizes, found = among.sum(axis=0)[here], (hits & among).sum(axis=0)[here]
    if not len(sizes):
        return 0.0, 0.0
    size = sizes.mean()
    of_scenes, in_scenes = np.append(sizes, [size, size]), np.append(found, [size, 0])
    share = in_scenes.sum() / of_scenes.sum()
    by_chance = share * (1 - share) * of_scenes.sum()
    effect = max(float(np.square(in_scenes - share * of_scenes).sum() / by_chance), 1.0)
    return float(found.sum()) / effect, float(sizes.sum()) / effect


def by_scene(scenes: Ints, *judged: Bools) -> list[Bools]:
    """Return judgements (N,) by their scenes (N,) as (M, scenes), and last which of these places are taken.

    M is the largest number of a scene.
    """
    _, own, counts = np.unique(scenes, return_inverse=True, return_counts=True)
    kept = np.arange(counts.max())[:, None] < counts
    tables = [np.zeros_like(kept) for _ in judged]
    for table, values in zip(tables, judged, strict=True):
        table.T[kept.T] = values[np.argsort(own, kind="stable")]
    return [*tables, kept]


def share_interval(successes: float, count: float) -> tuple[float, float]:
    """Return Clopper and Pearson's interval of a share: the shares under which the count is no surprise."""
    failures = count - successes
    low = float(betaincinv(successes, failures + 1, TAIL)) if successes else 0.0
    return low, float(betaincinv(successes + 1, failures, 1 - TAIL)) if failures else 1.0


def precision_recall(true: Bools, judged: Bools, among: Bools | bool = True) -> tuple[Estimate, Estimate]:
    """Return the share of judged successes (M, N) that are true, and that of true ones that are judged so.

    `among` (M, N) are those that count, by default all.
    """

    def share(of: Bools, missing: str) -> Estimate:
        kept, hits = of & among, true & judged & among
        if not kept.any():
            return Estimate(None, reason=missing)
        return Estimate(int(hits.sum()) / int(kept.sum()), *share_interval(*independent(hits, kept)))

    return share(judged, "nothing is judged a success"), share(true, "nothing truly succeeds")


def auroc(true: Bools, scores: Floats, seed: int = 0) -> Estimate:
    """Return the chance that the score of a success is above that of a failure; equal scores count half.

    A resample draws scenes, jointly for all policies. One without a success or a failure widens the
    interval to both sides. Successes that all score above all failures are as certain as a share of as many
    scenes.

    Args:
        true, scores: (M, N).
        seed: of the resamples.
    """
    few = min(int(one.any(axis=0).sum()) for one in (true, ~true))  # scenes with such an outcome
    count = true.shape[1]
    if count < MIN_EPISODES:
        return Estimate(None, reason=f"{count} of at least {MIN_EPISODES} episodes")
    if not few:
        return Estimate(None, reason="all episodes have the same outcome")
    above, pairs = np.zeros((count, count)), np.zeros((count, count))  # by the episodes of both
    for success, high in zip(true, scores, strict=True):
        for other, low in zip(true, scores, strict=True):
            compared = np.outer(success, ~other)
            above += compared * (np.sign(high[:, None] - low) + 1) / 2
            pairs += compared
    value = float(above.sum() / pairs.sum())
    drawn = _drawn_episodes(count, seed)
    compared = ((drawn @ pairs) * drawn).sum(axis=1)
    spread = ((drawn @ above) * drawn).sum(axis=1) / np.where(compared > 0, compared, np.nan)
    least, most = _ends(spread, 0.0, 1.0)
    if value > 1 - 1e-12:
        least = min(least, share_interval(few, few)[0])
    if value < 1e-12:
        most = max(most, share_interval(0, few)[1])
    return Estimate(value, least, most)


def episode_correlation(one: Floats, other: Floats, seed: int = 0) -> Estimate:
    """Return how the ranks of the scores (M, N) of single episodes correlate (Spearman).

    Pearson's correlation would hang on the few episodes in which the model loses an object. A resample draws
    scenes, jointly for all policies. Those of few scenes vary too little, so the percentiles are farther out,
    by Student's t (Hesterberg 2015, 4.3).
    """
    count = one.shape[1]
    if count < MIN_EPISODES:
        return Estimate(None, reason=f"{count} of at least {MIN_EPISODES} episodes")
    if np.ptp(one) < 1e-12 or np.ptp(other) < 1e-12:
        return Estimate(None, reason="all episodes have the same score")

    def correlated(drawn: Ints) -> Floats:
        return spearman(*(values.T[drawn].reshape(*drawn.shape[:-1], -1) for values in (one, other)))

    drawn = np.random.default_rng(seed).integers(count, size=(RESAMPLES, count))
    spread = np.concatenate([correlated(part) for part in np.array_split(drawn, BATCHES)])
    tail = stats.norm.cdf(stats.t.ppf(TAIL, count - 1) * np.sqrt(count / (count - 1)))
    low, high = _ends(spread, -1.0, 1.0, tail)
    value = float(correlated(np.arange(count)))
    if abs(value) > 1 - 1e-12:  # scenes that all agree are as certain as a share of as many
        certain = share_interval(count, count)[0]
        low, high = min(low, certain), max(high, -certain)
    return Estimate(value, low, high)


def alike_pairs(success: Bools) -> list[tuple[int, int]]:
    """Return the pairs of policies (M, N) whose success over the same episodes is no surprise for equals.

    Only episodes with different outcomes tell two policies apart: the exact test of McNemar (1947). Of many
    equal pairs some look different by luck, so of those told apart one in twenty may be (Benjamini and
    Hochberg 1995).
    """
    pairs = list(combinations(range(len(success)), 2))
    if not pairs:
        return []
    better = np.array([(success[one] & ~success[other]).sum() for one, other in pairs])
    worse = np.array([(success[other] & ~success[one]).sum() for one, other in pairs])
    chances = np.minimum(2 * stats.binom.cdf(np.minimum(better, worse), better + worse, 0.5), 1)
    found = stats.false_discovery_control(chances) >= 2 * TAIL
    return [pair for pair, alike in zip(pairs, found, strict=True) if alike]
