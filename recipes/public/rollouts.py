"""Continue recorded episodes in a world model, frame by frame, beside what was recorded.

T frames of a window, S pixels a side, V values of a chunk.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.align import to_clip
from hma_data.episodes.episode import Clip
from hma_data.episodes.images import prepared, resize
from hma_data.errors import UsageError
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import open_source
from hma_model.worlds.world import World

Images = NDArray[np.uint8]


@dataclass(frozen=True)
class Window:
    """Frames of an episode at the model's rate.

    Attributes:
        episode: its number.
        true: (T, S, S, 3), at the size at which they are compared.
        given: (P, S', S', 3), the first ones at the size that the model sees.
        chunks: (T - 1, V), the actions from each frame to the next.
    """

    episode: int
    true: Images
    given: Images
    chunks: NDArray[np.float32]


class Recording:
    """The episodes of a recording, read as a robot's YAML says.

    Attributes:
        ids, lengths: of its episodes, in order; the lengths in recorded frames.
    """

    def __init__(self, place: Path, robot: Embodiment, only: Sequence[str] | None = None) -> None:
        self.place, self.robot = place, robot
        self._source = open_source(robot.source.format)
        refs = self._source.index(place, robot)
        refs = refs if only is None else [ref for ref in refs if ref.id in set(only)]
        self.ids, self.lengths = [ref.id for ref in refs], [ref.frames for ref in refs]
        self.clip = lru_cache(2)(self._clip)

    def _clip(self, number: int) -> Clip:
        return to_clip(self._source.read(self.place, self.ids[number], self.robot), self.robot)

    def window(self, world: World, number: int, start: int, frames: int, context: int, size: int) -> Window:
        """Return `frames` frames of an episode from a recorded one on, `context` of them for the model."""
        clip, stride, camera = self.clip(number), self.robot.stride, self.robot.primary_camera
        at = start + stride * np.arange(frames)
        if at[-1] >= len(clip):
            said = f"has {len(clip)} frames, {at[-1] + 1} are needed"
            raise UsageError(f"{self.place}: {self.ids[number]}", said, "give fewer frames")
        stream, rows = clip.episode.streams[camera.name], clip.frame_indices[camera.name][at]
        spec = world.tokenizer.spec
        given = prepared(stream, rows[:context], camera, spec.image_size, spec.resize_filter)
        spans = at[:-1, None] + np.arange(stride)
        chunks = clip.actions[spans].reshape(frames - 1, -1)
        return Window(number, prepared(stream, rows, camera, size, "linear"), given, chunks)


def continued(world: World, robot: str, windows: Sequence[Window], seed: int = 0) -> Iterator[Images]:
    """Yield for each window its frames (T, S, S, 3) as the model continues them; the given ones come first.

    The windows are of one length, and advance together.
    """
    if world.model.config.views != 1:
        raise UsageError("model", f"shows {world.model.config.views} cameras", "give a model of one camera")
    sessions = [
        world.open(robot, one.given, one.chunks[: len(one.given) - 1], seed=seed + number)
        for number, one in enumerate(windows)
    ]
    made: list[list[Images]] = [list(one.given) for one in windows]
    for step in range(len(windows[0].given) - 1, len(windows[0].chunks)):
        chunks = {session: one.chunks[step] for session, one in zip(sessions, windows)}
        images = world.step(chunks)
        for frames, session in zip(made, sessions):
            frames.append(images[session])
    for session, frames, one in zip(sessions, made, windows):
        world.close(session)
        yield resize(np.stack(frames), one.true.shape[1])
