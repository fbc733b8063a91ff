"""Measure how well two judgements agree: correlations and accuracies, with bootstrap intervals.

M policies, N episodes, R resamples. All intervals hold 95 %.
"""

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

Floats = NDArray[np.float64]
Bools = NDArray[np.bool_]

RESAMPLES = 2000
MIN_POLICIES, MIN_EPISODES = 3, 8  # fewer say nothing about a correlation


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
        return f"{self.value:.2f} ({self.low:.2f} to {self.high:.2f})"


@dataclass(frozen=True)
class Accuracy:
    """The shares of yes-or-no judgements that were right.

    Attributes:
        balanced: the mean of the shares of right ones among the true successes and among the failures.
        low, high: its interval, by bootstrap within both.
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

    def __str__(self) -> str:
        counts = f"{self.count} episodes, {self.successes} success{'es' * (self.successes != 1)}"
        if self.balanced is None:
            return f"{self.share:.0%} right; all episodes end alike ({counts})"
        return f"balanced {self.balanced:.0%} ({self.low:.0%} to {self.high:.0%}; {counts})"


def pearson(one: ArrayLike, other: ArrayLike) -> Floats:
    """Return the correlation over the last axis (…, M) of two series; NaN where one is constant."""
    x, y = (values - values.mean(axis=-1, keepdims=True) for values in np.asarray([one, other], np.float64))
    size = np.sqrt(np.square(x).sum(axis=-1) * np.square(y).sum(axis=-1))
    constant = (np.ptp(x, axis=-1) < 1e-12) | (np.ptp(y, axis=-1) < 1e-12)
    found: Floats = np.where(constant, np.nan, (x * y).sum(axis=-1) / np.where(constant, 1, size))
    return found


def ranks(values: ArrayLike) -> Floats:
    """Return the ranks from 1 over the last axis (…, M); equal values share the mean of their ranks."""
    array = np.asarray(values, np.float64)
    below = (array[..., None, :] < array[..., None]).sum(axis=-1)
    equal = (array[..., None, :] == array[..., None]).sum(axis=-1)
    found: Floats = below + (equal + 1) / 2
    return found


def spearman(one: ArrayLike, other: ArrayLike) -> Floats:
    """Return the correlation of the ranks over the last axis (…, M) of two series."""
    return pearson(ranks(one), ranks(other))


def correlations(one: Floats, other: Floats, seed: int = 0) -> dict[str, Estimate]:
    """Return how the means of two judgements of the same episodes correlate over policies.

    A resample draws policies and episodes, the episodes jointly for all policies and both judgements, because
    they share their beginnings. Resamples of fewer than three different policies, or of constant means, have
    no correlation and are drawn out.

    Args:
        one, other: (M, N).
        seed: of the resamples.

    Returns:
        "pearson" and "spearman".
    """
    reason = _too_little(one, other)
    if reason:
        return dict.fromkeys(("pearson", "spearman"), Estimate(None, reason=reason))
    rng, (policies, episodes) = np.random.default_rng(seed), one.shape
    rows = rng.integers(policies, size=(RESAMPLES, policies))
    rows = rows[[len(set(drawn)) >= MIN_POLICIES for drawn in rows.tolist()]]
    columns = rng.integers(episodes, size=(len(rows), episodes))
    drawn = [values[rows[:, :, None], columns[:, None]].mean(axis=-1) for values in (one, other)]
    means = one.mean(axis=1), other.mean(axis=1)
    found = {}
    for name, measure in (("pearson", pearson), ("spearman", spearman)):
        spread = measure(*drawn)
        low, high = np.nanpercentile(spread, (2.5, 97.5))
        found[name] = Estimate(float(measure(*means)), float(low), float(high))
    return found


def _too_little(one: Floats, other: Floats) -> str:
    policies, episodes = one.shape
    if policies < MIN_POLICIES:
        return f"{policies} of the {MIN_POLICIES} policies that it takes"
    if episodes < MIN_EPISODES:
        return f"{episodes} of the {MIN_EPISODES} episodes that it takes"
    for values, where in ((one, "the simulator"), (other, "the model")):
        if np.ptp(values.mean(axis=1)) < 1e-12:
            return f"all policies are alike in {where}"
    return ""


def accuracy(true: Bools, judged: Bools, seed: int = 0) -> Accuracy:
    """Return how often judgements (N,) are right; `seed` is that of the resamples."""
    right = [(judged == true)[true == label].astype(np.float64) for label in (True, False)]
    counts = float((judged == true).mean()), true.size, int(true.sum())
    if not all(map(len, right)):
        return Accuracy(None, None, None, *counts)
    rng = np.random.default_rng(seed)
    drawn = [part[rng.integers(len(part), size=(RESAMPLES, len(part)))].mean(axis=1) for part in right]
    low, high = np.percentile((drawn[0] + drawn[1]) / 2, (2.5, 97.5))
    return Accuracy(float(np.mean([part.mean() for part in right])), float(low), float(high), *counts)


def mean_interval(values: Floats, seed: int = 0) -> tuple[float, float]:
    """Return the interval of the mean of values (N,)."""
    chosen = np.random.default_rng(seed).integers(len(values), size=(RESAMPLES, len(values)))
    low, high = np.percentile(values[chosen].mean(axis=1), (2.5, 97.5))
    return float(low), float(high)
