"""What `hma inspect` tells of bags: topics with rates and jitter, keys as a YAML would name them.

Every bag is counted by its index; the first that can be read is measured message by message, up
to a limit.
"""

from collections import Counter
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.episode import Floats
from hma_data.errors import EpisodeError, SourceError
from hma_data.sources.bags.bag import Bag
from hma_data.sources.bags.container import Channel
from hma_data.sources.bags.messages import child, decode, field_names, is_list, is_message, numbers
from hma_data.sources.bags.pictures import VIDEO, codec, is_grey, picture_kind
from hma_data.sources.bags.streams import camera_stream
from hma_data.sources.bags.track import Track
from hma_data.sources.base import Inspection, KeyInfo, TopicInfo
from hma_data.sources.findings import Finding

MAX_BYTES = 1 << 30  # of messages measured
MAX_MESSAGES = 300_000
MAX_LENGTHS = 1000
APART_S = 1.0  # header stamps further than this from receive times are worth a word
PAUSE, PAUSE_S = 10, 0.5  # median intervals, and seconds


@dataclass
class _Topic:
    """A topic while it is measured; `sample` is its first message, or that which names most joints."""

    track: Track
    count: int = 0
    sample: Any = None
    named: int = 0
    fault: str = ""
    problems: list[str] = field(default_factory=list)

    def look_at(self, message: Any) -> None:
        """Two publishers of one JointState topic name different joints."""
        named = child(message, "name") if "name" in field_names(message) else ""
        count = len(named) if is_list(named) else 0
        if self.sample is None or count > self.named:
            self.sample, self.named = message, count


def report(uri: str, root: Path, bags: dict[str, Path], episodes: int) -> Inspection:
    """The inspection of those bags.

    Raises:
        SourceError: none of them can be read.
    """
    counted: dict[str, Counter[Channel]] = {}
    faults: list[str] = []
    measured: tuple[Bag, dict[str, _Topic], bool] | None = None
    for name, path in bags.items():
        try:
            bag = Bag(path, root)
            counted[name] = bag.counts()
            if measured is None and counted[name].total():
                measured = (bag, *_measure(bag))
        except EpisodeError as fault:
            counted.pop(name, None)
            faults.append(str(fault))
    if measured is None:
        detail = faults[0] if faults else "no bag holds a message"
        raise SourceError(uri, f"nothing to inspect: {detail}")
    return _inspection(uri, measured, counted, len(bags), faults)


def _inspection(
    uri: str,
    measured: tuple[Bag, dict[str, _Topic], bool],
    counted: dict[str, Counter[Channel]],
    episodes: int,
    faults: list[str],
) -> Inspection:
    bag, topics, whole = measured
    counts = bag.counts()
    for topic in topics.values():
        topic.count = sum(count for channel, count in counts.items() if channel.topic == topic.track.topic)
    keys = [key for topic in topics.values() for key in _keys(bag, topic)]
    cameras = [key for key in keys if key.kind == "camera"]
    lengths = tuple(_length(counts, cameras) for counts in counted.values()) if cameras else ()
    facts = {"measured": str(bag.path)}
    if not whole:
        facts["measured up to"] = f"{MAX_MESSAGES:,} messages or {MAX_BYTES >> 20:,} MiB; counts are whole"
    return Inspection(
        format="rosbag",
        uri=uri,
        episodes=episodes,
        keys=tuple(keys),
        frames=sum(lengths) if cameras and not faults else None,
        lengths=lengths[:MAX_LENGTHS],
        hz=cameras[0].hz if cameras else None,
        robot=bag.notes().get("robot") or None,
        findings=tuple(
            Finding("recording", "warn", said)
            for said in (*faults, *(line for topic in topics.values() for line in topic.problems))
        ),
        facts=facts,
    )


def _length(counts: Counter[Channel], cameras: list[KeyInfo]) -> int:
    return sum(count for channel, count in counts.items() if channel.topic == cameras[0].key)


def _measure(bag: Bag) -> tuple[dict[str, _Topic], bool]:
    """Topics by name, and whether the bag was read to its end."""
    topics = {name: _Topic(Track(name)) for name in sorted({channel.topic for channel in bag.counts()})}
    read = messages = 0
    for place, record in bag.records():
        read, messages = read + len(record.data), messages + 1
        if read > MAX_BYTES or messages > MAX_MESSAGES:
            return topics, False
        topic = topics.setdefault(record.channel.topic, _Topic(Track(record.channel.topic)))
        try:
            message = None if topic.fault else decode(record.channel, record.data, str(bag.path))
            topic.track.add(record.channel, record.log_ns, place, message)
            topic.look_at(message)
        except EpisodeError as fault:
            topic.fault = fault.fault
            topic.track.add(record.channel, record.log_ns, place, None)
    return topics, True


# -- times


