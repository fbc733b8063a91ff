"""Frames of many episodes through a tokenizer in full batches; tokens come back episode by episode.

n frames of a camera, S×S pixels.
"""

from collections import defaultdict, deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Frames = NDArray[np.uint8]


class Batches:
    """A queue of frames before `encode`, which sees `size` at a time whatever the episodes' lengths.

    Args:
        encode: frames (n, S, S, 3) -> tokens (n, …); the same for a frame whatever its neighbours.
        size: frames a call; only `flush` makes a smaller one.
    """

    def __init__(self, encode: Callable[[Frames], NDArray[Any]], size: int) -> None:
        self._encode, self._size = encode, size
        self._queue: deque[tuple[int, str, Frames]] = deque()
        self._queued = 0
        self._waiting: defaultdict[int, int] = defaultdict(int)
        self._tokens: defaultdict[int, defaultdict[str, list[NDArray[Any]]]] = defaultdict(
            lambda: defaultdict(list)
        )

    def add(self, episode: int, camera: str, frames: Frames) -> int:
        """Frames of an episode's camera, after those before; how many left the queue for it."""
        self._queue.append((episode, camera, frames))
        self._queued += len(frames)
        self._waiting[episode] += len(frames)
        encoded = 0
        while self._queued >= self._size:
            encoded += self._next(self._size)
        return encoded

    def flush(self) -> int:
        """Encode what is left; how many frames that were."""
        return self._next(self._queued) if self._queued else 0

    def drop(self, episode: int) -> None:
        """Forget an episode."""
        self._queue = deque(item for item in self._queue if item[0] != episode)
        self._queued -= self._waiting.pop(episode, 0)
        self._tokens.pop(episode, None)

    def whole(self, episode: int) -> bool:
        """Whether all frames it was given are encoded."""
        return not self._waiting[episode]

    def take(self, episode: int) -> dict[str, NDArray[Any]]:
        """Camera -> tokens of a whole episode, which is forgotten."""
        self._waiting.pop(episode, None)
        return {camera: np.concatenate(parts) for camera, parts in self._tokens.pop(episode).items()}

    def _next(self, count: int) -> int:
        owners: list[tuple[int, str, int]] = []
        pieces: list[Frames] = []
        left = count
        while left:
            episode, camera, frames = self._queue.popleft()
            if len(frames) > left:
                self._queue.appendleft((episode, camera, frames[left:]))
                frames = frames[:left]
            owners.append((episode, camera, len(frames)))
            pieces.append(frames)
            left -= len(frames)
        tokens = self._encode(pieces[0] if len(pieces) == 1 else np.concatenate(pieces))
        self._queued -= count
        at = 0
        for episode, camera, length in owners:
            self._tokens[episode][camera].append(tokens[at : at + length])
            self._waiting[episode] -= length
            at += length
        return count
