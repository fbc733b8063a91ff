"""Inspect bags: topics with rates and jitter, and keys as a YAML would name them.

Every bag is counted by its index. A sample of the bags is read message by message, up to a limit over all of
them. The first readable bag gives the keys; each bag adds its times and numbers.
"""

from array import array
from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.arrays import Bools, Floats, Ints
from hma_data.episodes.offset import measure as measure_offset
from hma_data.errors import EpisodeError, SourceError
from hma_data.sources.bags.bag import Bag
from hma_data.sources.bags.clocks import MessageTimes
from hma_data.sources.bags.images import (
    MONO16,
    VIDEO,
    Messages,
    codec,
    encoding,
    image_kind,
    is_grey,
    wide_grey,
)
from hma_data.sources.bags.messages import (
    child,
    child_of_each,
    decode,
    field_names,
    is_list,
    is_message,
    is_message_list,
    numbers,
    value_names,
)
from hma_data.sources.bags.topic_track import Field, TopicTrack, camera_stream, parse_key
from hma_data.sources.common import checks
from hma_data.sources.common.checks import Finding, measure, skew
from hma_data.sources.common.inspection import Inspection, KeyInfo, Timing, TopicInfo
from hma_data.sources.common.survey import Survey

MAX_BYTES = 1 << 30  # of messages measured, over all bags
MAX_MESSAGES = 300_000
MAX_FIELDS = 64  # most numeric keys of a topic whose values are checked
MAX_HELD = 1 << 16  # most numbers of a key in memory
MAX_WIDTH = 4096  # most values of an action or state; wider fields are maps or point clouds
# Topics that are no streams.
LOG_TOPICS = ("/rosout", "/rosout_agg", "/parameter_events", "/diagnostics", "/diagnostics_agg")
# Fields of points, poses and twists.
GEOMETRY = {"x", "y", "z", "w", "theta", "position", "orientation", "linear", "angular"}
GEOMETRY |= {"translation", "rotation"}
PAIRS = 4  # runs of neighbouring frames looked at, for a camera
ALL_LEVELS = (0.0, 65535.0)  # levels at which frames in mono16 are looked at


@dataclass
class _Values:
    """The numbers of one key, message by message, without those of another width than the first."""

    place: Field
    width: int = 0
    taken: int = 0  # rows already handed to the survey
    held: array[float] = field(default_factory=lambda: array("d"))

    def add(self, message: Any, where: str) -> None:
        try:
            found = numbers(self.place.value(message, where))
        except (EpisodeError, TypeError):
            return  # a list that is empty or shorter in this message
        self.width = self.width or len(found)
        if found and len(found) == self.width:
            self.held.extend(found)

    def hand_on(self, survey: Survey, episode: str) -> None:
        """Hand the numbers in memory to the survey."""
        if self.held:
            read = np.array(self.held).reshape(-1, self.width)
            survey.numbers(episode, self.place.key, read, self.taken)
            self.taken, self.held = self.taken + len(read), array("d")


@dataclass
class _Topic:
    """A topic while it is measured; `sample` is its first message, or the one that names most joints."""

    track: TopicTrack
    count: int = 0
    sample: Any = None
    named: int = 0
    fault: EpisodeError | None = None
    values: list[_Values] = field(default_factory=list)

    def look_at(self, message: Any, where: str) -> None:
        """Add a message's values, and keep it as the sample where it names more joints.

        Two publishers of one JointState topic may name different joints.
        """
        named = child(message, "name") if "name" in field_names(message) else ""
        count = len(named) if is_list(named) else 0
        first = self.sample is None
        if first or count > self.named:
            self.sample, self.named = message, count
        if first and not image_kind(self.track.channels[0].type):
            topic = self.track.topic
            vectors = [key for key in _values(topic, message) if key.kind == "vector"][:MAX_FIELDS]
            narrow = [key.key for key in vectors if key.shape[0] <= MAX_WIDTH]
            self.values = [_Values(parse_key(key, (topic,), where)) for key in narrow]
        for value in self.values:
            value.add(message, where)


@dataclass
class _Clock:
    """The times (T,) of one topic of one bag, by both clocks, each in its own order."""

    header: Floats
    receive: Floats


@dataclass
class _Budget:
    """The bytes and messages that may still be read."""

    bytes: int = MAX_BYTES
    messages: int = MAX_MESSAGES

    @property
    def spent(self) -> bool:
        return self.bytes < 0 or self.messages < 0


