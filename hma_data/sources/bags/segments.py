"""Find the start and end of the episodes inside one bag, without decoding a frame.

One pass over the primary camera's stamps and the markers' topics makes a table. The last bags and their
tables are cached for the other episodes of the same bag, while no file changes; an episode is then read by
its own time range. Tables are also kept in this machine's cache folder. F frames of the primary camera in
order of receipt; an episode is a run of them.

A marker is a message that begins or ends an episode: `source.segments.start` and `stop`. It counts when it
arrives, or when a field of it becomes a value.
"""

import json
import os
from collections.abc import Iterable
from contextlib import suppress
from dataclasses import asdict, dataclass, field
from itertools import pairwise
from typing import Any

import numpy as np

from hma_data.arrays import Floats, Ints
from hma_data.errors import EpisodeError
from hma_data.registry.components import Marker, Segments
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.bags.bag import Bag, BagPlace
from hma_data.sources.bags.clocks import SECOND_NS, MessageTimes
from hma_data.sources.bags.container import Recent, Record, RecordFilter
from hma_data.sources.bags.images import STILL_IMAGE, VIDEO, image_kind
from hma_data.sources.bags.messages import decode, is_list, is_message
from hma_data.sources.bags.topic_track import TopicTrack, missing_topic, parse_key
from hma_data.storage.files import cache_folder, short_sha256, write_atomic

MAX_VALUES = 8  # values of a marker in an error
MAX_DELAY_S = 10.0  # header stamps further from receipt than this come from another clock
KEPT_BAGS = 2
TABLE = 3  # version of what is kept of a table


@dataclass(frozen=True)
class Segment:
    """One episode: frames `first` to `stop` of the primary camera.

    Attributes:
        first_ns, last_ns: receipt of its first and last frame.
        skip: frames before it that were also received at first_ns.
    """

    first: int
    stop: int
    first_ns: int
    last_ns: int
    skip: int

    def __len__(self) -> int:
        return self.stop - self.first


@dataclass(frozen=True)
class SegmentTable:
    """The episodes of a bag.

    Attributes:
        frames: frames of the primary camera in the whole bag.
        clock: of that camera, header or receive.
        reach_ns: how far outside the episode's receipt times its messages may have been received.
        keyframes: video camera -> ascending times of receipt of its key frames.
    """

    segments: tuple[Segment, ...]
    frames: int
    clock: str
    reach_ns: int
    keyframes: dict[str, list[int]] = field(default_factory=dict)

    @property
    def left_out(self) -> int:
        """Count the frames that are in no episode."""
        return self.frames - sum(map(len, self.segments))


# By process id: a forked child must not clean up after its parent.
_kept: dict[int, Recent[Any, tuple[Bag, SegmentTable]]] = {}


def parted(opened: Bag, embodiment: Embodiment, segments: Segments) -> tuple[Bag, SegmentTable]:
    """Return the bag and its episodes, from the cache where no file changed.

    Raises:
        EpisodeError: the bag cannot be read, or holds no episode.
    """
    path, state, primary = opened.path, opened.state(), embodiment.primary_camera.name
    cameras = tuple((camera.key, camera.stamp) for camera in embodiment.cameras)
    key = (path, state, segments, cameras, primary, embodiment.sync.stamp)
    kept = _kept.setdefault(os.getpid(), Recent(KEPT_BAGS))
    return kept.get(key, lambda: (opened, _stored(key, opened, embodiment, segments)))


def _stored(key: Any, bag: Bag, embodiment: Embodiment, segments: Segments) -> SegmentTable:
    """Return the table of a bag from this machine's cache, so that its workers read the bag once."""
    kept = cache_folder() / "bags" / f"{short_sha256(repr((TABLE, key)), 32)}.json"
    with suppress(OSError, ValueError, KeyError, TypeError):
        values = json.loads(kept.read_bytes())
        return SegmentTable(tuple(Segment(**one) for one in values.pop("segments")), **values)
    table = part(bag, embodiment, segments)
    with suppress(OSError):
        kept.parent.mkdir(parents=True, exist_ok=True)
        write_atomic(kept, json.dumps(asdict(table)))
    return table


def part(bag: Bag, embodiment: Embodiment, segments: Segments) -> SegmentTable:
    """Return the table of a bag.

    Raises:
        EpisodeError: the bag is damaged, lacks a topic, or no episode is in it.
    """
    where, topics = str(bag.path), bag.topics()
    camera = embodiment.primary_camera
    if camera.key not in topics:
        raise missing_topic(camera.key, topics, where)
    cameras = {camera.key for camera in embodiment.cameras}
    # Only the messages tell whether compressed images are frames of a video.
    videos = {
        c.topic for c in bag.counts() if c.topic in cameras and image_kind(c.type) in (STILL_IMAGE, VIDEO)
    }
    tracks = {key: TopicTrack(key, where) for key in {camera.key} | videos}
    start = MarkerTrack(segments.start, topics, where) if segments.start else None
    stop = MarkerTrack(segments.stop, topics, where) if segments.stop else None
    markers = [marker for marker in (start, stop) if marker]
    marked = {marker.track.topic for marker in markers}
    for place, record in bag.records(RecordFilter(frozenset(tracks) | marked)):
        topic = record.channel.topic
        if topic in tracks:
            message = decode(record.channel, record.data, where)
            tracks[topic].add(record.channel, record.log_ns, place, message)
        for marker in markers:
            if marker.track.topic == topic:
                marker.add(place, record)
    videos = {key for key in videos if tracks[key].kind == VIDEO}

    times = tracks[camera.key].times
    if not len(times):
        raise EpisodeError(where, f"{camera.key} has no messages")
    stated = camera.stamp or embodiment.sync.stamp
    clock = "header" if stated == "header" and times.stamps is not None else "receive"
    times = times[times.by_receipt()]
    shown = times.seconds(clock)
    runs = _runs(_events(start, stop, times, clock), len(times), begun=start is None)
    parts = [piece for begin, end in runs for piece in _at_gaps(shown, begin, end, segments.gap_s)]
    found = tuple(_segment(times.received, begin, end) for begin, end in parts if begin < end)
    if not found:
        fault = f"no episode in it holds a frame of {camera.key}"
        if start and not len(start.moments()):
            fault = f"no episode begins in it: {start.never()}"
        raise EpisodeError(where, fault, "correct source.segments in the YAML")
    # The camera's frames may arrive late; other messages may arrive without that delay.
    delay_s = np.abs(times.seconds("receive") - shown).max()
    return SegmentTable(
        segments=found,
        frames=len(times),
        clock=clock,
        reach_ns=SECOND_NS + int(min(float(delay_s), MAX_DELAY_S) * SECOND_NS),
        keyframes={
            key: sorted(tracks[key].times.received[tracks[key].keyframes()].tolist()) for key in videos
        },
    )


