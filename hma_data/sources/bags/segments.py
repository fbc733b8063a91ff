"""Episodes inside one bag: where they begin and end, found without decoding a picture.

One pass over the primary camera's stamps and the markers' topics makes a table, which is kept; an
episode is then read by its own part of the recording's time. F pictures of the primary camera in
order of receipt; an episode is a run of them.
"""

from dataclasses import dataclass, field
from itertools import pairwise

import numpy as np
from numpy.typing import NDArray

from hma_data.embodiment import Embodiment
from hma_data.errors import EpisodeError
from hma_data.sources.bags.bag import Bag
from hma_data.sources.bags.container import Channel, Wanted
from hma_data.sources.bags.fields import missing_topic
from hma_data.sources.bags.markers import MarkerTrack
from hma_data.sources.bags.messages import decode, head_stamp
from hma_data.sources.bags.pictures import VIDEO, picture_kind
from hma_data.sources.bags.track import Track
from hma_data.spec import Segments

SECOND_NS = 10**9
MAX_DELAY_S = 10.0  # header stamps further from receipt than this are of another clock


@dataclass(frozen=True)
class Segment:
    """One episode: pictures `first` to `stop` of the primary camera.

    Attributes:
        first_ns, last_ns: receipt of its first and last picture.
        skip: pictures before it that were received at first_ns too.
    """

    first: int
    stop: int
    first_ns: int
    last_ns: int
    skip: int

    def __len__(self) -> int:
        return self.stop - self.first


@dataclass(frozen=True)
class Table:
    """The episodes of a bag.

    Attributes:
        frames: pictures of the primary camera in the whole bag.
        clock: of that camera, header or receive.
        reach_ns: how far from an episode's receipt times a message of it may have been received.
        empty: parts without a picture, which are no episodes.
        keyframes: camera of video -> receipt of its key frames, ascending; empty where none can be told.
    """

    segments: tuple[Segment, ...]
    frames: int
    clock: str
    reach_ns: int
    empty: int = 0
    keyframes: dict[str, NDArray[np.int64]] = field(default_factory=dict)

    @property
    def left_out(self) -> int:
        """Pictures that are in no episode."""
        return self.frames - sum(map(len, self.segments))


def part(bag: Bag, embodiment: Embodiment, segments: Segments) -> Table:
    """The table of that bag.

    Raises:
        EpisodeError: the bag is damaged, lacks a topic, or no episode is in it.
    """
    return _Pass(bag, embodiment, segments).table()


def heads(channels: list[Channel]) -> frozenset[str]:
    """Topics of pictures whose messages tell their time in their first bytes."""
    still = {c.topic for c in channels if picture_kind(c.type) not in (None, VIDEO)}
    return frozenset(
        topic for topic in still if all(head_stamp(c) is not None for c in channels if c.topic == topic)
    )