def report(uri: str, root: Path, bags: dict[str, list[Path]], episodes: int) -> Inspection:
    """Return the inspection of bags.

    Raises:
        SourceError: none of them can be read.
    """
    survey, budget = Survey(len(bags), alone=len(bags) == 1, by_field=True), _Budget()
    survey.links(root, {paths[0] for paths in bags.values()})
    held: dict[str, list[Path]] = {}  # the bags with messages: an open one keeps its index and unpacked files
    lengths: list[Counter[str]] = []  # of each bag: messages by topic
    for name, paths in bags.items():
        path, *parts = paths
        try:
            bag = Bag(path, root, parts)
            for remark in bag.remarks:
                survey.note(Finding("files", "info" if path.is_file() else "warn", remark))
            counts = bag.topics()
        except EpisodeError as fault:
            survey.fault(name, fault)
            continue
        lengths.append(counts)
        if counts.total():
            held[name] = paths
        else:
            survey.note(Finding("readable", "info", f"{path}: holds no messages"))
    first: _BagInspection | None = None
    clocks: list[dict[str, _Clock]] = []
    for name in survey.sample(list(held), episodes):
        path, *parts = held[name]
        try:
            bag = bag if len(bags) == 1 else Bag(path, root, parts)
            looked = _BagInspection(name, bag, survey, budget)
        except EpisodeError as fault:
            survey.fault(name, fault)
            continue
        survey.episode(name)
        first = first or looked
        clocks.append(looked.clocks)
        if budget.spent:
            break
    if first is None:
        faults = [one for one in survey.findings(()) if one.severity != "info"]
        told, remedy = (faults[0].message, faults[0].remedy) if faults else ("no bag holds a message", "")
        raise SourceError(uri, f"nothing to inspect: {told.removeprefix(f'{uri}: ')}", remedy)
    keys = _with_offsets(first.keys, clocks, survey)
    camera = next((key for key in keys if key.kind == "camera"), None)
    frames = [counts[camera.key] for counts in lengths] if camera else []
    facts = {} if str(first.bag.path) == uri else {"keys and rates of": str(first.bag.path)}
    if budget.spent:
        facts["measured up to"] = f"{MAX_MESSAGES:,} messages or {MAX_BYTES >> 20:,} MiB; counts are whole"
    hz, robot = survey.key(camera).hz if camera else None, first.bag.notes().get("robot") or None
    return survey.inspection("rosbag", uri, keys, frames, facts, hz=hz, robot=robot)


def _with_offsets(keys: list[KeyInfo], clocks: list[dict[str, _Clock]], survey: Survey) -> list[KeyInfo]:
    """Add to topics with numbers how their messages lie between the frames of each camera."""
    cameras = [key.topic.name for key in keys if key.kind == "camera" and key.topic]
    topics = {key.topic.name: key.topic for key in keys if key.kind == "vector" and key.topic}
    for name, topic in topics.items():
        if name in LOG_TOPICS:
            continue
        by_header, by_receipt = [], []
        for camera in cameras:
            both = [(bag[name], bag[camera]) for bag in clocks if name in bag and camera in bag]
            by_header.append(measure_offset([(own.header, seen.header) for own, seen in both], camera))
            by_receipt.append(measure_offset([(own.receive, seen.receive) for own, seen in both], camera))
        timing = replace(topic.by_receipt, offsets=tuple(one for one in by_receipt if one))
        topics[name] = replace(topic, offsets=tuple(one for one in by_header if one), by_receipt=timing)
        survey.made |= {"offset"} if topics[name].offsets else set()
    return [replace(key, topic=topics.get(key.topic.name, key.topic)) if key.topic else key for key in keys]


