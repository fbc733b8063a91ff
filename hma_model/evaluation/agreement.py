"""Measure how well two judgements agree: correlations, MMRV, AUROC, accuracies, precision and recall.

Correlations, MMRV and AUROC have bootstrap intervals. Shares have those of Clopper and Pearson (1934), which
stay honest for few episodes and for shares of 0 and 1: a bootstrap would call these certain.

M policies, N episodes, R resamples. All intervals hold 95 %.
"""

import warnings
from dataclasses import dataclass
from functools import lru_cache
from itertools import combinations

import numpy as np
from numpy.typing import ArrayLike
from scipy import stats

from hma_model.arrays import Bools, Floats

RESAMPLES = 2000
MIN_POLICIES, MIN_EPISODES = 3, 8  # fewer say nothing about a correlation
FEW_POLICIES = 5  # fewer are drawn as the same few again and again: the interval would say nothing
TAIL = 0.025  # chance beyond either end of an interval


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
    """

    balanced: float | None
    low: float | None
    high: float | None
    share: float
    count: int
    successes: int

    @property
    def better_than_chance(self) -> bool:
        """Return whether the interval lies above 0.5, which is chance."""
        return self.low is not None and self.low > 0.5

    @property
    def too_few(self) -> str:
        """Return "successes" or "failures" if they are so few that no judge can pass; else nothing."""
        failures = self.count - self.successes
        if _balanced((self.successes, failures), (self.successes, failures))[1] > 0.5:
            return ""
        return "successes" if self.successes <= failures else "failures"

    def __str__(self) -> str:
        counts = f"{self.count} episodes, {self.successes} success{'es' * (self.successes != 1)}"
        if self.balanced is None:
            return f"{self.share:.0%} right; all episodes have the same outcome ({counts})"
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
    policies, episodes = one.shape
    if policies < FEW_POLICIES:
        return {name: Estimate(float(measure(*means))) for name, measure in measures.items()}
    rng = np.random.default_rng(seed)
    rows = rng.integers(policies, size=(RESAMPLES, policies))
    # two policies always correlate by 1 or -1, so draws of so few say nothing
    rows = rows[[len(set(drawn)) >= MIN_POLICIES for drawn in rows.tolist()]]
    columns = rng.integers(episodes, size=(len(rows), episodes))
    drawn = [values[rows[:, :, None], columns[:, None]].mean(axis=-1) for values in (one, other)]
    found = {}
    for name, measure in measures.items():
        spread = measure(*drawn)
        # A resample in which all policies are alike has no correlation. Dropping it would keep those in which
        # one lucky episode parts them, so it widens the interval to both sides instead.
        low = np.percentile(np.where(np.isnan(spread), -1, spread), 100 * TAIL)
        high = np.percentile(np.where(np.isnan(spread), 1, spread), 100 * (1 - TAIL))
        found[name] = Estimate(float(measure(*means)), float(low), float(high))
    return found


def rank_violation(true: ArrayLike, made: ArrayLike) -> Floats:
    """Return the mean maximum rank violation (MMRV) over the last axis (…, M) of policies' figures.

    A policy's violation is the largest true difference from a policy that the model orders otherwise. Ties
    count as in SIMPLER (Li et al. 2024): only "greater" and "not greater" are compared.
    """
    true, made = np.asarray(true), np.asarray(made)
    gaps = true[..., :, None] - true[..., None, :]
    wrong = (gaps > 0) != (made[..., :, None] > made[..., None, :])
    return np.where(wrong, np.abs(gaps), 0.0).max(axis=-1).mean(axis=-1)


def mmrv(true: Floats, made: Floats, seed: int = 0) -> Estimate:
    """Return the MMRV of the means of two judgements (M, N) of the same episodes.

    A resample draws episodes, jointly for all policies and both judgements; the policies stay. Noise can only
    add violations, so the interval is widened to hold the value.
    """
    if reason := _too_little(true):
        return Estimate(None, reason=reason)
    value = float(rank_violation(true.mean(axis=1), made.mean(axis=1)))
    drawn = _drawn_episodes(true.shape[1], seed)  # sums of outcomes are exact, so equal policies stay equal
    spread = rank_violation(drawn @ true.T, drawn @ made.T) / true.shape[1]
    low, high = np.percentile(spread, [100 * TAIL, 100 * (1 - TAIL)])
    return Estimate(value, min(float(low), value), max(float(high), value))


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


def accuracy(true: Bools, judged: Bools) -> Accuracy:
    """Return how often judgements (N,) are right."""
    right = judged == true
    counts = float(right.mean()), true.size, int(true.sum())
    each = int(true.sum()), int((~true).sum())
    if not all(each):
        return Accuracy(None, None, None, *counts)
    return Accuracy(*_balanced((int(right[true].sum()), int(right[~true].sum())), each), *counts)


def _balanced(right: tuple[int, int], each: tuple[int, int]) -> tuple[float, float, float]:
    """Return the balanced accuracy and its interval from the right judgements of both outcomes.

    The distances of two shares from the ends of their intervals add up in squares (Newcombe 1998). With the
    ends of Clopper and Pearson, a judge that guesses, with whatever bias, passes in less than 2.5 % of cases.
    An outcome that never came tells nothing.
    """
    shares = np.array([part / max(whole, 1) for part, whole in zip(right, each)])
    ends = np.array([share_interval(part, whole) for part, whole in zip(right, each)])
    below, above = np.sqrt(np.square(ends - shares[:, None]).sum(axis=0)) / 2
    middle = float(shares.mean())
    return middle, middle - float(below), middle + float(above)


@lru_cache(maxsize=1024)
def share_interval(successes: int, count: int) -> tuple[float, float]:
    """Return Clopper and Pearson's interval of a share: the shares under which the count is no surprise."""
    if not count:
        return 0.0, 1.0
    ends = stats.binomtest(successes, count).proportion_ci(1 - 2 * TAIL)
    return float(ends.low), float(ends.high)


