"""Read bags as a source: ROS 1, ROS 2 (sqlite3, MCAP) and plain MCAP, without ROS.

A bag is one episode, or several with `source.segments`; a folder of bags holds many. One pass over an episode
gathers the times and numbers of the topics that the embodiment names. Pictures are read again on demand, so
memory does not grow with the size of a bag. Streams keep their own clocks; `align` brings them to one clock.
An episode inside a bag is read together with the earlier messages that are still in force.
"""

import logging
import re
from collections.abc import Iterator
from functools import cache
from itertools import chain
from pathlib import Path

import numpy as np

from hma_data.arrays import Floats
from hma_data.episodes.episode import Episode, Signal, Stream
from hma_data.errors import EpisodeError, SourceError
from hma_data.registry.components import Camera, Component
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.bags.bag import Bag, BagPlace, find_bags
from hma_data.sources.bags.clocks import MAX_LATE_S, MessageTimes, apart
from hma_data.sources.bags.container import FOREVER, Record, RecordFilter, damaged
from hma_data.sources.bags.images import image_kind
from hma_data.sources.bags.inspect import report
from hma_data.sources.bags.messages import decode
from hma_data.sources.bags.segments import SegmentTable, parted
from hma_data.sources.bags.topic_track import Column, TopicTrack, camera_stream, missing_topic, parse_key
from hma_data.sources.base import SAMPLE, EpisodeRef, Inspection, component_values
from hma_data.sources.common.places import existing_path, nothing_there
from hma_data.storage.paths import StrPath, as_text

log = logging.getLogger(__name__)
PART = re.compile(r"(?P<bag>.+)/(?P<number>[0-9]{4,9})")


class RosbagSource:
    """The source of bags; see sources.base.Source."""

    def __init__(self) -> None:
        self._found: dict[str, tuple[Path, dict[str, list[Path]]]] = {}  # by URI, what `_list` returned last

    def inspect(self, uri: StrPath, episodes: int = SAMPLE) -> Inspection:
        """See Source."""
        uri = as_text(uri)
        return report(uri, *self._list(uri), episodes)

    def index(self, uri: StrPath, embodiment: Embodiment | None = None) -> list[EpisodeRef]:
        """See Source. A bag that cannot be read has no frames here; `read` raises its error.

        Where the embodiment divides bags, the episodes of the bag `run` are `run/0000`, `run/0001` …
        """
        root, bags = self._list(as_text(uri))
        return [ref for name, paths in bags.items() for ref in _refs(name, paths, root, embodiment)]

    def episode_ids(self, uri: StrPath) -> list[str]:
        """See Source: return the ids of whole bags, even where an embodiment divides them."""
        return list(self._list(as_text(uri))[1])

    def read(self, uri: StrPath, episode_id: str, embodiment: Embodiment) -> Episode:
        """See Source. A bag's own id reads the whole bag, even where the embodiment divides bags.

        Raises:
            SourceError: no such bag, or no such episode in it.
            EpisodeError: the bag is damaged, holds no episode, or lacks what the embodiment names.
        """
        uri = as_text(uri)
        match, segments = PART.fullmatch(episode_id), embodiment.source.segments
        part_of = match["bag"] if match and segments else ""
        # listed once: thousands of bags, each read on its own
        root, bags = self._found.get(uri) or self._list(uri)
        if bags.keys().isdisjoint((episode_id, part_of)):
            root, bags = self._list(uri)
        name = episode_id if episode_id in bags else part_of
        if name not in bags:
            raise SourceError(uri, f"has no bag {episode_id!r}", f"it has {', '.join(list(bags)[:10])}")
        path, *parts = bags[name]
        bag = Bag(path, root, parts)
        if not segments:
            return _EpisodeReading(bag, episode_id, embodiment).episode()
        bag, table = parted(bag, embodiment, segments)
        if not match or name == episode_id:
            return _EpisodeReading(bag, episode_id, embodiment).episode()
        number = int(match["number"])
        if number >= len(table.segments):
            held = f"{name} holds {_part_id(name, 0)} to {_part_id(name, len(table.segments) - 1)}"
            raise SourceError(uri, f"has no episode {episode_id!r}", held)
        return _EpisodeReading(bag, episode_id, embodiment, table, number).episode()

    def _list(self, uri: str) -> tuple[Path, dict[str, list[Path]]]:
        """Return the place of the recordings and the bags in it, and remember both for `read`."""
        path = existing_path(uri)
        if path.name == "metadata.yaml":
            path = path.parent
        bags = find_bags(path)
        if not bags:
            remedy = "expected .bag, .mcap, .db3, or folders with a metadata.yaml"
            raise nothing_there(uri, path, "holds no bags", remedy)
        self._found[uri] = path, bags
        return path, bags


