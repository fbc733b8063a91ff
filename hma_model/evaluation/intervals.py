"""Give means their uncertainty: 95 % intervals by bootstrap, over windows and over datasets.

A mean over windows is resampled 1,000 times from the windows (Efron 1979); the interval holds the middle 95 %
of the means. Windows of one episode resemble each other, so the intervals are a little narrow.

N windows, R resamples.
"""

from collections.abc import Sequence
from functools import lru_cache
from typing import Any

import numpy as np
from numpy.typing import NDArray

Floats = NDArray[np.float64]
RESAMPLES, LEVELS = 1000, (2.5, 97.5)


def resampled_means(values: NDArray[Any], seed: int = 0) -> Floats:
    """Return means (R, …) of resamples of values (N, …)."""
    flat = values.reshape(len(values), -1).astype(np.float64)
    means: Floats = (_shares(len(values), seed) @ flat).reshape(RESAMPLES, *values.shape[1:])
    return means


@lru_cache(maxsize=8)
def _shares(count: int, seed: int) -> Floats:
    """Return the share (R, N) that each of N values has in each resample."""
    chosen = np.random.default_rng(seed).integers(count, size=(RESAMPLES, count))
    cells = chosen + count * np.arange(RESAMPLES)[:, None]
    return np.bincount(cells.ravel(), minlength=RESAMPLES * count).reshape(RESAMPLES, count) / count


def interval(values: NDArray[Any], seed: int = 0) -> Floats:
    """Return the ends (2, …) of the 95 % interval of the mean of values (N, …)."""
    return np.percentile(resampled_means(values, seed), LEVELS, axis=0)


def rounded(values: Any, digits: int = 4) -> Any:
    """Return a number or an array as plain rounded values, with None for those that are not finite."""
    if isinstance(values, np.ndarray) and values.ndim:
        return [rounded(value, digits) for value in values]
    return round(float(values), digits) if np.isfinite(values) else None


def summary(name: str, values: NDArray[Any], seed: int = 0, digits: int = 4) -> dict[str, Any]:
    """Return the mean of values (N,) as `name`, its interval as `name_95`; None if a value is not finite."""
    mean = rounded(values.mean(), digits) if np.isfinite(values).all() else None
    return {name: mean, f"{name}_95": None if mean is None else rounded(interval(values, seed), digits)}


def over_datasets(sets: Sequence[NDArray[Any]], seed: int = 0) -> tuple[float, list[float]]:
    """Return the mean over datasets of their means of values (N,), and its interval.

    Each dataset counts once; windows are resampled within theirs. Values that are not finite are left out.
    """
    sets = [values[np.isfinite(values)] for values in sets]
    means = [resampled_means(values, seed + number) for number, values in enumerate(sets)]
    low, high = np.percentile(np.mean(means, axis=0), LEVELS)
    return float(np.mean([values.mean() for values in sets])), [float(low), float(high)]
