"""Record the times and places of a topic's messages in one pass over a bag, a few bytes a message.

A camera's pictures are read again by these places on demand. T messages of a topic, H×W pixels; times are
float64 seconds; the clock of a topic is `header` or `receive`.
"""

import struct
from array import array
from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.episode import Floats, Stream
from hma_data.episodes.images import Images
from hma_data.errors import EpisodeError
from hma_data.sources.bags.bag import Bag, BagPlace
from hma_data.sources.bags.container import Channel, Data
from hma_data.sources.bags.fields import Column
from hma_data.sources.bags.images import (
    VIDEO,
    VideoDecoder,
    is_keyframe,
    payload,
    picture,
    picture_kind,
    video_codec,
)
from hma_data.sources.bags.messages import decode, head_stamp, stamp_ns

INT64 = np.iinfo(np.int64)
BLOCK = 64  # video messages fetched at a time


class TopicTrack:
    """Record one topic over one pass.

    Attributes:
        columns: the components that read this topic; each takes its values as messages are added.
        channels: the channels of the messages, usually one.
        codec: of video; empty for anything else.
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

    def add_head(self, channel: Channel, log_ns: int, place: BagPlace, data: Data) -> None:
        """Add the next message, of which only the time in its first bytes is needed.

        Raises:
            EpisodeError: its bytes hold no such time.
        """
        stamp = head_stamp(channel)
        try:
            own_ns = stamp(data) if stamp else 0
        except (struct.error, IndexError) as fault:
            raise EpisodeError(
                self.topic, f"a message is not a {channel.type}: it has {len(data)} bytes"
            ) from fault
        self._take(channel, log_ns, place, own_ns)

    def add(self, channel: Channel, log_ns: int, place: BagPlace, message: Any) -> None:
        """Add the next message; a message that cannot be decoded is None, and keeps its time of receipt."""
        for column in self.columns:
            column.add(message, len(self))
        if message is not None and picture_kind(channel.type) == VIDEO:
            self._keyframes.append(self._is_keyframe(message))
        self._take(channel, log_ns, place, stamp_ns(message))

    def _take(self, channel: Channel, log_ns: int, place: BagPlace, own_ns: int) -> None:
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
        """Return the order of receipt: of all messages, or of those rows (then an index into `rows`)."""
        received = self.received()
        return np.argsort(received if rows is None else received[rows], kind="stable")

    def received(self) -> NDArray[np.int64]:
        """Return (T,) nanoseconds of receipt, in the file's order."""
        return np.frombuffer(self._log_ns, np.int64)

    @property
    def stamped(self) -> bool:
        """Check whether every message carries its own time, and these times are not all the same."""
        stamps = np.frombuffer(self._stamp_ns, np.int64)
        return bool(len(stamps) and np.all(stamps)) and not self.frozen

    @property
    def frozen(self) -> bool:
        """Check whether the messages' own times never change: such stamps are not a clock."""
        stamps = np.frombuffer(self._stamp_ns, np.int64)
        return bool(len(stamps) > 1 and stamps[0] and np.all(stamps == stamps[0]))

    def seconds(self, clock: str) -> Floats:
        """Return (T,) seconds in the file's order: `header` where messages are stamped, else `receive`."""
        stamps = self._stamp_ns if clock == "header" and self.stamped else self._log_ns
        nanoseconds = np.frombuffer(stamps, np.int64)
        # Whole seconds are divided first, because 61 bits do not fit a float.
        return nanoseconds // 10**9 + (nanoseconds % 10**9) / 1e9

    def places(self) -> NDArray[np.int64]:
        """Return (T, 4): file, two numbers of the place in it, index into `channels`."""
        return np.frombuffer(self._places, np.int64).reshape(-1, 4)

    def keyframes(self) -> NDArray[np.bool_] | None:
        """Return (T,) whether decoding can begin at a message; None where the codec does not show it."""
        if None in self._keyframes:
            return None
        return np.array(self._keyframes, bool)


# -- cameras


def camera_stream(bag: Bag, track: TopicTrack, clock: str, shown: tuple[int, int] | None = None) -> Stream:
    """Return the stream of a camera whose topic was recorded.

    Args:
        clock: header or receive.
        shown: [from, to) of the pictures, in order of receipt; all by default. Video may need earlier
            messages too, to be decoded.

    Raises:
        EpisodeError: the topic holds no pictures, or video that never begins.
    """
    where = f"{bag.path}, {track.topic}"
    kinds = {picture_kind(channel.type) for channel in track.channels}
    kind = kinds.pop()
    if kind is None or kinds:
        types = ", ".join(sorted({channel.type or channel.encoding for channel in track.channels}))
        raise EpisodeError(
            where, f"holds {types}, not pictures", "name a topic of pictures as the camera's key"
        )
    order = track.order()
    begin, stop = shown or (0, len(order))
    if kind != VIDEO:
        order = order[begin:stop]
        messages = Messages(bag, track.channels, track.places()[order], where)
        return StillStream(track.seconds(clock)[order], messages, kind)
    first, keyframes = _decodable(track, order, begin, where)
    begin = max(begin, first)
    order, keyframes = order[first:stop], keyframes[first:stop]
    if begin >= stop:
        raise EpisodeError(where, f"the {track.codec} video has no key frame before frame {stop}")
    messages = Messages(bag, track.channels, track.places()[order], where)
    times = track.seconds(clock)[order[begin - first :]]
    return VideoStream(times, messages, keyframes, track.codec)


