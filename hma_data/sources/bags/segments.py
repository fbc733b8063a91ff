"""Find the start and end of the episodes inside one bag, without decoding a picture.

One pass over the primary camera's stamps and the markers' topics makes a table. The last bags and their
tables are cached for the other episodes of the same bag, while no file changes; an episode is then read by
its own time range. F pictures of the primary camera in order of receipt; an episode is a run of them.

A marker is a message that begins or ends an episode: `source.segments.start` and `stop`. It counts when it
arrives, or when a field of it becomes a value. A service's call counts once, whichever of its events were
recorded. M messages of the marker's topic.
"""

import os
from collections import OrderedDict
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.errors import EpisodeError
from hma_data.registry.components import Marker, Segments
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.bags.bag import Bag, BagPlace
from hma_data.sources.bags.container import FAULTS, Channel, Record, RecordFilter
from hma_data.sources.bags.fields import Field, missing_topic, parse_key
from hma_data.sources.bags.images import VIDEO, picture_kind
from hma_data.sources.bags.messages import (
    OF_A_CALL,
    child,
    decode,
    event_type,
    head_stamp,
    is_list,
    is_service_event,
)
from hma_data.sources.bags.topic_track import TopicTrack

SECOND_NS = 10**9
SHOWN = 8  # values of a marker in an error
MAX_DELAY_S = 10.0  # header stamps further from receipt than this come from another clock
KEPT_BAGS = 2
KEPT_TABLES = 512
Key = tuple[Any, ...]


@dataclass(frozen=True)
class Segment:
    """One episode: pictures `first` to `stop` of the primary camera.

    Attributes:
        first_ns, last_ns: receipt of its first and last picture.
        skip: pictures before it that were also received at first_ns.
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
        reach_ns: how far outside the episode's receipt times its messages may have been received.
        empty: parts without a picture, which are not episodes.
        keyframes: video camera -> ascending times of receipt of its key frames; of its first message where
            the codec does not show them.
    """

    segments: tuple[Segment, ...]
    frames: int
    clock: str
    reach_ns: int
    empty: int = 0
    keyframes: dict[str, NDArray[np.int64]] = field(default_factory=dict)

    @property
    def left_out(self) -> int:
        """Count the pictures that are in no episode."""
        return self.frames - sum(map(len, self.segments))


# By process id: a forked child must not clean up after its parent.
_bags: dict[int, OrderedDict[Key, Bag]] = {}
_tables: OrderedDict[Key, Table] = OrderedDict()


def parted(path: Path, root: Path, embodiment: Embodiment, segments: Segments) -> tuple[Bag, Table]:
    """Return the bag and its episodes, from the cache where no file changed.

    Raises:
        EpisodeError: the bag cannot be read, or holds no episode.
    """
    bag = Bag(path, root)
    state = bag.state()
    kept = _bags.setdefault(os.getpid(), OrderedDict())
    bag = kept.pop((path, root, state), bag)
    kept[(path, root, state)] = bag
    cameras = tuple((camera.key, camera.stamp) for camera in embodiment.cameras)
    key = (path, state, segments, cameras, embodiment.primary_camera.name, embodiment.sync.stamp)
    table = _tables.pop(key, None) or part(bag, embodiment, segments)
    _tables[key] = table
    while len(kept) > KEPT_BAGS:
        kept.popitem(last=False)
    while len(_tables) > KEPT_TABLES:
        _tables.popitem(last=False)
    return bag, table


def part(bag: Bag, embodiment: Embodiment, segments: Segments) -> Table:
    """Return the table of a bag.

    Raises:
        EpisodeError: the bag is damaged, lacks a topic, or no episode is in it.
    """
    return _Pass(bag, embodiment, segments).table()


