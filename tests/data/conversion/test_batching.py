"""Full batches across episodes: every frame comes back to its own episode, in its place."""

from types import SimpleNamespace
from typing import Any

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from hma_data.conversion.worker import Batches


def frames(episode: int, start: int, count: int) -> NDArray[np.uint8]:
    values = np.zeros((count, 2, 2, 3), np.uint8)
    values[..., 0] = episode
    values[..., 1] = np.arange(start, start + count)[:, None, None]
    return values


@given(
    st.lists(st.lists(st.integers(1, 9), min_size=1, max_size=4), min_size=1, max_size=8),
    st.integers(1, 7),
    st.sets(st.integers(0, 7)),
)
def test_batches_are_full_and_tokens_come_back_to_their_frames(pieces, size, dropped) -> None:
    seen: list[int] = []

    def encode(batch: NDArray[np.uint8]) -> NDArray[Any]:
        seen.append(len(batch))
        return batch[:, 0, 0, :2].astype(np.uint32)

    batches = Batches(encode, size)
    episodes = [SimpleNamespace(waiting=0, tokens={"front": []}) for _ in pieces]
    added = encoded = 0
    for number, (episode, counts) in enumerate(zip(episodes, pieces)):
        at = 0
        for count in counts:
            encoded += batches.add(episode, "front", frames(number, at, count))
            at += count
        added += at
        if number in dropped:
            batches.drop(episode)
    assert all(count == size for count in seen)
    encoded += batches.flush()
    assert all(count == size for count in seen[:-1])
    for number, (episode, counts) in enumerate(zip(episodes, pieces)):
        if number in dropped:
            continue
        assert not episode.waiting
        tokens = np.concatenate(episode.tokens["front"])
        np.testing.assert_array_equal(tokens[:, 0], number)
        np.testing.assert_array_equal(tokens[:, 1], np.arange(sum(counts)))
    if not dropped:
        assert encoded == added