def _decodable(
    track: TopicTrack, order: NDArray[np.int64], begin: int, where: str
) -> tuple[int, NDArray[np.bool_]]:
    """Return where decoding must begin for the message `begin`, and the key frames in order of receipt.

    Messages before the first key frame cannot be decoded.
    """
    keyframes = track.keyframes()
    if keyframes is None:  # only the first message is certain to be one
        return 0, np.arange(len(order)) == 0
    keyframes = keyframes[order]
    if not keyframes.any():
        raise EpisodeError(where, f"the {track.codec} video has no key frame")
    earlier = np.flatnonzero(keyframes[: begin + 1])
    return int(earlier[-1] if len(earlier) else np.argmax(keyframes)), keyframes


class Messages:
    """Read the messages of one topic again by index.

    Args:
        places: (T, 4) as TopicTrack keeps them, in order of receipt.
        channels: the channels that the last number of a place points into.
    """

    def __init__(self, bag: Bag, channels: list[Channel], places: NDArray[np.int64], where: str) -> None:
        self.where = where
        self._bag, self._channels, self._places = bag, channels, places

    def read(self, indices: Sequence[int] | NDArray[np.int64]) -> Iterator[object]:
        """Yield the decoded messages of those indices, in that order."""
        rows = self._places[np.asarray(indices, np.int64)].tolist()
        places = [(file, first, second) for file, first, second, _ in rows]
        for row, data in zip(rows, self._bag.payloads(places), strict=True):
            yield decode(self._channels[row[3]], data, self.where)


class StillStream:
    """Serve a camera of raw or still pictures; see episode.Stream."""

    def __init__(self, timestamps: Floats, messages: Messages, kind: str) -> None:
        self.timestamps = timestamps
        self._messages, self._kind = messages, kind

    def frames(self, indices: Sequence[int] | NDArray[np.int64]) -> NDArray[np.uint8]:
        """See episode.Stream."""
        distinct, inverse = np.unique(np.asarray(indices, np.int64), return_inverse=True)
        stacked = _stack(self.each(distinct), len(distinct))
        return stacked if np.array_equal(inverse, np.arange(len(stacked))) else stacked[inverse]

    def each(self, indices: Sequence[int] | NDArray[np.int64]) -> Iterator[Images]:
        """See episode.OneByOne."""
        where = self._messages.where
        return _of_one_size((picture(m, self._kind, where) for m in self._messages.read(indices)), where)


class VideoStream:
    """Serve a camera of video; see episode.Stream.

    Args:
        timestamps: (T,) of the pictures shown, which are the last T messages.
        keyframes: (M,) of all messages; the messages before those shown serve only for decoding.
    """

    def __init__(
        self, timestamps: Floats, messages: Messages, keyframes: NDArray[np.bool_], codec: str
    ) -> None:
        self.timestamps = timestamps
        self._messages, self._count = messages, len(keyframes)
        self._lead = len(keyframes) - len(timestamps)
        self._decoder = VideoDecoder(codec, keyframes, self._from, messages.where)

    def frames(self, indices: Sequence[int] | NDArray[np.int64]) -> NDArray[np.uint8]:
        """See episode.Stream."""
        wanted = [int(i) + self._lead for i in indices]
        found = self._decoder.frames(wanted)
        distinct = list(found)
        stacked = _stack(_of_one_size(iter(found.values()), self._messages.where), len(found))
        return stacked[[distinct.index(i) for i in wanted]]

    def _from(self, start: int) -> Iterator[bytes]:
        for block in range(start, self._count, BLOCK):
            for message in self._messages.read(range(block, min(block + BLOCK, self._count))):
                yield payload(message)


def _of_one_size(pictures: Iterator[Images], where: str) -> Iterator[Images]:
    """Yield the pictures; raise EpisodeError at the first whose size differs."""
    first: tuple[int, ...] = ()
    for item in pictures:
        first = first or item.shape
        if item.shape != first:
            shapes = sorted({first, item.shape})
            raise EpisodeError(where, f"pictures change size within the episode: {shapes}")
        yield item


def _stack(pictures: Iterator[Images], count: int) -> Images:
    """Stack pictures to (count, H, W, 3), one at a time, so that only one picture is in memory twice."""
    first = next(pictures, None)
    if first is None:
        return np.zeros((0, 1, 1, 3), np.uint8)
    stacked = np.empty((count, *first.shape), np.uint8)
    stacked[0] = first
    for i, item in enumerate(pictures, start=1):
        stacked[i] = item
    return stacked