class _Pass:
    """One pass over a bag."""

    def __init__(self, bag: Bag, embodiment: Embodiment, segments: Segments) -> None:
        self._bag, self._embodiment, self._segments = bag, embodiment, segments
        self._where = str(bag.path)
        self._channels = list(bag.counts())
        topics = [channel.topic for channel in self._channels]
        self._key = embodiment.primary_camera.key
        cameras = {camera.key for camera in embodiment.cameras}
        videos = {c.topic for c in self._channels if picture_kind(c.type) == VIDEO}
        if self._key not in topics:
            raise missing_topic(self._key, topics, self._where)
        self._cameras = {key: Track(key) for key in ({self._key} | (cameras & videos))}
        self._videos = videos & cameras
        self._start, self._stop = (
            MarkerTrack(marker, topics, self._where) if marker else None
            for marker in (segments.start, segments.stop)
        )

    def table(self) -> Table:
        self._scan()
        camera = self._cameras[self._key]
        if not len(camera):
            raise EpisodeError(self._where, f"{self._key} has no messages")
        order = camera.order()
        received = camera.received()[order]
        clock = self._clock(camera)
        times = camera.seconds(clock)[order]
        running = self._running(times, received, clock)
        parts = [piece for begin, stop in running for piece in self._at_gaps(times, begin, stop)]
        found = tuple(_segment(received, begin, stop) for begin, stop in parts if begin < stop)
        if not found:
            raise EpisodeError(self._where, self._none(), "correct source.segments in the YAML")
        return Table(
            segments=found,
            frames=len(times),
            clock=clock,
            reach_ns=_reach_ns(camera, clock),
            empty=len(parts) - len(found),
            keyframes={key: self._keyframes(self._cameras[key]) for key in self._videos},
        )

    def _markers(self) -> list[MarkerTrack]:
        return [marker for marker in (self._start, self._stop) if marker]

    def _scan(self) -> None:
        markers = self._markers()
        marked = frozenset(marker.track.topic for marker in markers)
        short = (heads(self._channels) & self._cameras.keys()) - marked
        wanted = Wanted(frozenset(self._cameras) | marked, heads=short, checked=False)
        for place, record in self._bag.wanted(wanted):
            topic = record.channel.topic
            if topic in self._cameras:
                track = self._cameras[topic]
                if topic in short:
                    track.add_head(record.channel, record.log_ns, place, record.data)
                else:
                    message = decode(record.channel, record.data, self._where)
                    track.add(record.channel, record.log_ns, place, message)
            for marker in markers:
                if marker.track.topic == topic:
                    marker.add(place, record)

    def _clock(self, camera: Track) -> str:
        stated = self._embodiment.primary_camera.stamp or self._embodiment.sync.stamp
        return "header" if stated == "header" and camera.stamped else "receive"

    def _running(
        self, times: NDArray[np.float64], received: NDArray[np.int64], clock: str
    ) -> list[tuple[int, int]]:
        """Runs of pictures from each start to what ends it; the whole recording without markers."""
        began = 0 if self._start is None else None
        runs: list[tuple[int, int]] = []
        for _, starts, at in sorted(self._events(times, received, clock)):
            if began is not None:
                runs.append((began, max(began, at)))
            began = at if starts or self._start is None else None
        return runs if began is None else [*runs, (began, len(times))]

    def _events(
        self, times: NDArray[np.float64], received: NDArray[np.int64], clock: str
    ) -> list[tuple[int, bool, int]]:
        """Receipt of each marker, whether it begins an episode, and the first picture after it.

        Times of the same kind are compared: the messages' own where camera and marker both have them.
        """
        own = np.maximum.accumulate(times)
        events = []
        for marker in self._markers():
            track = marker.track
            for i in marker.moments().tolist():
                log_ns = int(track.received()[i])
                at = int(np.searchsorted(received, log_ns))
                if clock == "header" and track.stamped:
                    at = int(np.searchsorted(own, track.seconds("header")[i]))
                events.append((log_ns, marker is self._start, at))
        return events

    def _at_gaps(self, times: NDArray[np.float64], begin: int, stop: int) -> list[tuple[int, int]]:
        """A run parted where the camera pauses, or its clock jumps back as far."""
        gap_s = self._segments.gap_s
        if gap_s is None or stop - begin < 2:
            return [(begin, stop)]
        cuts = begin + 1 + np.flatnonzero(np.abs(np.diff(times[begin:stop])) > gap_s)
        return list(pairwise([begin, *cuts.tolist(), stop]))

    def _keyframes(self, track: Track) -> NDArray[np.int64]:
        flags = track.keyframes()
        received = track.received()
        return np.sort(received[flags]) if flags is not None else np.sort(received[:1])

    def _none(self) -> str:
        if self._start and not len(self._start.moments()):
            return f"no episode begins in it: {self._start.never()}"
        return f"no episode in it holds a picture of {self._key}"


def _segment(received: NDArray[np.int64], begin: int, stop: int) -> Segment:
    first_ns = int(received[begin])
    skip = begin - int(np.searchsorted(received, first_ns))
    return Segment(begin, stop, first_ns, int(received[stop - 1]), skip)


def _reach_ns(camera: Track, clock: str) -> int:
    """A second, and as much as the camera's pictures come late, since other messages may not."""
    late = np.abs(camera.seconds("receive") - camera.seconds(clock)).max()
    return SECOND_NS + int(min(float(late), MAX_DELAY_S) * SECOND_NS)
