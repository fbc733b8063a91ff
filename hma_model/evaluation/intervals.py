"""Give means their uncertainty: 95 % intervals by bootstrap, over windows and over datasets.

A mean over windows is resampled 1,000 times (Efron 1979); the interval holds the middle 95 % of the means.
Windows of one recording resemble each other, so whole recordings are drawn where they are known
(Davison and Hinkley 1997, 3.8). The means of few episodes spread less than they should: their distances from
the mean are stretched by Student's t over the normal distribution's quantile and by √(n / (n − 1)), as in
Hesterberg's expanded percentile interval (2015, 4.3): 9 times for n = 2, 1.2 for 10, 1.02 for 100. Of a
single one there is no interval.

N windows, R resamples, n windows or episodes to draw from.
"""

import math
from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtri, stdtrit  # scipy.stats would take half a second to import

from hma_data.arrays import Floats

Episodes = Sequence[int] | NDArray[Any] | None  # (N,) which windows belong together; None: none do
RESAMPLES, LEVELS = 1000, (2.5, 97.5)
ANY, NATURAL, SHARE = (-math.inf, math.inf), (0.0, math.inf), (0.0, 1.0)  # what values may be


def resampled_means(values: NDArray[Any], seed: int = 0, episodes: Episodes = None) -> Floats:
    """Return stretched means (R, …) of resamples of values (N, …); NaN where there is one to draw from."""
    flat = values.reshape(len(values), -1).astype(np.float64)
    if episodes is None:
        count, shares = len(values), _shares(len(values), seed)
    else:
        names, own = np.unique(np.asarray(episodes), return_inverse=True)
        count = len(names)
        shares = _shares(count, seed)[:, own]
        shares /= shares.sum(axis=1, keepdims=True)  # episodes have unequal numbers of windows
    means = (shares @ flat).reshape(RESAMPLES, *values.shape[1:])
    if count < 2:
        return np.full_like(means, np.nan)
    mean = values.mean(axis=0, dtype=np.float64)
    return mean + _stretch(count) * (means - mean)


@lru_cache(maxsize=64)
def _stretch(count: int) -> float:
    """Return by how much the spread of resampled means is too small for that many to draw from."""
    students_t, normal = stdtrit(count - 1, 0.975), ndtri(0.975)
    return float(students_t / normal) * math.sqrt(count / (count - 1))


@lru_cache(maxsize=8)
def _shares(count: int, seed: int) -> Floats:
    """Return the share (R, N) that each of N values has in each resample."""
    chosen = np.random.default_rng(seed).integers(count, size=(RESAMPLES, count))
    # each resample counts in cells of its own, so that one bincount serves all
    cells = chosen + count * np.arange(RESAMPLES)[:, None]
    return np.bincount(cells.ravel(), minlength=RESAMPLES * count).reshape(RESAMPLES, count) / count


def interval(
    values: NDArray[Any], seed: int = 0, episodes: Episodes = None, within: tuple[float, float] = ANY
) -> Floats:
    """Return the ends (2, …) of the 95 % interval of the mean of values (N, …); NaN of a single one.

    `within` are the least and the largest value that is possible, which few episodes would pass.
    """
    return np.percentile(resampled_means(values, seed, episodes), LEVELS, axis=0).clip(*within)


def rounded(values: Any, digits: int = 4) -> Any:
    """Return a number or an array as plain rounded values, with None for those that are not finite."""
    if isinstance(values, np.ndarray) and values.ndim:
        return [rounded(value, digits) for value in values]
    return round(float(values), digits) if np.isfinite(values) else None


def summary(
    name: str,
    values: NDArray[Any],
    seed: int = 0,
    digits: int = 4,
    episodes: Episodes = None,
    within: tuple[float, float] = ANY,
) -> dict[str, Any]:
    """Return the mean of values (N,) as `name`, and its interval, as of `interval`, as `name_95`.

    Both are None if a value is not finite; the interval also of one window or episode.
    """
    mean = rounded(values.mean(), digits) if np.isfinite(values).all() else None
    ends = None if mean is None else ends_of(interval(values, seed, episodes, within), digits)
    return {name: mean, f"{name}_95": ends}


def horizon_summary(
    name: str,
    values: NDArray[Any],
    seed: int = 0,
    digits: int = 4,
    episodes: Episodes = None,
    within: tuple[float, float] = ANY,
) -> dict[str, Any]:
    """Return the figures of values (N, P) over a horizon of P frames, each with its interval.

    They are `name`, the mean over the horizon, `name_last`, that of its last frame, and `name_by_frame`.
    """
    return {
        **summary(name, values.mean(axis=1), seed, digits, episodes, within),
        **summary(f"{name}_last", values[:, -1], seed, digits, episodes, within),
        f"{name}_by_frame": rounded(values.mean(axis=0)),
        f"{name}_by_frame_95": rounded(interval(values, seed, episodes, within).T),
    }


def ends_of(ends: Floats, digits: int = 4) -> list[float] | None:
    """Return the ends (2,) of an interval as plain values; None where there is none."""
    return rounded(ends, digits) if np.isfinite(ends).all() else None


def over_datasets(
    sets: Sequence[NDArray[Any]],
    episodes: Sequence[NDArray[Any]],
    within: tuple[float, float],
) -> tuple[float, list[float] | None]:
    """Return the mean over datasets of their means of values (N,), and its interval.

    Each dataset counts once; its windows, or episodes, are resampled within it. Values that are not finite
    are left out. There is no interval where a dataset has but one.
    """
    means, resampled = [], []
    for number, (values, own) in enumerate(zip(sets, episodes, strict=True)):
        kept = np.isfinite(values)
        means.append(values[kept].mean())
        resampled.append(resampled_means(values[kept], number, own[kept]))
    low, high = np.percentile(np.mean(resampled, axis=0), LEVELS).clip(*within)
    ends = [float(low), float(high)] if np.isfinite(low) else None
    return float(np.mean(means)), ends
