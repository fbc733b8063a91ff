"""Statistics equal numpy's on the whole, however the rows were split."""

import json

import numpy as np
from hypothesis import given
from hypothesis import strategies as st

from hma_data.shards.stats import Stats


@given(st.lists(st.integers(1, 400), min_size=1, max_size=12), st.integers(0, 2**31))
def test_merged_parts_equal_the_whole(sizes: list[int], seed: int) -> None:
    rng = np.random.default_rng(seed)
    rows = (rng.normal(size=(sum(sizes), 3)) * [1, 1e-3, 1e4] + [0, 1e3, -5]).astype(np.float32)
    merged = Stats.empty(3)
    for part in np.split(rows, np.cumsum(sizes)[:-1]):
        merged.merge(Stats.of(part))
    exact = rows.astype(np.float64)
    assert merged.count == len(rows)
    np.testing.assert_allclose(merged.mean, exact.mean(0), rtol=1e-12, atol=1e-12)
    np.testing.assert_allclose(merged.std, exact.std(0), rtol=1e-7, atol=1e-9)
    np.testing.assert_array_equal(merged.min, exact.min(0))
    np.testing.assert_array_equal(merged.max, exact.max(0))


def test_quantiles_are_exact_while_few_rows() -> None:
    rows = np.random.default_rng(0).permutation(101).astype(np.float32)[:, None]
    assert Stats.of(rows).quantile(0.5)[0] == 50


def test_quantiles_stay_within_the_stated_rank_error() -> None:
    rows = np.random.default_rng(1).exponential(size=(100_000, 2)).astype(np.float32)
    merged = Stats.empty(2)
    for part in np.array_split(rows, 37):
        merged.merge(Stats.of(part))
    bound = np.log2(len(rows) / 256) / 512
    for q in (0.01, 0.1, 0.5, 0.9, 0.99):
        rank = (rows <= merged.quantile(q)).mean(axis=0)
        assert np.abs(rank - q).max() <= bound


def test_mean_of_a_constant_is_exact_over_many_rows() -> None:
    merged = Stats.empty(1)
    block = Stats.of(np.full((2**15, 1), 0.1, np.float32))
    for _ in range(2**10):  # 2^25 rows
        before = merged.count
        merged.merge(Stats(block.count, block.mean, block.m2, block.min, block.max))
        assert merged.count == before + block.count
    assert merged.mean[0] == np.float64(np.float32(0.1))
    assert merged.std[0] == 0


def test_json_gives_the_same_statistics_back() -> None:
    stats = Stats.of(np.random.default_rng(2).normal(size=(3000, 4)))
    again = Stats.from_json(json.loads(json.dumps(stats.to_json())))
    assert again.summary() == stats.summary()


def test_statistics_of_no_rows_are_zeros_and_change_nothing() -> None:
    nothing = Stats.of(np.zeros((0, 3), np.float32))
    assert Stats.empty(3).merge(nothing).count == 0
    for stats in (nothing, Stats.from_json(json.loads(json.dumps(nothing.to_json())))):
        said = stats.summary()
        assert said["count"] == 0 and said["quantiles"]["q50"] == [0.0] * 3
        assert all(said[name] == [0.0] * 3 for name in ("mean", "std", "min", "max"))
    rows = np.random.default_rng(3).normal(size=(70, 3))
    alone = Stats.of(rows).summary()
    assert Stats.empty(3).merge(Stats.of(rows)).merge(nothing).summary() == alone