class _BagInspection:
    """One bag, read once: its keys; its numbers, times, skew and some frames go to the survey.

    Attributes:
        clocks: of its topics with messages.

    Raises:
        EpisodeError: the bag is damaged.
    """

    def __init__(self, name: str, bag: Bag, survey: Survey, budget: _Budget) -> None:
        self.bag, self._name, self._survey = bag, name, survey
        self._frozen: list[str] = []
        self._topics = {
            topic: _Topic(TopicTrack(topic, str(bag.path)), count)
            for topic, count in sorted(bag.topics().items())
        }
        self._measure(budget)
        self.clocks = {
            name: _clock(topic.track.times) for name, topic in self._topics.items() if len(topic.track)
        }
        found = {name: self._keys(topic) for name, topic in self._topics.items()}
        if self._frozen:
            said = f"{', '.join(self._frozen[:8])}: header stamps never change; receive times are used"
            survey.note(Finding("stamps", "warn", said, numbers={"topics": self._frozen}))
        cameras = [name for name, keys in found.items() if keys[0].kind == "camera"]
        vectors = [name for name, keys in found.items() if any(key.kind == "vector" for key in keys)]
        self._skew(cameras, vectors)
        self.keys = [key for name, keys in found.items() for key in self._timed(name, keys, cameras)]

    def _measure(self, budget: _Budget) -> None:
        where = str(self.bag.path)
        for place, record in self.bag.records():
            budget.bytes, budget.messages = budget.bytes - len(record.data), budget.messages - 1
            if budget.spent:
                return
            name = record.channel.topic
            topic = self._topics.setdefault(name, _Topic(TopicTrack(name, where)))
            try:
                message = None if topic.fault else decode(record.channel, record.data, where)
                topic.track.add(record.channel, record.log_ns, place, message)
                if message is not None:
                    topic.look_at(message, where)
                for value in topic.values:
                    if len(value.held) > MAX_HELD:
                        value.hand_on(self._survey, self._name)
            except EpisodeError as fault:
                topic.fault = fault
                topic.track.add(record.channel, record.log_ns, place, None)

    def _keys(self, topic: _Topic) -> list[KeyInfo]:
        track, name = topic.track, topic.track.topic
        if not len(track):
            return [KeyInfo(name, "other", (), "", count=0)]
        if fault := topic.fault:
            self._survey.note(Finding("readable", "warn", fault.fault, fault.remedy, name))
        stated = track.channels[0]
        kind = track.kind
        if name not in LOG_TOPICS:
            self._times(track, bool(kind))
        found: list[KeyInfo] = []
        if not topic.fault:
            found = [self._camera(topic, kind)] if kind else _values(name, topic.sample)
        found = found or [KeyInfo(name, "other", (), stated.type or stated.encoding)]
        for value in topic.values:
            value.hand_on(self._survey, self._name)
        return found

    def _times(self, track: TopicTrack, camera: bool) -> None:
        """Hand the times to the survey; check what only messages with two times can show."""
        self._survey.made.add("stamps")
        self._frozen += [track.topic] if track.frozen else []
        times, remedy = track.times, ""
        if times.order("header") is None:
            remedy = times.set_back_error("header", str(self.bag.path)).remedy
        self._survey.times(self._name, track.topic, self.clocks[track.topic].header, camera, remedy)

    def _camera(self, topic: _Topic, kind: str) -> KeyInfo:
        name, track = topic.track.topic, topic.track
        stored = track.codec if kind == VIDEO else codec(topic.sample, kind)
        high = None
        try:
            stream = camera_stream(self.bag, track, "stored", levels=ALL_LEVELS)
            starts = _starts(track.keyframes()) if kind == VIDEO else None
            indices = checks.choose(len(stream.timestamps), PAIRS, starts)
            for run in checks.runs(indices):
                frames = stream.frames(run)
                self._survey.pictures(self._name, name, frames, run, stored)
            grey, stated = is_grey(topic.sample, kind), encoding(topic.sample, kind)
            if grey and stated == MONO16:
                messages = Messages(self.bag, track.channels, track.places()[track.times.by_receipt()], name)
                high = float(max(wide_grey(one, kind, name).max() for one in messages.read(indices)))
        except EpisodeError as fault:
            said = f"{name}: {fault.fault}"
            self._survey.note(Finding("readable", "warn", said, fault.remedy, name))
            return KeyInfo(name, "other", (), track.channels[0].type)
        return KeyInfo(
            name,
            "camera",
            (*frames.shape[1:3], 1 if grey else 3),
            "uint16" if high is not None else "uint8",
            codec=stored,
            encoding=stated or None,
            high=high,
        )

    def _timed(self, name: str, found: list[KeyInfo], cameras: list[str]) -> list[KeyInfo]:
        """Return the keys of a topic with its timing by both clocks."""
        topic = self._topics[name]
        if name not in self.clocks:
            return found
        own, times, stated = self.clocks[name], topic.track.times, topic.track.channels[0]
        seen = [] if name in cameras else [self.clocks[camera] for camera in cameras]
        by_header, by_receipt, clock = measure(own.header), measure(own.receive), times.clock()
        stamped = clock.by_header and not topic.fault
        # A topic is timed beside the first frame by receipt, which all topics share.
        held_s = float(min((one.receive[0] for one in seen), default=own.receive[-1]) - own.receive[-1])
        about = TopicInfo(
            name,
            stated.type or stated.encoding,
            gap_ms=_gap_ms(np.sort(own.header), [one.header for one in seen]),
            delay_ms=clock.delay_s * 1e3 if stamped else None,
            drift_ms=clock.drift_s * 1e3 if stamped else 0.0,
            goes_back=stamped and times.order("header") is None,
            receipt_goes_back=times.order("receive") is None,
            held_s=held_s if held_s > 0 else None,
            by_receipt=Timing(
                by_receipt.hz, by_receipt.jitter_ms, _gap_ms(own.receive, [one.receive for one in seen])
            ),
        )
        hz, jitter_ms = by_header.hz, by_header.jitter_ms
        return [replace(key, hz=hz, count=topic.count, jitter_ms=jitter_ms, topic=about) for key in found]

    def _skew(self, cameras: list[str], vectors: list[str]) -> None:
        """Measure the skew of each camera and vector stream from the frames of the first camera."""
        if not cameras:
            return
        primary = self.clocks[cameras[0]].header
        period_s = float(np.median(np.diff(np.sort(primary)))) if len(primary) > 1 else 0.0
        for name in [*cameras[1:], *vectors]:
            self._survey.skew(name, skew(self.clocks[name].header, primary), period_s)


