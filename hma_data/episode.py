"""What every source yields, and what it becomes on the embodiment's clock.

An Episode is lazy: it knows its times and values, and decodes a picture when asked for it.
T frames, A values a sample; times are float64 seconds, pictures uint8 RGB.
"""

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hma_data.errors import EpisodeError

Floats = NDArray[np.float64]


class Stream(Protocol):
    """A camera of one episode."""

    timestamps: Floats  # (T,) seconds

    def frames(self, indices: Sequence[int] | NDArray[np.int64]) -> NDArray[np.uint8]:
        """Pictures (n, H, W, 3) RGB of those indices, decoding only them."""
        ...


@dataclass(frozen=True)
class Signal:
    """Numbers over time: an action or a state vector.

    Attributes:
        timestamps: (T,) seconds.
        values: (T, A) float32, in the order of the embodiment's components, sign and offset applied.
    """

    timestamps: Floats
    values: NDArray[np.float32]

    def __post_init__(self) -> None:
        if self.values.ndim != 2 or len(self.timestamps) != len(self.values):
            raise ValueError(f"{len(self.timestamps)} times for values {self.values.shape}")


@dataclass(frozen=True)
class Episode:
    """One recorded run of a robot.

    Attributes:
        id: unique and stable within its source.
        streams: camera name of the embodiment -> Stream.
        actions, states: whole vectors, or one Signal a component, in order, where components tick apart.
        rate_stamped: True where all streams share one index (RLDS, HDF5, LeRobot): nothing needs aligning.
        instruction: what was asked, empty when nothing was.
        success: None when the recording does not say.
        source: the file or URI it comes from.
        metadata: plain values worth keeping.
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
        trimmed: frames left out at both ends, where not every stream was running.
    """

    episode: Episode
    timestamps: Floats
    actions: NDArray[np.float32]
    states: NDArray[np.float32] | None
    frame_indices: dict[str, NDArray[np.int64]]
    skew_ms: dict[str, Floats]
    trimmed: int = 0

    def __len__(self) -> int:
        return len(self.timestamps)

    def frames_at(self, camera: str, grid: NDArray[np.int64]) -> NDArray[np.uint8]:
        """Pictures (n, H, W, 3) of those grid frames."""
        return self.episode.streams[camera].frames(self.frame_indices[camera][grid])


class Pictures:
    """A Stream over pictures that are decoded one by one.

    Args:
        timestamps: (T,) seconds.
        decode: index -> (H, W, 3) uint8 RGB.
    """

    def __init__(self, timestamps: Floats, decode: "Decode") -> None:
        self.timestamps = timestamps
        self._decode = decode

    def frames(self, indices: Sequence[int] | NDArray[np.int64]) -> NDArray[np.uint8]:
        """See Stream."""
        pictures = [self._decode(int(i)) for i in indices]
        shapes = {picture.shape for picture in pictures}
        if len(shapes) > 1:
            raise EpisodeError("", f"pictures change size within the episode: {sorted(shapes)}")
        return np.stack(pictures) if pictures else np.zeros((0, 1, 1, 3), np.uint8)


class Decode(Protocol):
    """Decodes one picture."""

    def __call__(self, index: int, /) -> NDArray[np.uint8]: ...


def rate_times(length: int, hz: float) -> Floats:
    """(length,) seconds of frames that tick at a fixed rate."""
    return np.arange(length, dtype=np.float64) / hz