open = RosbagSource


@cache
def _say_once(remark: str) -> None:
    log.warning("%s", remark)


def _part_id(name: str, number: int) -> str:
    return f"{name}/{number:04d}"


def _refs(name: str, paths: list[Path], root: Path, embodiment: Embodiment | None) -> list[EpisodeRef]:
    """List the episodes of one bag; one without frames where it cannot be read, and `read` raises why."""
    fingerprint = ""
    try:
        bag = Bag(paths[0], root, paths[1:])
        for remark in bag.remarks:
            _say_once(remark)
        fingerprint = bag.fingerprint()
        segments = embodiment.source.segments if embodiment else None
        if not embodiment or not segments:
            return [EpisodeRef(name, _frames(bag, embodiment), fingerprint=fingerprint)]
        table = parted(bag, embodiment, segments)[1]
    except (EpisodeError, OSError):
        return [EpisodeRef(name, 0, fingerprint=fingerprint)]
    return [
        EpisodeRef(_part_id(name, i), len(segment), None, fingerprint, group=name, left_out=table.left_out)
        for i, segment in enumerate(table.segments)
    ]


def _frames(bag: Bag, embodiment: Embodiment | None) -> int:
    """Count the frames of the primary camera; without an embodiment, of the camera with most frames."""
    topics = bag.topics()
    if embodiment:
        return topics[embodiment.primary_camera.key]
    images = {channel.topic for channel in bag.counts() if image_kind(channel.type)}
    return max((topics[topic] for topic in images), default=0)


# -- one episode