def precision_recall(true: Bools, judged: Bools) -> tuple[Estimate, Estimate]:
    """Return the share of judged successes (N,) that are true, and that of true ones that are judged so."""
    hits, said, there = int((true & judged).sum()), int(judged.sum()), int(true.sum())

    def share(count: int, missing: str) -> Estimate:
        ends = share_interval(hits, count)
        return Estimate(hits / count, *ends) if count else Estimate(None, reason=missing)

    return share(said, "nothing is judged a success"), share(there, "nothing truly succeeds")


def auroc(true: Bools, scores: Floats, seed: int = 0) -> Estimate:
    """Return the chance that the score of a success is above that of a failure; equal scores count half.

    A resample draws episodes, jointly for all policies. One without a success or a failure widens the
    interval to both sides. Successes that all score above all failures are as certain as a share of as many.

    Args:
        true, scores: (M, N).
        seed: of the resamples.
    """
    successes, failures = int(true.sum()), int((~true).sum())
    count = true.shape[1]
    if count < MIN_EPISODES:
        return Estimate(None, reason=f"{count} of at least {MIN_EPISODES} episodes")
    if not successes or not failures:
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
    told = compared > 0
    spread = ((drawn @ above) * drawn).sum(axis=1) / np.where(told, compared, 1)
    least = float(np.percentile(np.where(told, spread, 0), 100 * TAIL))
    most = float(np.percentile(np.where(told, spread, 1), 100 * (1 - TAIL)))
    few = min(successes, failures)
    if value > 1 - 1e-12:
        least = min(least, share_interval(few, few)[0])
    if value < 1e-12:
        most = max(most, share_interval(0, few)[1])
    return Estimate(value, least, most)


def episode_correlation(one: Floats, other: Floats) -> Estimate:
    """Return how the scores (N,) of single episodes correlate, with Fisher's interval."""
    if one.size < MIN_EPISODES:
        return Estimate(None, reason=f"{one.size} of at least {MIN_EPISODES} episodes")
    if np.ptp(one) < 1e-12 or np.ptp(other) < 1e-12:
        return Estimate(None, reason="all episodes have the same score")
    found = stats.pearsonr(one, other)
    ends = found.confidence_interval(1 - 2 * TAIL)
    return Estimate(float(found.statistic), float(ends.low), float(ends.high))


def alike_pairs(success: Bools) -> list[tuple[int, int]]:
    """Return the pairs of policies (M, N) whose success over the same episodes is no surprise for equals.

    Only episodes with different outcomes tell two policies apart: the exact test of McNemar (1947).
    """
    pairs = []
    for one, other in combinations(range(len(success)), 2):
        better = int((success[one] & ~success[other]).sum())
        worse = int((success[other] & ~success[one]).sum())
        if better + worse == 0 or stats.binomtest(better, better + worse).pvalue >= 2 * TAIL:
            pairs.append((one, other))
    return pairs