def _events(
    start: "MarkerTrack | None", stop: "MarkerTrack | None", times: MessageTimes, clock: str
) -> list[tuple[int, bool, int]]:
    """Return the events of the markers.

    Each is a marker's time of receipt, whether it begins an episode, and the index of the first frame after
    it. Times of the same clock are compared: the messages' own where camera and marker both have them.
    """
    events = []
    for marker in filter(None, (start, stop)):
        moments = marker.track.times[marker.moments()]
        common = clock if moments.stamps is not None else "receive"
        rising = np.maximum.accumulate(times.seconds(common))
        at = np.searchsorted(rising, moments.seconds(common))
        events += [
            (log_ns, marker is start, frame)
            for log_ns, frame in zip(moments.received.tolist(), at.tolist(), strict=True)
        ]
    return sorted(events)


def _runs(events: list[tuple[int, bool, int]], frames: int, begun: bool) -> list[tuple[int, int]]:
    """Return runs of frames from each start to its end.

    Args:
        begun: whether no marker starts episodes: the first begins with the recording, each other at a stop.
    """
    began = 0 if begun else None
    runs: list[tuple[int, int]] = []
    for _, starts, at in events:
        if began is not None:
            runs.append((began, max(began, at)))
        began = at if starts or begun else None
    return runs if began is None else [*runs, (began, frames)]


def _at_gaps(times: Floats, begin: int, stop: int, gap_s: float | None) -> list[tuple[int, int]]:
    """Divide a run where the camera pauses, or where its clock jumps back as far."""
    if gap_s is None or stop - begin < 2:
        return [(begin, stop)]
    cuts = begin + 1 + np.flatnonzero(np.abs(np.diff(times[begin:stop])) > gap_s)
    return list(pairwise([begin, *cuts.tolist(), stop]))


def _segment(received: Ints, begin: int, stop: int) -> Segment:
    first_ns = int(received[begin])
    skip = begin - int(np.searchsorted(received, first_ns))
    return Segment(begin, stop, first_ns, int(received[stop - 1]), skip)


# -- markers


class MarkerTrack:
    """The messages of a marker's topic, over one pass.

    Attributes:
        track: times of the messages, in the file's order.

    Raises:
        EpisodeError: the bag has no such topic.
    """

    def __init__(self, marker: Marker, topics: Iterable[str], where: str) -> None:
        self.marker, self._where = marker, where
        self._field = parse_key(marker.key, topics, where)
        self.track = TopicTrack(self._field.topic, where)
        self._fitting: list[bool] = []  # of each message
        self._seen: dict[str, None] = {}

    def add(self, place: BagPlace, record: Record) -> None:
        """Add the next message of the topic."""
        message = None
        if self.marker.equals is not None:
            message = decode(record.channel, record.data, self._where)
            self._fitting.append(self._fits(message))
        else:
            with suppress(EpisodeError):  # it only has to arrive; its time of receipt serves
                message = decode(record.channel, record.data, self._where)
        self.track.add(record.channel, record.log_ns, place, message)

    def moments(self) -> Ints:
        """Return the indices of the messages that count, in order of receipt."""
        order = self.track.times.by_receipt()
        if self.marker.equals is None:
            return order
        fitting = np.array(self._fitting, bool)[order]
        return order[fitting & ~np.concatenate([[False], fitting[:-1]])]

    def never(self) -> str:
        """Describe that the marker did not come, and the values that came instead."""
        if self.marker.equals is None:
            return f"{self.marker.key} never comes"
        known = f"it is {', '.join(self._seen)}" if self._seen else "it has no messages"
        return f"{self.marker.key} never becomes {self.marker.equals!r}, {known}"

    def _fits(self, message: Any) -> bool:
        value, wanted = self._field.value(message, self._where), self.marker.equals
        if len(self._seen) < MAX_VALUES:
            self._seen[str(value)] = None
        if isinstance(value, str) != isinstance(wanted, str) or is_message(value) or is_list(value):
            fault = f"{self.marker.key} is {value!r}, which cannot equal {wanted!r}"
            raise EpisodeError(
                self._where, fault, "correct the key (name one field) or equals in source.segments"
            )
        return bool(value == wanted)
