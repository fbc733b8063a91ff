"""Shuffling in pools: every window once, each reader its share, neighbours in time far apart."""

from pathlib import Path

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hma_data.loading.pools import LARGEST_POOL, UnitAssignment, WindowSequence, pool_size, spread
from hma_data.loading.rows import MIB, RowDecoder
from hma_data.shards import writer
from hma_data.shards.reader import ShardSet
from hma_data.shards.windows import WindowIndex
from recipes.bench.loader import BENCH, make_set
from tests.data.shards.test_windows import fake

SMALL = BENCH.defaults | {
    "frames": 6_000,
    "shard_frames": 1_500,
    "episode": 60,
    "grid": [2, 2],
    "stride": 2,
    "action_dims": 2,
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(writer, "ROW_GROUP", 300)
        return make_set(tmp_path_factory.mktemp("pools") / "set", 0, SMALL)


@pytest.fixture(scope="module")
def decoder(made: Path) -> RowDecoder:
    return RowDecoder(ShardSet(made), "train", 6)


def rows_of(stream: WindowSequence, start: int, count: int) -> list[float]:
    """Windows are told apart by their first action: the shards are links, so episodes are not unique."""
    cut = stream.take(start, count)
    return [hash(window.tobytes()) for window in cut["actions"]]


@given(st.lists(st.integers(1, 60), min_size=1, max_size=60), st.integers(1, 24), st.integers(0, 2**31))
def test_windows_that_share_a_row_are_further_apart_than_promised(runs, span, seed) -> None:
    rows = np.concatenate([np.arange(n) + 100 * i for i, n in enumerate(runs)]).astype(np.int64)
    order, apart = spread(rows, span, np.random.default_rng(seed))
    assert sorted(order.tolist()) == list(range(len(rows)))
    mixed = rows[order]
    for shift in range(1, min(apart, len(rows) - 1) + 1):
        assert (np.abs(mixed[shift:] - mixed[:-shift]) >= span).all()


def test_a_pool_of_usual_size_keeps_a_batch_free_of_neighbours() -> None:
    rows = np.concatenate([np.arange(141) + 200 * i for i in range(8 * 10)])
    _, apart = spread(rows, 60, np.random.default_rng(0))
    assert apart >= 60


def test_the_order_of_a_pool_is_as_random_as_a_shuffle_in_place() -> None:
    """Each window is as likely in the first half of the order as in the second."""
    rows = np.arange(200)
    early = np.zeros(200)
    for seed in range(400):
        order, _ = spread(rows, 12, np.random.default_rng(seed))
        early[order[:100]] += 1
    assert abs(early.mean() - 200) < 1e-9
    assert np.abs(early - 200).max() < 60  # six standard deviations of 400 fair draws


@given(st.lists(st.integers(1, 40), min_size=1, max_size=40), st.integers(1, 12), st.integers(1, 3))
def test_every_window_is_dealt_to_one_reader(lengths: list[int], readers: int, frames: int) -> None:
    index = WindowIndex.of(fake(lengths), "train", frames)
    if not index.count:
        return
    deal = UnitAssignment.of(index, readers)
    shares = []
    for reader in range(readers):
        units, sizes = deal.of_reader(reader)
        mine = [
            window
            for group, part in units.tolist()
            for window in range(index.unit_first[group] + part, index.unit_first[group + 1], deal.parts)
        ]
        assert len(mine) == sizes.sum() > 0
        shares.append(mine)
    together = sorted(window for share in shares for window in share)
    if index.count < readers:
        assert all(share == list(range(index.count)) for share in shares)
    else:
        assert together == list(range(index.count))


@pytest.mark.parametrize(("episodes", "readers"), [(500, 256), (500, 8), (3, 4), (40, 64), (2_000, 16)])
def test_readers_get_about_the_same_number_of_windows(episodes: int, readers: int) -> None:
    lengths = np.random.default_rng(0).integers(20, 400, episodes).tolist()
    deal = UnitAssignment.of(WindowIndex.of(fake(lengths, group=256), "train", 12), readers)
    shares = [int(deal.of_reader(reader)[1].sum()) for reader in range(readers)]
    assert max(shares) <= 1.15 * min(shares) + 2


def test_every_reader_gets_a_window_where_one_row_group_has_most_of_them() -> None:
    index = WindowIndex.of(fake(([2] + [1] * 62) * 15 + [64], group=64), "train", 2)
    deal = UnitAssignment.of(index, 32)
    assert all(deal.of_reader(reader)[1].sum() for reader in range(32)) and deal.sizes.sum() == index.count


def test_an_epoch_of_all_readers_is_every_window_once(decoder: RowDecoder) -> None:
    deal = UnitAssignment.of(decoder.index, 3)
    streams = [WindowSequence(decoder, deal, 5, reader, 2) for reader in range(3)]
    first = [window for stream in streams for window in rows_of(stream, 0, stream.length)]
    again = [window for stream in streams for window in rows_of(stream, stream.length, stream.length)]
    assert len(first) == decoder.index.count
    assert sorted(first) == sorted(again) and first != again
    assert len(set(first)) == decoder.index.count // 4  # four links of one shard


def test_the_sequence_does_not_depend_on_how_it_is_taken(decoder: RowDecoder) -> None:
    deal = UnitAssignment.of(decoder.index, 2)
    length = WindowSequence(decoder, deal, 5, 1, 3).length
    whole = rows_of(WindowSequence(decoder, deal, 5, 1, 3), 0, 2 * length + 7)
    stream = WindowSequence(decoder, deal, 5, 1, 3)
    rng = np.random.default_rng(0)
    for start in [0, length - 3, 2 * length, 1, *rng.integers(0, 2 * length, 6).tolist()]:
        assert rows_of(stream, start, 7) == whole[start : start + 7]


def test_a_pool_fits_its_memory(decoder: RowDecoder) -> None:
    assert pool_size(decoder, 0) == 1
    assert pool_size(decoder, 3.5 * decoder.group_bytes) == 3
    assert pool_size(decoder, 1024 * MIB) == LARGEST_POOL


def test_row_groups_that_are_used_again_are_decoded_once(made: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    shards, reads = ShardSet(made), []
    read = shards.read
    monkeypatch.setattr(shards, "read", lambda *a: reads.append(a[:2]) or read(*a))
    stream = WindowSequence(
        kept := RowDecoder(shards, "train", 6, cache_bytes=100 * MIB),
        UnitAssignment.of(kept.index, 1),
        0,
        0,
        4,
    )
    stream.take(0, 3 * stream.length)
    assert len(reads) == len(kept.index.groups)
