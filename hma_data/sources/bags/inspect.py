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

from hma_data.episodes.episode import Floats
from hma_data.episodes.offset import measure as measure_offset
from hma_data.errors import EpisodeError, SourceError
from hma_data.sources.bags.bag import Bag
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
    decode,
    field_names,
    is_list,
    is_message,
    numbers,
)
from hma_data.sources.bags.topic_track import Field, TopicTrack, camera_stream, parse_key
from hma_data.sources.common import checks
from hma_data.sources.common.checks import Finding, StreamTimes, measure, skew
from hma_data.sources.common.inspection import Inspection, KeyInfo, TopicInfo
from hma_data.sources.common.places import unfollowed
from hma_data.sources.common.survey import Survey, sampled

MAX_BYTES = 1 << 30  # of messages measured, over all bags
MAX_MESSAGES = 300_000
MAX_LENGTHS = 1000
MAX_FIELDS = 64  # most numeric keys of a topic whose values are checked
MAX_HELD = 1 << 16  # most numbers of a key in memory
MAX_WIDTH = 4096  # most values of an action or state; wider fields are maps or point clouds
LOGS = ("/rosout", "/rosout_agg", "/parameter_events", "/diagnostics", "/diagnostics_agg")  # not streams
PAIRS = 4  # runs of neighbouring frames looked at, for a camera
APART_S = 1.0  # header stamps further than this from receive times are reported
WHOLE = (0.0, 65535.0)  # levels at which frames in mono16 are looked at


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
    fault: str = ""
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
    """The times (T,) of one topic of one bag, by both clocks, in order of receipt."""

    header: Floats
    receive: Floats

    def beside(self, other: "_Clock") -> tuple[Floats, Floats]:
        """Return the times of both topics; by receipt where their header stamps are not of one clock."""
        delays = [float(np.median(one.receive - one.header)) for one in (self, other)]
        back = any((np.diff(one.header) < 0).any() for one in (self, other))
        if back or abs(delays[0] - delays[1]) > APART_S:
            return self.receive, other.receive
        return self.header, other.header


@dataclass
class _Budget:
    """The bytes and messages that may still be read."""

    bytes: int = MAX_BYTES
    messages: int = MAX_MESSAGES

    @property
    def spent(self) -> bool:
        return self.bytes < 0 or self.messages < 0


def report(uri: str, root: Path, bags: dict[str, Path], episodes: int) -> Inspection:
    """Return the inspection of bags.

    Raises:
        SourceError: none of them can be read.
    """
    survey, budget = Survey(len(bags), alone=len(bags) == 1, by_field=True), _Budget()
    for link in unfollowed(root, set(bags.values())):
        survey.note(link)
    opened: dict[str, Bag] = {}
    lengths: list[Counter[str]] = []  # of each bag: messages by topic
    for name, path in bags.items():
        try:
            bag = Bag(path, root)
            counts: Counter[str] = Counter()
            for channel, count in bag.counts().items():
                counts[channel.topic] += count
        except EpisodeError as fault:
            survey.fault(name, fault)
            continue
        lengths.append(counts)
        if counts.total():
            opened[name] = bag
        else:
            survey.note(Finding("readable", "info", f"{path}: holds no messages"))
    first: _BagInspection | None = None
    clocks: list[dict[str, _Clock]] = []
    names = list(opened)
    for name in [names[i] for i in sampled(len(names), episodes)] if names else []:
        try:
            looked = _BagInspection(name, opened[name], survey, budget)
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
        own = told.removeprefix(f"{uri}: ")
        raise SourceError(uri, own if own != told else f"nothing to inspect: {told}", remedy)
    keys = tuple(survey.key(key) for key in _with_offsets(first.keys, clocks, survey))
    camera = next((key for key in keys if key.kind == "camera"), None)
    frames = [counts[camera.key] for counts in lengths] if camera else []
    facts = {} if str(first.bag.path) == uri else {"keys and rates of": str(first.bag.path)}
    if budget.spent:
        facts["measured up to"] = f"{MAX_MESSAGES:,} messages or {MAX_BYTES >> 20:,} MiB; counts are whole"
    return Inspection(
        format="rosbag",
        uri=uri,
        episodes=len(bags),
        keys=keys,
        frames=sum(frames) if camera and len(lengths) == len(bags) else None,
        lengths=tuple(frames[:MAX_LENGTHS]),
        hz=camera.hz if camera else None,
        robot=first.bag.notes().get("robot") or None,
        facts=facts,
        looked_at=len(survey.looked),
        findings=survey.findings(keys),
        checks=survey.checks(),
    )


