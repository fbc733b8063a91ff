"""Cameras of a bag: times and places in memory, pictures read again when asked for.

T pictures of a camera, H×W pixels.
"""

from collections.abc import Iterator, Sequence

import numpy as np
from numpy.typing import NDArray

from hma_data.episode import Floats, Stream
from hma_data.errors import EpisodeError
from hma_data.sources.bags.bag import Bag, Place
from hma_data.sources.bags.container import Channel
from hma_data.sources.bags.messages import decode
from hma_data.sources.bags.pictures import VIDEO, payload, picture, picture_kind
from hma_data.sources.bags.track import Track
from hma_data.sources.bags.video import VideoDecoder
from hma_data.video import Images

BLOCK = 64  # video messages fetched at a time


def camera_stream(bag: Bag, track: Track, clock: str, shown: tuple[int, int] | None = None) -> Stream:
    """The camera whose topic was tracked.

    Args:
        clock: header or receive.
        shown: from which to before which of the pictures, in order of receipt; all by default. What video
            needs to be decoded may come before.

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
    track: Track, order: NDArray[np.int64], begin: int, where: str
) -> tuple[int, NDArray[np.bool_]]:
    """Where decoding has to begin for the message `begin`, and the key frames in order of receipt.

    What comes before the first key frame cannot be decoded.
    """
    keyframes = track.keyframes()
    if keyframes is None:  # then only the beginning is sure to be one
        return 0, np.arange(len(order)) == 0
    keyframes = keyframes[order]
    if not keyframes.any():
        raise EpisodeError(where, f"the {track.codec} video has no key frame")
    earlier = np.flatnonzero(keyframes[: begin + 1])
    return int(earlier[-1] if len(earlier) else np.argmax(keyframes)), keyframes


class Messages:
    """The messages of one topic, read again by index.

    Args:
        places: (T, 4) as Track keeps them, in order of receipt.
        channels: what the last number of a place means.
    """

    def __init__(self, bag: Bag, channels: list[Channel], places: NDArray[np.int64], where: str) -> None:
        self.where = where
        self._bag, self._channels, self._places = bag, channels, places

    def read(self, indices: Sequence[int] | NDArray[np.int64]) -> Iterator[object]:
        """The decoded messages of those indices, in that order."""
        rows = self._places[np.asarray(indices, np.int64)].tolist()
        places = [Place(file, first, second) for file, first, second, _ in rows]
        for row, data in zip(rows, self._bag.payloads(places), strict=True):
            yield decode(self._channels[row[3]], data, self.where)


class StillStream:
    """A camera of raw or still pictures; see episode.Stream."""

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
    """A camera of video; see episode.Stream.

    Args:
        timestamps: (T,) of the pictures shown, the last of the messages.
        keyframes: (M,) of all messages; those before the pictures shown are there to be decoded.
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
    """Those pictures; EpisodeError once one has another size than the first."""
    first: tuple[int, ...] = ()
    for item in pictures:
        first = first or item.shape
        if item.shape != first:
            shapes = sorted({first, item.shape})
            raise EpisodeError(where, f"pictures change size within the episode: {shapes}")
        yield item


def _stack(pictures: Iterator[Images], count: int) -> Images:
    """(count, H, W, 3); each is put in its place as it comes, so that one is held twice, not all."""
    first = next(pictures, None)
    if first is None:
        return np.zeros((0, 1, 1, 3), np.uint8)
    stacked = np.empty((count, *first.shape), np.uint8)
    stacked[0] = first
    for i, item in enumerate(pictures, start=1):
        stacked[i] = item
    return stacked
