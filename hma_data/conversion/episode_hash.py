"""Hash the content of an episode before it is tokenized.

A file that holds several episodes changes when one is added. That does not tell whether the other episodes
changed; the hash of each episode does. It covers all numbers, times and texts, and three pictures a camera.
"""

import hashlib
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.align import to_clip
from hma_data.episodes.episode import Clip
from hma_data.episodes.images import prepared
from hma_data.errors import EpisodeError
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import Source
from hma_data.tokenizers.base import TokenizerSpec


class Content:
    """The hash of an episode; the caller adds pictures camera after camera, in their order.

    Args:
        kept: (N,) frames of the clip that become rows of a camera.
    """

    def __init__(self, clip: Clip, kept: NDArray[np.int64]) -> None:
        self._digest = hashlib.sha256(f"{clip.episode.instruction}\n{clip.episode.success}".encode())
        for numbers in (clip.timestamps, clip.actions, clip.states, clip.action_known, clip.state_known):
            self._add(numbers)
        self._looked_at = looked_at(len(kept))

    def add(self, start: int, frames: NDArray[np.uint8]) -> None:
        """Add the next pictures (n, H, W, 3) of a camera; the first of them is its row `start`."""
        for row in self._looked_at:
            if start <= row < start + len(frames):
                self._add(frames[row - start])

    def text(self) -> str:
        """Return the hash as sixteen hex digits."""
        return self._digest.hexdigest()[:16]

    def _add(self, numbers: NDArray[Any] | None) -> None:
        if numbers is None:
            self._digest.update(b"none")
        else:
            self._digest.update(f"{numbers.dtype} {numbers.shape}".encode())
            self._digest.update(np.ascontiguousarray(numbers).data)


def looked_at(rows: int) -> list[int]:
    """Return the rows of a camera whose pictures are hashed: the first, the middle and the last."""
    return sorted({0, rows // 2, rows - 1}) if rows else []


def rows_kept(clip: Clip, embodiment: Embodiment, frames: str) -> NDArray[np.int64]:
    """Return the frames (N,) of the clip that become rows of a camera.

    Args:
        frames: "all" or "strided", as in the plan.

    Raises:
        EpisodeError: the clip is shorter than a stride.
    """
    stride = embodiment.stride if frames == "strided" else 1
    if len(clip) < stride:
        raise EpisodeError(clip.episode.id, f"has {len(clip)} frames, fewer than one stride of {stride}")
    return np.arange(0, len(clip) // stride * stride, stride)


def content_of(
    source: Source, uri: str, episode_id: str, embodiment: Embodiment, facts: dict[str, Any]
) -> str:
    """Return the hash of an episode as it is recorded now; see `Content`.

    Args:
        facts: of the plan: which cameras and frames, and the tokenizer's spec.

    Raises:
        EpisodeError: the episode cannot be read any more.
    """
    spec = TokenizerSpec.from_json(facts["tokenizer"])
    clip = to_clip(source.read(uri, episode_id, embodiment), embodiment)
    kept = rows_kept(clip, embodiment, facts["frames"])
    content = Content(clip, kept)
    for name in facts["cameras"]:
        for row in looked_at(len(kept)):
            indices = clip.frame_indices[name][kept[row : row + 1]]
            camera, stream = embodiment.camera(name), clip.episode.streams[name]
            content.add(row, prepared(stream, indices, camera, spec.image_size, spec.resize_filter))
    return content.text()
