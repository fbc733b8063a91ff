"""Tokenize the frames of many episodes in full batches, and return the tokens of each episode.

n frames of a camera, S×S pixels.
"""

from collections import defaultdict, deque
from collections.abc import Callable
from typing import Any

import numpy as np
from numpy.typing import NDArray

Frames = NDArray[np.uint8]


class Batches:
    """A queue of frames for `encode`, which gets `size` frames at a time whatever the episodes' lengths.

    Args:
        encode: frames (n, S, S, 3) -> tokens (n, …); a frame's tokens do not depend on the other frames.
        size: frames a call; only `flush` makes a smaller call.
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
        """Queue the next frames of an episode's camera; return how many frames were encoded by this call."""
        self._queue.append((episode, camera, frames))
        self._queued += len(frames)
        self._waiting[episode] += len(frames)
        encoded = 0
        while self._queued >= self._size:
            encoded += self._next(self._size)
        return encoded

    def flush(self) -> int:
        """Encode the frames that are left; return their number."""
        return self._next(self._queued) if self._queued else 0

    def drop(self, episode: int) -> None:
        """Forget an episode."""
        self._queue = deque(item for item in self._queue if item[0] != episode)
        self._queued -= self._waiting.pop(episode, 0)
        self._tokens.pop(episode, None)

    def whole(self, episode: int) -> bool:
        """Check whether all frames added for an episode are encoded."""
        return not self._waiting[episode]

    def take(self, episode: int) -> dict[str, NDArray[Any]]:
        """Return camera -> tokens of a whole episode, and forget the episode."""
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
