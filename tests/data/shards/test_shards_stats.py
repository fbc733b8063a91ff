"""Statistics equal numpy's on the whole, however the rows were split, also for inputs meant to break them."""

import base64
import json
import zlib
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hma_data.shards.stats import QUANTILES, Stats

RNG = np.random.default_rng(0)
N = 100_000
INPUTS: dict[str, Callable[[], Any]] = {
    "ascending": lambda: np.arange(N),
    "descending": lambda: -np.arange(N),
    "two values": lambda: RNG.integers(0, 2, N),
    "constant": lambda: np.full(N, 0.1),
    "heavy-tailed": lambda: RNG.standard_cauchy(N),
    "lognormal": lambda: np.exp(RNG.normal(0, 8, N)),
    "sawtooth": lambda: np.arange(N) % 257,
    "1e38": lambda: RNG.choice([-1e38, 1e38], N),
    "tiny": lambda: RNG.normal(0, 1e-38, N),
    "far from zero": lambda: 1e6 + RNG.normal(0, 1e-1, N),
    "outlier first": lambda: np.concatenate([[3e38], RNG.normal(size=N - 1)]),
}


def merged(rows: np.ndarray, size: int) -> Stats:
    stats = Stats.empty(rows.shape[1])
    for start in range(0, len(rows), size):
        stats.merge(Stats.of(rows[start : start + size]))
    return stats


def rank_error(rows: np.ndarray, stats: Stats) -> float:
    """Return how far, as a share of the rows, each stated quantile's ranks are from q; ties span ranks."""
    worst = 0.0
    for q in QUANTILES:
        value = stats.quantile(q)[0]
        below, upto = (rows[:, 0] < value).mean(), (rows[:, 0] <= value).mean()
        worst = max(worst, below - q, q - upto)
    return worst


@given(st.lists(st.integers(1, 400), min_size=1, max_size=12), st.integers(0, 2**31))
def test_merged_parts_equal_the_whole(sizes: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = (rng.normal(size=(sum(sizes), 3)) * [1, 1e-3, 1e4] + [0, 1e3, -5]).astype(np.float32)
    found = Stats.empty(3)
    for part in np.split(rows, np.cumsum(sizes)[:-1]):
        found.merge(Stats.of(part))
    exact = rows.astype(np.float64)
    assert found.count == len(rows)
    np.testing.assert_allclose(found.mean, exact.mean(0), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(found.std, exact.std(0), rtol=1e-7, atol=1e-9)
    np.testing.assert_array_equal(found.min, exact.min(0))
    np.testing.assert_array_equal(found.max, exact.max(0))


def test_quantiles_are_exact_while_few_rows() -> None:
    rows = np.random.default_rng(0).permutation(101).astype(np.float32)[:, None]
    assert Stats.of(rows).quantile(0.5)[0] == 50


@pytest.mark.parametrize("size", [50, 5000])
@pytest.mark.parametrize("name", INPUTS)
def test_hostile_inputs(name: str, size: int) -> None:
    rows = np.asarray(INPUTS[name](), np.float32)[:, None]
    stats, exact = merged(rows, size), rows.astype(np.float64)
    scale = np.abs(exact).max()
    assert np.isfinite([stats.mean, stats.std, stats.min, stats.max]).all()
    assert abs(stats.mean[0] - exact.mean()) <= 1e-12 * scale
    assert abs(stats.std[0] - exact.std()) <= 1e-9 * scale
    assert (stats.min[0], stats.max[0]) == (exact.min(), exact.max())
    assert rank_error(rows, stats) <= np.log2(N / 256) / 512  # stated
    assert rank_error(rows, stats) <= 0.005  # as docs/format.md says of these
    values = [value[0] for value in stats.summary()["quantiles"].values()]
    assert values == sorted(values)


def test_the_same_order_gives_the_same_bytes_and_json_gives_them_back() -> None:
    rows = RNG.normal(size=(5000, 3)).astype(np.float32)
    stats = merged(rows, 77)
    assert stats.to_json() == merged(rows, 77).to_json()
    again = Stats.from_json(json.loads(json.dumps(stats.to_json())))
    assert again.to_json() == stats.to_json() and again.summary() == stats.summary()


@given(
    st.lists(st.integers(0, 600), min_size=1, max_size=8),
    st.floats(-(2.0**126), 2.0**126, width=32, allow_subnormal=False),
)
def test_a_constant_stays_exact_however_it_is_merged(sizes: list[int], value: float) -> None:
    stats = Stats.empty(1)
    for size in sizes:
        stats.merge(Stats.of(np.full((size, 1), value, np.float32)))
    if stats.count:
        assert stats.mean[0] == np.float32(value)
        assert stats.std[0] == 0
        assert set(np.ravel(list(stats.summary()["quantiles"].values()))) == {np.float64(np.float32(value))}


def test_statistics_of_no_rows_are_zeros_and_change_nothing() -> None:
    nothing = Stats.of(np.zeros((0, 3), np.float32))
    assert Stats.empty(3).merge(nothing).count == 0
    for stats in (nothing, Stats.empty(3), Stats.from_json(json.loads(json.dumps(nothing.to_json())))):
        said = stats.summary()
        assert said["count"] == 0 and said["quantiles"]["q50"] == [0.0] * 3
        assert all(said[name] == [0.0] * 3 for name in ("mean", "std", "min", "max"))
    rows = np.random.default_rng(3).normal(size=(70, 3))
    alone = Stats.of(rows).summary()
    assert Stats.empty(3).merge(Stats.of(rows)).merge(nothing).summary() == alone


@pytest.mark.parametrize("sketch", [*(zlib.compress(bytes(size)) for size in (0, 5, 10**7)), b"not zlib"])
def test_a_sketch_that_is_damaged_is_refused(sketch: bytes) -> None:
    values = Stats.of(RNG.normal(size=(10, 2))).to_json()
    values["sketch"]["values"] = base64.b64encode(sketch).decode()
    with pytest.raises(ValueError, match="sketch"):
        Stats.from_json(values)