def _clock(times: MessageTimes) -> _Clock:
    """Return the times of a topic by both clocks; those of a clock that was set back in order of receipt."""
    by_receipt = times.by_receipt()
    order = times.order("header")
    header = times.seconds("header")[by_receipt if order is None else order]
    return _Clock(header, times.seconds("receive")[by_receipt])


def _gap_ms(times: Floats, seen: list[Floats]) -> float | None:
    """Return the longest interval; leave out intervals in which no camera saw anything."""
    intervals = np.diff(times)
    if not len(intervals):
        return None
    if seen:
        during = np.searchsorted(times, np.concatenate(seen), side="right") - 1
        during = during[(during >= 0) & (during < len(intervals))]
        intervals = intervals[during] if len(during) else intervals
    return float(intervals.max() * 1e3)


def _starts(keyframes: Bools) -> Ints:
    """Return for each frame the keyframe before it, counted from the first."""
    shown = keyframes[int(np.argmax(keyframes)) :]
    return np.maximum.accumulate(np.where(shown, np.arange(len(shown)), 0))


# -- keys


def _values(key: str, value: Any, owners: tuple[Any, ...] = ()) -> list[KeyInfo]:
    """Return the keys that a YAML could name at or below a key; `owners` hold the value, innermost first."""
    if isinstance(value, str):
        return [KeyInfo(key, "text", (), "string")]
    if is_message_list(value):
        return _element_values(key, value, owners)
    if not is_message(value):
        return _vector(key, value, owners)
    names = field_names(value)
    if names and all(_is_number(child(value, name)) for name in names) and not _mixed(value):
        return [KeyInfo(key, "vector", (len(names),), "float64", names=tuple(names))]
    found: list[KeyInfo] = []
    for name in names:
        if name in ("header", "stamp", "timestamp"):
            continue
        inside = child(value, name)
        if name == "points" and is_message_list(inside) and "time_from_start" in field_names(inside[0]):
            # The first point of a JointTrajectory is in force when the message is sent.
            found += _values(f"{key}.points[0]", inside[0], (value, *owners))
        else:
            found += _values(f"{key}.{name}", inside, (value, *owners))
    return found


def _element_values(key: str, elements: Any, owners: tuple[Any, ...]) -> list[KeyInfo]:
    """Return the keys of a list of messages: each field over all elements, as of the motors of a robot.

    Points, poses and the like stay together: their fields mean nothing alone.
    """
    names = [name for name in field_names(elements[0]) if name not in ("header", "stamp", "timestamp")]
    if set(names) <= GEOMETRY:
        return _vector(key, elements, owners)
    found: list[KeyInfo] = []
    for name in names:
        inside = child_of_each(elements, name)
        if inside and (_is_number(inside[0]) or is_list(inside[0])):
            found += _vector(f"{key}.{name}", inside, (elements, *owners))
    return found


def _mixed(message: Any) -> bool:
    """Check whether whole numbers stand beside others: modes and counters beside measurements."""
    return len({isinstance(child(message, name), float | np.floating) for name in field_names(message)}) > 1


def _vector(key: str, value: Any, owners: tuple[Any, ...]) -> list[KeyInfo]:
    try:
        count = len(numbers(value))
    except TypeError:
        return []
    if not count:
        return []
    first = value[0] if isinstance(value, list) and len(value) else value
    dtype = "float64"
    if isinstance(first, np.ndarray | np.generic):
        dtype = str(first.dtype)
    elif isinstance(first, bool):
        dtype = "bool"
    elif isinstance(first, int):
        dtype = "int64"
    return [KeyInfo(key, "vector", (count,), dtype, names=value_names(owners, count) or None)]


def _is_number(value: Any) -> bool:
    return isinstance(value, bool | int | float | np.number | np.bool_)
