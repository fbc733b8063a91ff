"""The arithmetic of windows against counting them, and against sets that contradict themselves."""

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hma_data.shards.reader import EpisodeIndex
from hma_data.shards.schema import to_numpy
from hma_data.shards.windows import WindowIndex, pieces
from recipes.bench.loader import BENCH, make_set
from tests.data.fresh import run_fresh


def fake(lengths: list[int], stride: int = 1, group: int = 7, shards: int = 1) -> Any:
    """A set of these episodes, in row groups of `group` rows; episodes are dealt out among the shards."""
    shard = np.sort(np.arange(len(lengths)) % shards)
    size = np.array(lengths, np.int64)
    sums = [int(size[shard == i].sum()) for i in range(shards)]
    starts = np.concatenate([np.cumsum(size[shard == i]) - size[shard == i] for i in range(shards)])
    index = EpisodeIndex(np.arange(len(lengths)), shard.astype(np.int64), starts.astype(np.int64), size)
    groups = [tuple(min(group, rows - at) for at in range(0, rows, group)) for rows in sums]
    return SimpleNamespace(
        folder="a set",
        row_stride=stride,
        manifest=SimpleNamespace(frame_stride=1),
        row_groups=lambda split: groups,
        index=lambda split: index,
    )


LENGTHS = st.lists(st.integers(1, 30), min_size=1, max_size=20)


@given(LENGTHS, st.integers(1, 6), st.integers(1, 3), st.integers(1, 3))
def test_window_arithmetic_equals_counting(lengths: list[int], frames: int, stride: int, shards: int) -> None:
    index, starts, row = WindowIndex.of(fake(lengths, stride, shards=shards), "train", frames), [], 0
    for length in lengths:
        starts += list(range(row, row + max(0, length - index.span + 1)))
        row += length
    assert index.count == len(starts)
    np.testing.assert_array_equal(index.first_rows(np.arange(len(starts))), starts)
    np.testing.assert_array_equal(index.unit_first, [sum(s < edge for s in starts) for edge in index.edges])


def test_a_pause_as_long_as_a_step_divides_an_episode_into_pieces() -> None:
    made = fake([20, 6, 30])
    pauses = np.array([[2, 9, 3], [0, 4, 2], [2, 12, 40], [2, 29, 9]])  # entry, row before, recorded steps
    index = replace(made.index("train"), pauses=pauses)
    made.index = lambda split: index
    for stride, parts in ((2, [5, 15, 6, 10, 3, 17]), (3, [20, 6, 10, 3, 17]), (9, [20, 6, 13, 17])):
        starts = np.cumsum([0, *parts])
        for frames in (1, 2, 3):
            span, first, last = frames * stride, [], []
            for begin, length in zip(starts, parts):
                found = [*range(begin, begin + max(0, length - span + 1))]
                found += [begin] if not found and length > stride else []
                first, last = first + found, last + [begin + length - 1] * len(found)
            windows = WindowIndex.of(made, "train", frames, stride, "pad")
            every = np.arange(windows.count)
            assert windows.first_rows(every).tolist() == first and windows.last_rows(every).tolist() == last


@given(LENGTHS, st.integers(1, 4), st.integers(1, 3), st.data())
def test_the_pieces_of_one_episode_are_those_of_the_window_index(lengths, stride, frame_stride, data) -> None:
    rates = st.dictionaries(st.integers(0, 95), st.integers(1, 9), max_size=4)
    paused = [data.draw(rates) for _ in lengths]
    made = fake(lengths)
    made.manifest.frame_stride = frame_stride
    found = [
        (entry, frame // frame_stride, steps)
        for entry, pauses in enumerate(paused)
        for frame, steps in pauses.items()
    ]
    index = replace(made.index("train"), pauses=np.array(found, np.int64).reshape(-1, 3))
    made.index = lambda split: index
    windows, first = WindowIndex.of(made, "train", 1, stride), []
    for begin, length, pauses in zip(np.cumsum([0, *lengths]), lengths, paused, strict=False):
        for part in pieces(pauses, length, stride * frame_stride, frame_stride):
            first += [begin + at for at in part[: len(part) - stride + 1]] if len(part) >= stride else []
    assert windows.first_rows(np.arange(windows.count)).tolist() == first


@given(LENGTHS, st.integers(1, 6), st.integers(1, 3))
def test_a_row_group_reaches_as_far_as_its_windows_and_no_further(lengths, frames, stride) -> None:
    index = WindowIndex.of(fake(lengths, stride), "train", frames)
    for group in index.units():
        last = index.first_rows(np.array([index.unit_first[group + 1] - 1]))[0] + index.span - 1
        reach = index.reach(int(group))
        assert index.edges[reach] <= last < index.edges[reach + 1]


@given(LENGTHS, st.integers(2, 6), st.integers(1, 3))
def test_a_padded_episode_gives_one_window_from_its_first_row(lengths, frames, stride) -> None:
    index = WindowIndex.of(fake(lengths, stride), "train", frames, short="pad")
    ends = np.cumsum(lengths)
    expected = []
    for end, length in zip(ends, lengths, strict=True):
        first = int(end - length)
        whole = max(0, length - frames * stride + 1)
        expected += [(first + i, end - 1) for i in range(whole or (length > stride))]
    every = np.arange(index.count)
    rows = zip(index.first_rows(every).tolist(), index.last_rows(every).tolist(), strict=True)
    assert list(rows) == expected
    assert index.short_episodes == sum(n < frames * stride and n <= stride for n in lengths)
    assert index.padded_episodes == sum(stride < n < frames * stride for n in lengths)


def test_a_split_without_shards_has_no_windows() -> None:
    empty = np.zeros(0, np.int64)
    nothing = fake([5])
    nothing.row_groups, nothing.index = (
        lambda split: [],
        lambda split: EpisodeIndex(empty, empty, empty, empty),
    )
    index = WindowIndex.of(nothing, "val", 4)
    assert index.count == 0 and len(index.units()) == 0


# -- columns as numpy, against pyarrow's own conversion


COLUMNS = [
    *(
        pa.array(np.arange(23), kind)
        for kind in (pa.uint8(), pa.uint16(), pa.uint32(), pa.int32(), pa.int64())
    ),
    *(pa.array(np.linspace(-2, 2, 23).astype(kind)) for kind in (np.float16, np.float32, np.float64)),
    pa.array([i % 3 == 0 for i in range(23)]),
    pa.array([f"camera {i}" for i in range(23)]),
    pa.FixedSizeListArray.from_arrays(pa.array(np.arange(46, dtype=np.float32)), 2),
]


@pytest.mark.parametrize("column", COLUMNS, ids=lambda column: str(column.type)[:12])
@pytest.mark.parametrize("part", [slice(None), slice(5, 19), slice(7, 7)], ids=["all", "part", "none"])
def test_a_column_is_as_pyarrow_gives_it(column: pa.Array, part: slice) -> None:
    array = column[part]
    found = to_numpy(pa.chunked_array([array[:3], array[3:]]))
    wanted = np.array(array.to_pylist(), found.dtype)
    assert len(found) == len(array)
    np.testing.assert_array_equal(found, wanted.reshape(found.shape))


@pytest.mark.slow
def test_windows_are_read_without_pandas(tmp_path: Path) -> None:
    make_set(tmp_path / "set", 0, BENCH.defaults | {"frames": 300})
    code = (
        "import sys; from hma_data.loading.dataset import MixtureDataset; "
        f"next(iter(MixtureDataset([{str(tmp_path / 'set')!r}], 4, 6))); "
        "assert 'pandas' not in sys.modules"
    )
    run_fresh(code)