def heads(channels: list[Channel]) -> frozenset[str]:
    """Return the topics of pictures whose messages hold their time in their first bytes."""
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
        self._cameras = {key: TopicTrack(key) for key in ({self._key} | (cameras & videos))}
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

    def _markers(self) -> "list[MarkerTrack]":
        return [marker for marker in (self._start, self._stop) if marker]

    def _scan(self) -> None:
        markers = self._markers()
        marked = frozenset(marker.track.topic for marker in markers)
        short = (heads(self._channels) & self._cameras.keys()) - marked
        wanted = RecordFilter(frozenset(self._cameras) | marked, heads=short)
        for place, record in self._bag.records(wanted):
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

    def _clock(self, camera: TopicTrack) -> str:
        stated = self._embodiment.primary_camera.stamp or self._embodiment.sync.stamp
        return "header" if stated == "header" and camera.stamped else "receive"

    def _running(
        self, times: NDArray[np.float64], received: NDArray[np.int64], clock: str
    ) -> list[tuple[int, int]]:
        """Return runs of pictures from each start to its end; the whole recording without markers."""
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
        """Return the events of the markers.

        Each is a marker's time of receipt, whether it begins an episode, and the index of the first picture
        after it. Times of the same clock are compared: the messages' own where camera and marker both have
        them.
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
        """Divide a run where the camera pauses, or where its clock jumps back as far."""
        gap_s = self._segments.gap_s
        if gap_s is None or stop - begin < 2:
            return [(begin, stop)]
        cuts = begin + 1 + np.flatnonzero(np.abs(np.diff(times[begin:stop])) > gap_s)
        return list(pairwise([begin, *cuts.tolist(), stop]))

    def _keyframes(self, track: TopicTrack) -> NDArray[np.int64]:
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


def _reach_ns(camera: TopicTrack, clock: str) -> int:
    """Return a second plus the largest delay of the camera's pictures, of which at most MAX_DELAY_S counts.

    Other messages may arrive without that delay.
    """
    late = np.abs(camera.seconds("receive") - camera.seconds(clock)).max()
    return SECOND_NS + int(min(float(late), MAX_DELAY_S) * SECOND_NS)


# -- markers


class MarkerTrack:
    """Follow a marker's topic over one pass.

    Attributes:
        track: times of the messages, in the file's order.

    Raises:
        EpisodeError: the bag has no such topic.
    """

    def __init__(self, marker: Marker, topics: list[str], where: str) -> None:
        self.marker, self._where = marker, where
        self._field = parse_key(marker.key, topics, where)
        self.track = TopicTrack(self._field.topic)
        self._kinds = bytearray()  # of each message: whether it fits, or which event of a call it is
        self._service = False
        self._seen: dict[str, None] = {}

    def add(self, place: BagPlace, record: Record) -> None:
        """Add the next message of the topic."""
        self._service = self._service or is_service_event(record.channel)
        message = None
        if self.marker.equals is not None:
            message = decode(record.channel, record.data, self._where)
            self._kinds.append(self._fits(message))
        elif self._service:
            self._kinds.append(self._event(record))
        else:
            self._kinds.append(True)
            message = self._decoded(record)
        self.track.add(record.channel, record.log_ns, place, message)

    def moments(self) -> NDArray[np.int64]:
        """Return the indices of the messages that count, in order of receipt."""
        order = self.track.order()
        kinds = np.frombuffer(self._kinds, np.uint8)[order]
        if self.marker.equals is not None:
            becomes = (kinds == 1) & (np.concatenate([[0], kinds[:-1]]) != 1)
            return order[becomes]
        if self._service and len(kinds):
            return order[kinds == next(kind for kind in OF_A_CALL if kind in kinds)]
        return order

    def never(self) -> str:
        """Describe that the marker did not come, and the values that came instead."""
        if self.marker.equals is None:
            return f"{self.marker.key} never comes"
        known = f"it is {', '.join(list(self._seen)[:SHOWN])}" if self._seen else "it has no messages"
        return f"{self.marker.key} never becomes {self.marker.equals!r}, {known}"

    def _event(self, record: Record) -> int:
        try:
            return event_type(record.data)
        except ValueError as fault:
            raise EpisodeError(self._where, f"{self._field.topic}: {fault}") from fault

    def _decoded(self, record: Record) -> Any:
        """Decode a message for its stamp; None where it cannot be decoded.

        A marker without a value to compare only has to arrive.
        """
        try:
            return decode(record.channel, record.data, self._where)
        except EpisodeError:
            return None

    def _fits(self, message: Any) -> bool:
        value = self._value(message)
        if value is None:
            return False
        if len(self._seen) < SHOWN:
            self._seen[str(value)] = None
        wanted = self.marker.equals
        if isinstance(wanted, str) or isinstance(value, str):
            if not (isinstance(wanted, str) and isinstance(value, str)):
                raise EpisodeError(
                    self._where,
                    f"{self.marker.key} is {value!r}, which cannot equal {wanted!r}",
                    "mend equals",
                )
            return value == wanted
        return self._number(value) == float(wanted or 0)

    def _number(self, value: Any) -> float:
        try:
            return float(value)
        except (*FAULTS, TypeError) as fault:
            raise EpisodeError(
                self._where, f"{self.marker.key} is no single value", "name one field of it"
            ) from fault

    def _value(self, message: Any) -> Any:
        """Return the value at the key; None for a service event without a request or response."""
        field = self._field
        if self._service and field.steps and field.steps[0] in ("request", "response"):
            held = child(message, str(field.steps[0]))
            if is_list(held) and not len(held):
                return None
            if is_list(held) and (len(field.steps) < 2 or isinstance(field.steps[1], str)):
                field = Field(field.key, field.topic, (field.steps[0], 0, *field.steps[1:]))
        return field.value(message, self._where)