def _with_offsets(keys: list[KeyInfo], clocks: list[dict[str, _Clock]], survey: Survey) -> list[KeyInfo]:
    """Add to topics with numbers how their messages lie between the frames of each camera."""
    cameras = [key.topic.name for key in keys if key.kind == "camera" and key.topic]
    topics = {key.topic.name: key.topic for key in keys if key.kind == "vector" and key.topic}
    for name, topic in topics.items():
        found = [
            measure_offset(
                [bag[name].beside(bag[camera]) for bag in clocks if name in bag and camera in bag], camera
            )
            for camera in cameras
            if name not in LOGS
        ]
        topics[name] = replace(topic, offsets=tuple(one for one in found if one))
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
        counts = bag.counts()
        self._topics = {topic: _Topic(TopicTrack(topic)) for topic in sorted({at.topic for at in counts})}
        for channel, count in counts.items():
            self._topics[channel.topic].count += count
        self._measure(budget)
        self.keys = [key for topic in self._topics.values() for key in self._keys(topic)]
        if self._frozen:
            said = f"{', '.join(self._frozen[:8])}: header stamps never change; receive times are used"
            survey.note(Finding("stamps", "warn", said, numbers={"topics": self._frozen}))
        self._skew()
        self.keys = self._with_gaps()
        self.clocks: dict[str, _Clock] = {}
        for name, topic in self._topics.items():
            if len(topic.track):
                order = topic.track.by_receipt()
                times = [topic.track.seconds(clock)[order] for clock in ("header", "receive")]
                self.clocks[name] = _Clock(*times)

    def _measure(self, budget: _Budget) -> None:
        where = str(self.bag.path)
        for place, record in self.bag.records():
            budget.bytes, budget.messages = budget.bytes - len(record.data), budget.messages - 1
            if budget.spent:
                return
            topic = self._topics.setdefault(record.channel.topic, _Topic(TopicTrack(record.channel.topic)))
            try:
                message = None if topic.fault else decode(record.channel, record.data, where)
                topic.track.add(record.channel, record.log_ns, place, message)
                if message is not None:
                    topic.look_at(message, where)
                for value in topic.values:
                    if len(value.held) > MAX_HELD:
                        value.hand_on(self._survey, self._name)
            except EpisodeError as fault:
                topic.fault = fault.fault
                topic.track.add(record.channel, record.log_ns, place, None)

    def _keys(self, topic: _Topic) -> list[KeyInfo]:
        track, name = topic.track, topic.track.topic
        if not len(track):
            return [KeyInfo(name, "other", (), "", count=0)]
        if topic.fault:
            self._survey.note(Finding("readable", "warn", topic.fault, key=name))
        stated = track.channels[0]
        kind = image_kind(stated.type)
        times = track.seconds("header")[track.by_receipt()]
        measured = measure(times) if name in LOGS else self._times(track, times, bool(kind))
        found: list[KeyInfo] = []
        if not topic.fault:
            found = [self._camera(topic, kind)] if kind else _values(name, topic.sample)
        found = found or [KeyInfo(name, "other", (), stated.type or stated.encoding)]
        for value in topic.values:
            value.hand_on(self._survey, self._name)
        steps, delay_ms = np.diff(times), None
        if track.stamped and not topic.fault:
            delay_ms = float(np.median(track.seconds("receive") - track.seconds("header")) * 1e3)
        about = TopicInfo(
            name,
            stated.type or stated.encoding,
            gap_ms=float(steps.max() * 1e3) if len(steps) else None,
            delay_ms=delay_ms,
            goes_back=bool(len(steps) and steps.min() < 0),
        )
        hz, jitter_ms = measured.hz, measured.jitter_ms
        return [replace(key, hz=hz, count=topic.count, jitter_ms=jitter_ms, topic=about) for key in found]

    def _times(self, track: TopicTrack, times: Floats, camera: bool) -> StreamTimes:
        """Hand the times to the survey; check what only messages with two times can show."""
        self._survey.made.add("stamps")
        self._frozen += [track.topic] if track.frozen else []
        if track.stamped:
            apart = float(np.median(np.abs(track.seconds("header") - track.seconds("receive"))))
            if apart > APART_S:
                said = f"{track.topic}: header stamps are {apart:.3g} s from receive times"
                self._survey.note(
                    Finding("stamps", "warn", said, key=track.topic, numbers={"seconds": apart})
                )
        return self._survey.times(self._name, track.topic, times, camera)

    def _camera(self, topic: _Topic, kind: str) -> KeyInfo:
        name, track = topic.track.topic, topic.track
        stored = track.codec if kind == VIDEO else codec(topic.sample, kind)
        high = None
        try:
            stream = camera_stream(self.bag, track, "receive", levels=WHOLE)
            keyframes = track.keyframes() if kind == VIDEO else None
            indices = checks.choose(len(stream.timestamps), PAIRS, _starts(keyframes))
            for run in checks.runs(indices):
                frames = stream.frames(run)
                self._survey.pictures(self._name, name, frames, run, stored)
            grey, stated = is_grey(topic.sample, kind), encoding(topic.sample, kind)
            if grey and stated == MONO16:
                messages = Messages(self.bag, track.channels, track.places()[track.by_receipt()], name)
                high = float(max(wide_grey(one, kind, name).max() for one in messages.read(indices)))
        except EpisodeError as fault:
            self._survey.note(Finding("readable", "warn", f"{name}: {fault.fault}", key=name))
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

    def _with_gaps(self) -> list[KeyInfo]:
        """Return the keys; leave intervals in which no camera saw anything out of the topics' `gap_ms`."""
        names = {key.topic.name for key in self.keys if key.kind == "camera" and key.topic}
        seen = [self._topics[name].track.seconds("header") for name in names]
        return [
            replace(key, topic=replace(key.topic, gap_ms=self._gap_ms(key.topic, np.concatenate(seen))))
            if seen and key.topic and key.topic.name not in names
            else key
            for key in self.keys
        ]

    def _gap_ms(self, topic: TopicInfo, seen: Floats) -> float | None:
        times = np.sort(self._topics[topic.name].track.seconds("header"))
        during = np.searchsorted(times, seen, side="right") - 1
        during = during[(during >= 0) & (during < len(times) - 1)]
        return float(np.diff(times)[during].max() * 1e3) if len(during) else topic.gap_ms

    def _skew(self) -> None:
        """Measure the skew of each camera and vector stream from the frames of the first camera."""
        topics = {
            key.topic.name: key.kind for key in self.keys if key.topic and key.kind in ("camera", "vector")
        }
        cameras = [name for name, kind in topics.items() if kind == "camera"]
        if not cameras:
            return
        primary = self._topics[cameras[0]].track.seconds("header")
        period_s = float(np.median(np.diff(np.sort(primary)))) if len(primary) > 1 else 0.0
        for name in topics:
            if name != cameras[0]:
                found = skew(self._topics[name].track.seconds("header"), primary)
                self._survey.skew(name, found, period_s)