def _times(topic: _Topic) -> Floats:
    """Sorted by receipt; faults in them are noted as problems."""
    track, name = topic.track, topic.track.topic
    if topic.fault:
        topic.problems.append(topic.fault)
    times = track.seconds("header")[track.order()]
    steps = np.diff(times)
    twice, back = int(np.sum(steps == 0)), int(np.sum(steps < 0))
    if twice:
        topic.problems.append(f"{name}: {twice} stamps are the one before again")
    if back:
        topic.problems.append(f"{name}: {back} stamps go back in time; stamp: receive would not")
    if track.frozen:
        topic.problems.append(f"{name}: header stamps never move; receive times are used")
    if track.stamped:
        apart = float(np.median(np.abs(track.seconds("header") - track.seconds("receive"))))
        if apart > APART_S:
            topic.problems.append(f"{name}: header stamps are {apart:.3g} s from receive times")
    period = float(np.median(steps)) if len(steps) else 0.0
    if period > 0 and steps.max() > max(PAUSE * period, PAUSE_S):
        at = int(np.argmax(steps))
        topic.problems.append(f"{name}: pauses for {steps[at]:.3g} s after {times[at] - times.min():.3g} s")
    return times


def _rate(times: Floats) -> tuple[float | None, float | None]:
    """Hz and jitter_ms, the standard deviation of the intervals.

    The rate is of the median interval, which a pause does not change; of the mean one where bursts
    make them differ by half.
    """
    steps = np.diff(times)
    if len(steps) < 2 or steps.sum() <= 0:
        return None, None
    median, mean = float(np.median(steps)), float(np.mean(steps))
    period = median if 1 / 1.5 < median / mean < 1.5 else mean
    return 1 / period, float(np.std(steps) * 1e3)


# -- keys


def _keys(bag: Bag, topic: _Topic) -> list[KeyInfo]:
    if not len(topic.track):
        return [KeyInfo(topic.track.topic, "other", (), "", count=0)]
    times = _times(topic)
    hz, jitter_ms = _rate(times)
    stated = topic.track.channels[0]
    kind = picture_kind(stated.type)
    found: list[KeyInfo] = []
    if not topic.fault:
        found = [_camera(bag, topic, kind)] if kind else _values(topic.track.topic, topic.sample)
    found = found or [KeyInfo(topic.track.topic, "other", (), stated.type or stated.encoding)]
    about = _about(topic, times, stated.type or stated.encoding)
    return [replace(key, hz=hz, count=topic.count, jitter_ms=jitter_ms, topic=about) for key in found]


def _about(topic: _Topic, times: Floats, kind: str) -> TopicInfo:
    track, steps = topic.track, np.diff(times)
    delay_ms = None
    if track.stamped and not topic.fault:
        delay_ms = float(np.median(track.seconds("receive") - track.seconds("header")) * 1e3)
    return TopicInfo(
        track.topic,
        kind,
        gap_ms=float(steps.max() * 1e3) if len(steps) else None,
        delay_ms=delay_ms,
        goes_back=bool(len(steps) and steps.min() < 0),
    )


def _camera(bag: Bag, topic: _Topic, kind: str) -> KeyInfo:
    name = topic.track.topic
    try:
        height, width = camera_stream(bag, topic.track, "receive").frames([0]).shape[1:3]
    except EpisodeError as fault:
        topic.problems.append(f"{name}: {fault.fault}")
        return KeyInfo(name, "other", (), topic.track.channels[0].type)
    stored = topic.track.codec if kind == VIDEO else codec(topic.sample, kind)
    channels = 1 if is_grey(topic.sample, kind) else 3
    return KeyInfo(name, "camera", (height, width, channels), "uint8", codec=stored)


def _values(key: str, value: Any) -> list[KeyInfo]:
    """What a YAML could name at or below that key."""
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
    """The first point of a JointTrajectory, the one in force when it is sent."""
    points: Any = child(value, "points") if {"points", "joint_names"} <= set(names) else ()
    if not is_list(points) or not len(points) or not is_message(points[0]):
        return []
    stated = child(value, "joint_names")
    labels = tuple(map(str, stated)) if is_list(stated) else ()
    found = _values(f"{key}.points[0]", points[0])
    fits = [bool(labels) and item.shape == (len(labels),) for item in found]
    return [replace(item, names=labels) if fit else item for item, fit in zip(found, fits, strict=True)]


def _named(found: list[KeyInfo], owner: Any, name: str) -> list[KeyInfo]:
    """With the names of the owner's list `name`, where it has one of that length (JointState)."""
    labels = child(owner, "name") if "name" in field_names(owner) and name != "name" else ()
    if len(found) != 1 or not is_list(labels) or found[0].shape != (len(labels),) or not len(labels):
        return found
    return [replace(found[0], names=tuple(map(str, labels)))]


def _vector(key: str, value: Any) -> list[KeyInfo]:
    try:
        count = len(numbers(value))
    except TypeError:
        return []
    dtype = str(value.dtype) if isinstance(value, np.ndarray) else "float64"
    return [KeyInfo(key, "vector", (count,), dtype)] if count else []


def _is_number(value: Any) -> bool:
    return isinstance(value, bool | int | float | np.number | np.bool_)