class _EpisodeReading:
    """One pass over a bag, or over the time range of one episode in it.

    Args:
        table, number: which of the bag's episodes; without a table, the whole bag.
    """

    def __init__(
        self,
        bag: Bag,
        episode_id: str,
        embodiment: Embodiment,
        table: SegmentTable | None = None,
        number: int = 0,
    ) -> None:
        self._bag, self._id, self._embodiment = bag, episode_id, embodiment
        self._table = table
        self._segment = table.segments[number] if table else None
        self._where = str(bag.path) if table is None else f"{bag.path}, episode {number}"
        self._counts = bag.topics()
        self._tracks: dict[str, TopicTrack] = {}
        self._said: tuple[int, str] | None = None  # the instruction, and when it was received

    def episode(self) -> Episode:
        """Make the pass; return the episode.

        Raises:
            EpisodeError: the bag is damaged, or lacks what the embodiment names.
        """
        embodiment = self._embodiment
        for camera in embodiment.cameras:
            if camera.key not in self._counts:
                raise missing_topic(camera.key, self._counts, self._where)
            self._track(camera.key)
        actions = self._columns(embodiment.action.components)
        states = self._columns(embodiment.state.components if embodiment.state else ())
        self._scan()
        notes = self._bag.notes()
        primary = self._stream(embodiment.primary_camera)
        shown = primary.timestamps
        self._require_one_clock(shown)
        streams: dict[str, Stream] = {}
        for camera in embodiment.cameras:
            same = camera is embodiment.primary_camera
            streams[camera.name] = primary if same else self._stream(camera, shown)
        parted = self._table is not None and len(self._table.segments) > 1
        action_signals = tuple(self._signal(column, shown) for column in actions)
        flags = self._held_actions(actions, action_signals, shown)
        return Episode(
            id=self._id,
            streams=streams,
            actions=action_signals,
            states=tuple(self._signal(column, shown) for column in states),
            rate_stamped=False,
            instruction=(self._said and self._said[1]) or notes.get("instruction", ""),
            success=None if parted else {"true": True, "false": False}.get(notes.get("success", "").lower()),
            source=str(self._bag.path),
            metadata={"flags": flags},
        )

    def _held_actions(
        self, columns: list[Column], signals: tuple[Signal, ...], shown: Floats
    ) -> dict[str, int]:
        """Return the flag of an episode with an action that never comes after its first frame; log it."""
        flags: dict[str, int] = {}
        for column, signal in zip(columns, signals, strict=True):
            before_s = float(shown[0] - signal.timestamps[-1])
            if before_s > 0 and len(shown) > 1:
                fault = f"the last message is {before_s:.3g} s before the first frame"
                key, frames = column.field.key, len(shown)
                log.warning("%s: %s: %s, and is held for all %d frames", self._where, key, fault, frames)
                flags["held_actions"] = frames
        return flags

    # -- the pass

    def _track(self, topic: str) -> TopicTrack:
        return self._tracks.setdefault(topic, TopicTrack(topic, self._where))

    def _columns(self, components: tuple[Component, ...]) -> list[Column]:
        columns = []
        for component in components:
            place = parse_key(component.key, self._counts, self._where)
            column = Column(component, place, self._where)
            self._track(column.field.topic).columns.append(column)
            columns.append(column)
        return columns

    def _scan(self) -> None:
        key = self._embodiment.source.instruction
        instruction = parse_key(key, self._counts, self._where) if key else None
        read = {instruction.topic} if instruction else set()
        for place, record in self._records(frozenset(self._tracks) | read):
            topic = record.channel.topic
            message = decode(record.channel, record.data, self._where)
            if instruction and topic == instruction.topic:
                self._hear(record.log_ns, str(instruction.value(message, self._where)))
            if topic in self._tracks:
                self._tracks[topic].add(record.channel, record.log_ns, place, message)
        for topic, track in self._tracks.items():
            if not len(track):
                raise EpisodeError(self._where, f"{topic} has no messages")
            if self._segment is None and len(track) != self._counts[topic]:
                fault = f"its index counts {self._counts[topic]} messages of {topic}, it holds {len(track)}"
                raise damaged(self._bag.path, fault)

    def _records(self, topics: frozenset[str]) -> Iterator[tuple[BagPlace, Record]]:
        """Yield the messages of the bag; of an episode in it, those of its time and those still in force."""
        segment, table = self._segment, self._table
        if segment is None or table is None:
            return self._bag.records(RecordFilter(topics, again=True))
        first_ns, last_ns = max(segment.first_ns - table.reach_ns, 0), segment.last_ns + table.reach_ns
        plain = topics - table.keyframes.keys()
        held = plain - {self._embodiment.primary_camera.key}
        within = RecordFilter(plain, first_ns, last_ns, again=True)
        parts = [iter(self._bag.before(held, first_ns)), self._bag.records(within)]
        for topic in sorted(topics & table.keyframes.keys()):
            keyframes = table.keyframes[topic]
            begin = max((at for at in keyframes if at <= first_ns), default=0)
            # The last frames of video with B-frames need messages up to the next key frame.
            end = min((at for at in keyframes if at > last_ns), default=last_ns)
            wanted = RecordFilter(frozenset({topic}), begin, end, again=True)
            parts.append(self._bag.records(wanted))
        return chain.from_iterable(parts)

    def _hear(self, log_ns: int, text: str) -> None:
        """Keep the text that is said nearest to the beginning of the bag, or of the episode in it."""
        begins, ends = (self._segment.first_ns, self._segment.last_ns) if self._segment else (0, FOREVER)
        if text and log_ns <= ends:
            before = self._said
            if before is None or abs(log_ns - begins) < abs(before[0] - begins):
                self._said = log_ns, text

    # -- results

    def _stream(self, camera: Camera, shown: Floats | None = None) -> Stream:
        """Return a camera; for an episode in a bag, its own frames, or those around the times `shown`."""
        track, clock = self._tracks[camera.key], camera.stamp or self._embodiment.sync.stamp
        if self._segment is None or self._table is None:
            return camera_stream(self._bag, track, clock, levels=camera.levels)
        times = track.times
        times = times[times.by_receipt()]
        if shown is not None:
            around = self._around(times, clock, shown)
            return camera_stream(self._bag, track, clock, around, camera.levels)
        begin = int(np.searchsorted(times.received, self._segment.first_ns)) + self._segment.skip
        within = (begin, begin + len(self._segment))
        return camera_stream(self._bag, track, self._table.clock, within, camera.levels)

    def _signal(self, column: Column, shown: Floats) -> Signal:
        track = self._tracks[column.field.topic]
        times, values = track.times[column.rows()], column.values()
        clock = column.component.stamp or self._embodiment.sync.stamp
        if self._segment:
            by_receipt = times.by_receipt()
            begin, stop = self._around(times[by_receipt], clock, shown)
            kept = np.sort(by_receipt[begin:stop])
            times, values = times[kept], values[kept]
        order = times.order_or_raise(clock, f"{self._where}, {track.topic}")
        composed = component_values(column.component, values[order], self._where)
        return Signal(times.seconds(clock)[order], composed)

    def _require_one_clock(self, shown: Floats) -> None:
        """Raise EpisodeError if the primary camera and another topic are timed by clocks that differ.

        A `stamp` at the camera or at a component says that its author knows better.
        """
        primary, stated = self._embodiment.primary_camera, self._embodiment.sync.stamp
        others = [(camera.key, camera.stamp) for camera in self._embodiment.cameras]
        for component in self._embodiment.components:
            others.append((parse_key(component.key, self._counts, self._where).topic, component.stamp))
        topics = dict.fromkeys(topic for topic, stamp in others if not (stamp or primary.stamp))
        clocks = []
        for topic in (primary.key, *topics):
            times = self._tracks[topic].times
            if times.order("receive") is None:
                return  # the recorder's clock was set back, so it cannot compare the others
            if self._segment:  # clocks may begin anew between the episodes of a bag
                received = times.received
                times = times[(received >= self._segment.first_ns) & (received <= self._segment.last_ns)]
            if len(times):
                clocks.append(times.clock(stated))
        period_s = float(np.median(np.diff(shown))) if len(shown) > 1 else 0.0
        for clock in clocks[1:]:
            if fault := apart(clocks[0], clock, period_s):
                remedy = (
                    "sync: {stamp: receive} uses receive times; "
                    f"stamp: header at camera {primary.name} keeps its header stamps, if they are right"
                )
                raise EpisodeError(self._where, fault, remedy)

    def _around(self, samples: MessageTimes, clock: str, shown: Floats) -> tuple[int, int]:
        """Return the range of samples, in order of receipt, that the frames shown need.

        It begins with the sample in force at the first frame. It ends with the first sample at or after the
        last frame, or, with `sync.tolerance_ms`, that much later. Where a clock begins anew between two
        episodes, only the samples on this episode's side count.
        """
        assert self._segment
        times = samples.seconds(clock)
        inside = np.searchsorted(samples.received, [self._segment.first_ns, self._segment.last_ns + 1])
        breaks = np.flatnonzero(np.diff(times) < -MAX_LATE_S) + 1
        earlier, later = breaks[breaks <= inside[0]], breaks[breaks >= max(inside[1], 1)]
        low = int(earlier[-1]) if len(earlier) else 0
        high = int(later[0]) if len(later) else len(times)
        if np.any(np.diff(times[low:high]) < -MAX_LATE_S):
            return low, high  # ordering them by the clock reports where it goes back
        rising = np.maximum.accumulate(times[low:high])  # a message may have been overtaken by the next
        begin = low + max(0, int(np.searchsorted(rising, shown[0], side="right")) - 1)
        last = shown[-1] + (self._embodiment.sync.tolerance_ms or 0) / 1e3
        stop = low + int(np.searchsorted(rising, last, side="left")) + 1
        return begin, min(max(stop, begin + 1), high)