def _starts(keyframes: Any) -> Any:
    """Return for each frame the keyframe before it, counted from the first; None where it is unknown."""
    if keyframes is None or not keyframes.any():
        return None
    shown = keyframes[int(np.argmax(keyframes)) :]
    return np.maximum.accumulate(np.where(shown, np.arange(len(shown)), 0))


# -- keys


def _values(key: str, value: Any) -> list[KeyInfo]:
    """Return the keys that a YAML could name at or below a key."""
    if isinstance(value, str):
        return [KeyInfo(key, "text", (), "string")]
    if not is_message(value):
        return _vector(key, value)
    names = field_names(value)
    if names and all(_is_number(child(value, name)) for name in names):
        return [KeyInfo(key, "vector", (len(names),), "float64", names=tuple(names))]
    trajectory = _trajectory(key, value, names)
    return trajectory + [
        found
        for name in names
        if name not in ("header", "stamp", "timestamp") and not (trajectory and name == "points")
        for found in _named(_values(f"{key}.{name}", child(value, name)), value, name)
    ]


def _trajectory(key: str, value: Any, names: list[str]) -> list[KeyInfo]:
    """Return the first point of a JointTrajectory, which is in force when the message is sent."""
    points: Any = child(value, "points") if {"points", "joint_names"} <= set(names) else ()
    if not is_list(points) or not len(points) or not is_message(points[0]):
        return []
    stated = child(value, "joint_names")
    labels = tuple(map(str, stated)) if is_list(stated) else ()
    found = _values(f"{key}.points[0]", points[0])
    fits = [bool(labels) and item.shape == (len(labels),) for item in found]
    return [replace(item, names=labels) if fit else item for item, fit in zip(found, fits, strict=True)]


def _named(found: list[KeyInfo], owner: Any, name: str) -> list[KeyInfo]:
    """Add the names from the owner's list `name`, where that list has the vector's length (JointState)."""
    labels = child(owner, "name") if "name" in field_names(owner) and name != "name" else ()
    if len(found) != 1 or not is_list(labels) or found[0].shape != (len(labels),) or not len(labels):
        return found
    return [replace(found[0], names=tuple(map(str, labels)))]


def _vector(key: str, value: Any) -> list[KeyInfo]:
    try:
        count = len(numbers(value))
    except TypeError:
        return []
    dtype = "bool" if isinstance(value, bool) else "float64"
    if isinstance(value, np.ndarray | np.generic):
        dtype = str(value.dtype)
    return [KeyInfo(key, "vector", (count,), dtype)] if count else []


def _is_number(value: Any) -> bool:
    return isinstance(value, bool | int | float | np.number | np.bool_)
