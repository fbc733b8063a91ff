"""What one pass over a bag keeps of a topic: times and places, a few bytes a message.

T messages of a topic; times are float64 seconds, the clock of a topic is `header` or `receive`.
"""

import struct
from array import array
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.episode import Floats
from hma_data.errors import EpisodeError
from hma_data.sources.bags.bag import Place
from hma_data.sources.bags.container import Channel, Data
from hma_data.sources.bags.fields import Column
from hma_data.sources.bags.messages import head_stamp, stamp_ns
from hma_data.sources.bags.pictures import VIDEO, payload, picture_kind, video_codec
from hma_data.sources.bags.video import is_keyframe

INT64 = np.iinfo(np.int64)


class Track:
    """One topic over one pass.

    Attributes:
        columns: the components that read this topic; each takes its values as messages are added.
        channels: on which the messages came, usually one.
        codec: of video, empty for anything else.
    """

    def __init__(self, topic: str) -> None:
        self.topic = topic
        self.columns: list[Column] = []
        self.channels: list[Channel] = []
        self.codec = ""
        self._log_ns, self._stamp_ns, self._places = array("q"), array("q"), array("q")
        self._keyframes: list[bool | None] = []

    def __len__(self) -> int:
        return len(self._log_ns)

    def add_head(self, channel: Channel, log_ns: int, place: Place, data: Data) -> None:
        """Takes the next message, of which only the time it carries in its first bytes is wanted.

        Raises:
            EpisodeError: there is none.
        """
        stamp = head_stamp(channel)
        try:
            own_ns = stamp(data) if stamp else 0
        except (struct.error, IndexError) as fault:
            raise EpisodeError(
                self.topic, f"a message is not a {channel.type}: it has {len(data)} bytes"
            ) from fault
        self._take(channel, log_ns, place, own_ns)

    def add(self, channel: Channel, log_ns: int, place: Place, message: Any) -> None:
        """Takes the next message; None for one that could not be decoded keeps its time of receipt."""
        for column in self.columns:
            column.add(message, len(self))
        if message is not None and picture_kind(channel.type) == VIDEO:
            self._keyframes.append(self._is_keyframe(message))
        self._take(channel, log_ns, place, stamp_ns(message))

    def _take(self, channel: Channel, log_ns: int, place: Place, own_ns: int) -> None:
        if channel not in self.channels:
            self.channels.append(channel)
        self._log_ns.append(min(log_ns, INT64.max))
        self._stamp_ns.append(min(max(own_ns, INT64.min), INT64.max))
        self._places.extend((*place, self.channels.index(channel)))

    def _is_keyframe(self, message: Any) -> bool | None:
        try:
            self.codec = self.codec or video_codec(message)
            return is_keyframe(payload(message), self.codec)
        except (KeyError, TypeError, ValueError) as fault:
            raise EpisodeError(self.topic, f"a message is no frame of a video: {fault!r}") from fault

    def order(self, rows: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
        """Order of receipt: of all messages, or of those rows (then an index into `rows`)."""
        received = self.received()
        return np.argsort(received if rows is None else received[rows], kind="stable")

    def received(self) -> NDArray[np.int64]:
        """(T,) nanoseconds of receipt, as the messages lie in the file."""
        return np.frombuffer(self._log_ns, np.int64)

    @property
    def stamped(self) -> bool:
        """Whether every message carries a time of its own, and these are not all one."""
        stamps = np.frombuffer(self._stamp_ns, np.int64)
        return bool(len(stamps) and np.all(stamps)) and not self.frozen

    @property
    def frozen(self) -> bool:
        """Whether the messages' own times never move: such stamps are no clock."""
        stamps = np.frombuffer(self._stamp_ns, np.int64)
        return bool(len(stamps) > 1 and stamps[0] and np.all(stamps == stamps[0]))

    def seconds(self, clock: str) -> Floats:
        """(T,) of the messages as they lie in the file: `header` where they are stamped, else `receive`."""
        stamps = self._stamp_ns if clock == "header" and self.stamped else self._log_ns
        nanoseconds = np.frombuffer(stamps, np.int64)
        return (
            nanoseconds // 10**9 + (nanoseconds % 10**9) / 1e9
        )  # the whole first: 61 bits do not fit a float

    def places(self) -> NDArray[np.int64]:
        """(T, 4): file, two numbers of the place in it, index into `channels`."""
        return np.frombuffer(self._places, np.int64).reshape(-1, 4)

    def keyframes(self) -> NDArray[np.bool_] | None:
        """(T,) where decoding of the video can begin; None where the codec does not show it."""
        if None in self._keyframes:
            return None
        return np.array(self._keyframes, bool)
