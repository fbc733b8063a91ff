"""Define the Episode that every source yields, and the Clip it becomes on the embodiment's grid.

An Episode is lazy: it knows its times and values, and decodes a picture only when it is requested.
T frames, A values a sample; times are float64 seconds, pictures uint8 RGB.
"""

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any, Protocol, runtime_checkable

import numpy as np

from hma_data.arrays import Bools, Float32s, Floats, Images, Indices, Ints
from hma_data.errors import EpisodeError

Known = Bools | None
Decode = Callable[..., Images]  # index -> (H, W, 3) RGB


class Stream(Protocol):
    """A camera of one episode."""

    timestamps: Floats  # (T,) seconds

    def frames(self, indices: Indices) -> Images:
        """Return the pictures (n, H, W, 3) RGB of those indices; decode no others."""


@runtime_checkable
class OneByOne(Protocol):
    """A Stream that can give its pictures one by one, so that large ones are not in memory together.

    A class that inherits it has `Stream.frames` by its `each`.
    """

    def each(self, indices: Indices, least: int = 0) -> Iterator[Images]:
        """Yield (H, W, 3) RGB of each of those indices in order; each is valid until the next request.

        With `least`, JPEG is decoded at a reduced size, as `hma_data.episodes.images.decode_image` does.
        """

    def frames(self, indices: Indices) -> Images:
        """Return pictures by index; see Stream."""
        return all_of(self, indices)


@dataclass(frozen=True)
class Signal:
    """Actions or states at times of their own: all components, or one of them.

    Attributes:
        timestamps: (T,) seconds.
        values: (T, A) float32, in the order of the embodiment's components, sign and offset applied.
        known: (T,) bool, False where the recording has no value; None where it has all values.
    """

    timestamps: Floats
    values: Float32s
    known: Known = None

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or len(self.timestamps) != len(self.values):
            raise ValueError(f"values have the shape {self.values.shape} for {len(self.timestamps)} times")


@dataclass(frozen=True)
class Episode:
    """One recorded run of a robot.

    Attributes:
        id: unique and stable within its source.
        streams: camera name of the embodiment -> Stream.
        actions, states: one Signal with the whole vector; or one Signal per component, in order, where the
            components have different times.
        rate_stamped: True where all streams share one index (RLDS, HDF5, LeRobot) and need no alignment.
        instruction: the instruction in words; empty when there is none.
        success: None when the recording does not say.
        source: the file or URI it comes from.
        metadata: `flags`, name -> count, are written to episodes.parquet and added up in the summary of a
            conversion; `language`, what is said in words about moments of the episode, is written there too,
            see `hma_data.sources.lerobot.language`.
    """

    id: str
    streams: dict[str, Stream]
    actions: tuple[Signal, ...]
    states: tuple[Signal, ...] = ()
    rate_stamped: bool = True
    instruction: str = ""
    success: bool | None = None
    source: str = ""
    metadata: dict[str, Any] = field(default_factory=dict)


@dataclass(frozen=True)
class Clip:
    """An Episode on the embodiment's grid of T frames.

    `actions[t]` is the command issued at frame t.

    Attributes:
        timestamps: (T,) seconds from the first frame.
        actions: (T, A) float32.
        states: (T, A') float32, or None.
        frame_indices: camera -> (T,) index into its stream.
        skew_ms: stream -> (T,) milliseconds by which it was moved onto the grid.
        trimmed: number of frames left out at both ends, where not every stream was running.
        repeated: number of frames left out because they have the stamp of the frame before.
        action_known, state_known: (T,) bool, False where there is no value and zeros take its place; None
            where all are known.
    """

    episode: Episode
    timestamps: Floats
    actions: Float32s
    states: Float32s | None
    frame_indices: dict[str, Ints]
    skew_ms: dict[str, Floats]
    trimmed: int = 0
    repeated: int = 0
    action_known: Known = None
    state_known: Known = None

    def __len__(self) -> int:
        return len(self.timestamps)

    @property
    def known_actions(self) -> Float32s:
        """Return the actions (N, A) that are known."""
        return self.actions if self.action_known is None else self.actions[self.action_known]

    @property
    def known_states(self) -> Float32s | None:
        """Return the states (N, A') that are known; None where there are no states."""
        if self.states is None or self.state_known is None:
            return self.states
        return self.states[self.state_known]

    @property
    def flags(self) -> dict[str, int]:
        """Return flag -> count, without zeros: the source's own flags, then masked and repeated frames."""
        found: dict[str, int] = dict(self.episode.metadata.get("flags", {}))
        for name, known in (("masked_actions", self.action_known), ("masked_states", self.state_known)):
            found[name] = 0 if known is None else int((~known).sum())
        found["repeated_frames"] = self.repeated
        return {name: count for name, count in found.items() if count}

    def frames_at(self, camera: str, grid: Ints) -> Images:
        """Return the pictures (n, H, W, 3) of those grid frames."""
        return self.episode.streams[camera].frames(self.frame_indices[camera][grid])


class Pictures(OneByOne):
    """A Stream over pictures that are decoded one by one.

    Args:
        timestamps: (T,) seconds.
        decode: index -> (H, W, 3) uint8 RGB.
        reduces: whether `decode` takes `least` too, as `OneByOne.each` does.
    """

    def __init__(self, timestamps: Floats, decode: Decode, reduces: bool = False) -> None:
        self.timestamps = timestamps
        self._decode, self._reduces = decode, reduces

    def each(self, indices: Indices, least: int = 0) -> Iterator[Images]:
        """Yield pictures one by one; see OneByOne."""
        more = (least,) if self._reduces else ()
        return (self._decode(int(index), *more) for index in indices)


def of_one_size(pictures: Iterable[Images], where: str) -> Iterator[Images]:
    """Yield pictures (H, W, 3); raise EpisodeError at the first whose size differs."""
    first: tuple[int, ...] = ()
    for picture in pictures:
        first = first or picture.shape
        if picture.shape != first:
            sizes = f"{first} and {picture.shape}"
            raise EpisodeError(where, f"images change size within the episode: {sizes}")
        yield picture


def stacked(pictures: Iterable[Images], count: int, where: str = "") -> Images:
    """Return pictures of one size as (count, H, W, 3); only one of them is in memory twice."""
    found: Images = np.zeros((0, 1, 1, 3), np.uint8)
    for i, picture in enumerate(of_one_size(pictures, where)):
        if i == 0:
            found = np.empty((count, *picture.shape), np.uint8)
        found[i] = picture
    return found


def all_of(stream: OneByOne, indices: Indices) -> Images:
    """Return the pictures (n, H, W, 3) of indices in any order; each is decoded once, in rising order."""
    distinct, places = np.unique(np.asarray(indices, np.int64), return_inverse=True)
    found = stacked(stream.each(distinct), len(distinct))
    return found if np.array_equal(places, np.arange(len(found))) else found[places]


def rate_times(length: int, hz: float) -> Floats:
    """Return the times (length,) in seconds of frames that tick at a fixed rate."""
    return np.arange(length, dtype=np.float64) / hz
