"""Read a topic of a bag in one pass: the numbers at its keys, and the times and places of its messages.

A camera's key is its topic. A number's key is the topic and a path into its messages:
`/joint_states.position`, `/joint_states.position[0:7]`, `/markers.poses[2].position.x`, `/cmd_vel`,
`/cmd_vel.linear` (a message of numbers gives them in the order of its fields), `/lowcmd.motors.q` (the
field of each message in a list).

Of a message only its times and its place are kept, a few bytes; a camera's frames are read again by these
places on demand. T messages of a topic, A values of a component; times are float64 seconds; the clock of a
topic is `header` or `receive`.
"""

import re
from array import array
from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

import numpy as np

from hma_data.arrays import Bools, Floats, Ints
from hma_data.episodes.episode import Stream
from hma_data.errors import EpisodeError, meant
from hma_data.registry.components import Component
from hma_data.sources.bags.bag import Bag, BagPlace
from hma_data.sources.bags.clocks import DAY_S, SECOND_NS, MessageTimes
from hma_data.sources.bags.container import Channel
from hma_data.sources.bags.images import (
    CODECS,
    VIDEO,
    Messages,
    StillStream,
    VideoStream,
    content_kind,
    has_b_slices,
    image_kind,
    is_keyframe,
    is_reordered,
    payload,
    video_codec,
)
from hma_data.sources.bags.messages import (
    NAMES_FIRST,
    child,
    field_names,
    is_list,
    is_message_list,
    numbers,
    stamp_ns,
    value_names,
)

STEP = re.compile(r"\.(?P<name>[A-Za-z_]\w*)|\[(?P<start>\d*)(?P<colon>:?)(?P<stop>\d*)\]")
Step = str | int | slice
MAX_NAMES = 30  # topics or names in an error
INT64 = np.iinfo(np.int64)


@dataclass(frozen=True)
class Field:
    """A key, parsed into its topic and the steps of its path."""

    key: str
    topic: str
    steps: tuple[Step, ...]

    def value(self, message: Any, where: str) -> Any:
        """Return the value at the key in a message.

        Raises:
            EpisodeError: there is none; the error names the fields that are there.
        """
        return self.path(message, where)[-1]

    def path(self, message: Any, where: str) -> list[Any]:
        """Return the message, what each step leads to, and last the value; see `value`.

        A field of a list of messages is that field of each of them.
        """
        found = [message]
        for step in self.steps:
            here = found[-1]
            if isinstance(step, str):
                try:
                    several = is_message_list(here)
                    found.append([child(one, step) for one in here] if several else child(here, step))
                except KeyError as fault:
                    known = ", ".join(field_names(here)) or "none, it is not a message"
                    raise EpisodeError(
                        where, f"{self.key}: there is no field {step!r}", f"the fields there: {known}"
                    ) from fault
                continue
            if not is_list(here):
                raise EpisodeError(where, f"{self.key}: the value before [ is not a list")
            if (step + 1 if isinstance(step, int) else step.stop or 0) > len(here):
                fault_of = f"{self.key}: the list has {len(here)} values in one of the messages"
                raise EpisodeError(where, fault_of)
            found.append(here[step])
        return found


def parse_key(key: str, topics: Iterable[str], where: str) -> Field:
    """Parse a key; its topic is the longest topic of the bag with which the key begins.

    Raises:
        EpisodeError: no topic fits, or the rest of the key is not a path.
    """
    topics = list(topics)
    fitting = [t for t in topics if key == t or (key.startswith(t) and key[len(t)] in ".[")]
    if not fitting:
        raise missing_topic(key, topics, where)
    topic = max(fitting, key=len)
    return Field(key, topic, _steps(key, len(topic), where))


def _steps(key: str, at: int, where: str) -> tuple[Step, ...]:
    steps: list[Step] = []
    while at < len(key):
        match = STEP.match(key, at)
        if not match or (not match["name"] and not match["colon"] and not match["start"]):
            raise EpisodeError(
                where, f"{key}: {key[at:]!r} is not a path", "write .field, [index] or [from:to]"
            )
        if match["name"]:
            steps.append(match["name"])
        elif match["colon"]:
            bounds = [int(bound) if bound else None for bound in (match["start"], match["stop"])]
            steps.append(slice(*bounds))
        else:
            steps.append(int(match["start"]))
        at = match.end()
    return tuple(steps)


def missing_topic(key: str, topics: Iterable[str], where: str) -> EpisodeError:
    """Return the error of a key whose topic the bag does not have."""
    known = sorted(" ".join(topic.split()) for topic in topics)
    hint = meant(re.split(r"[.\[]", key)[0], known, 2, cutoff=0.5)
    more = f" and {len(known) - MAX_NAMES} more" if len(known) > MAX_NAMES else ""
    listed = f"its topics: {', '.join(known[:MAX_NAMES])}{more}" if known else "it has no topics"
    return EpisodeError(where, f"the bag has no topic for {key}", f"{hint} {listed}".lstrip())


class Column:
    """The values of one component, gathered message by message.

    Where a message names its values (see `value_names`), the component's `names` select and order them,
    unless the key or the YAML slices. Otherwise all messages must name the same. Messages of another
    publisher, with none of the component's names, are left out.
    """

    def __init__(self, component: Component, field: Field, where: str) -> None:
        self.component, self.field = component, field
        self._where = where
        self._values, self._rows = array("d"), array("q")
        self._width: int | None = None
        self._names: tuple[str, ...] = ()  # of the values, where they are not selected by names
        # The place in a path of the values that the last field has, before an index or a slice of them.
        self._whole = max((i for i, step in enumerate(field.steps, 1) if isinstance(step, str)), default=0)
        self._picks: dict[tuple[str, ...], list[int] | None] = {}
        whole = not component.slice and field.steps and isinstance(field.steps[-1], str)
        self._selects = bool(component.names and whole)

    def add(self, message: Any, row: int) -> None:
        """Add the values of message `row`."""
        path = self.field.path(message, self._where)
        value = path[-1]
        try:
            values = numbers(value)
        except TypeError as fault:
            known = ", ".join(field_names(value))
            raise EpisodeError(
                self._where,
                f"{self.field.key} holds {fault}, not only numbers",
                f"name a field of it: {known}" if known else "",
            ) from fault
        if self._selects:
            picks = self._pick(path, len(values))
            if picks is None:
                return
            values = [values[i] for i in picks]
        else:
            self._require_names(self._names_in(path), row)
        if not values:
            raise EpisodeError(self._where, f"{self.field.key} is empty in message {row}")
        self._width = self._width or len(values)
        if len(values) != self._width:
            said = f"{self.field.key} has {self._width} values, then {len(values)} in message {row}"
            raise EpisodeError(self._where, said)
        self._values.extend(values)
        self._rows.append(row)

    def _names_in(self, path: list[Any]) -> tuple[str, ...]:
        """Return the names of the values; where an index chooses one message of a list, its name."""
        if is_list(path[self._whole]):
            return value_names(path[self._whole - 1 :: -1], len(path[self._whole]))
        chosen = [[found] for found, step in zip(path[1:], self.field.steps) if isinstance(step, int)]
        return value_names([one for one in chosen if is_message_list(one)], 1)

    def _require_names(self, names: tuple[str, ...], row: int) -> None:
        """Raise EpisodeError if a message, maybe of another publisher, has other joints or another order."""
        if self._names and names and names != self._names:
            before, now = ", ".join(self._names), ", ".join(names)
            fault = f"{self.field.key} is of {before}, then of {now} in message {row}"
            remedy = "give the component names in the YAML, without a slice or an index"
            raise EpisodeError(self._where, fault, remedy)
        self._names = self._names or names

    def rows(self) -> Ints:
        """Return the indices of the messages that gave values.

        Raises:
            EpisodeError: none did.
        """
        if not self._rows:
            seen = sorted({name for names in self._picks for name in names})[:MAX_NAMES]
            names = ", ".join(self.component.names or ())
            raise EpisodeError(
                self._where, f"{self.field.key}: no message names {names}", f"names there: {', '.join(seen)}"
            )
        return np.frombuffer(self._rows, np.int64)

    def values(self) -> Floats:
        """Return the values (T, A) as recorded."""
        return np.frombuffer(self._values, np.float64).reshape(len(self._rows), -1)

    def _pick(self, path: list[Any], width: int) -> list[int] | None:
        """Return the indices of the wanted names; None where the message has none of them."""
        owners = path[-2::-1]
        names = value_names(owners, width)
        if not names:
            beside = next((name for name in NAMES_FIRST if name in field_names(owners[0])), "")
            stated = child(owners[0], beside) if beside else ()
            if not is_list(stated) or not len(stated):
                return list(range(width))
            names = tuple(map(str, stated))  # as many names as values are wanted beside them
        if names not in self._picks:
            self._picks[names] = self._indices(names)
        picks = self._picks[names]
        if picks is not None and len(names) != width:
            raise EpisodeError(self._where, f"{self.field.key} has {width} values for {len(names)} names")
        return picks

    def _indices(self, names: tuple[str, ...]) -> list[int] | None:
        wanted = self.component.names or ()
        absent = [name for name in wanted if name not in names]
        if len(absent) == len(wanted):
            return None
        if absent:
            raise EpisodeError(
                self._where,
                f"{self.field.key}: a message lacks {', '.join(absent)}",
                f"it names {', '.join(names)}",
            )
        return [names.index(name) for name in wanted]


class TopicTrack:
    """The times and places of one topic's messages, recorded in one pass.

    Attributes:
        columns: the components that read this topic; each takes its values as messages are added.
        channels: the channels of the messages, usually one.
        kind: raw, still or video, by the content of the messages; None without images.
        codec: of video; empty for anything else.
        b_slices: whether some frames of H.264 are stored after frames that are shown later.

    Args:
        where: the bag, for errors.
    """

    def __init__(self, topic: str, where: str) -> None:
        self.topic, self._where = topic, where
        self.columns: list[Column] = []
        self.channels: list[Channel] = []
        self.kind: str | None = None
        self.codec = ""
        self.b_slices = False
        self._log_ns, self._stamp_ns, self._places = array("q"), array("q"), array("q")
        self._keyframes: list[bool] = []

    def __len__(self) -> int:
        return len(self._log_ns)

    def add(self, channel: Channel, log_ns: int, place: BagPlace, message: Any) -> None:
        """Add the next message; a message that cannot be decoded is None, and keeps its time of receipt.

        Raises:
            EpisodeError: it is of another type than those before, or does not have what a column reads.
        """
        if channel not in self.channels:
            if message is not None and self.channels and channel.type != self.channels[0].type:
                fault = f"{self.topic} carries {self.channels[0].type} and {channel.type}"
                raise EpisodeError(self._where, fault, "filter the recording to one of them")
            self.kind = content_kind(message, image_kind(channel.type))
            self.channels.append(channel)
        for column in self.columns:
            column.add(message, len(self))
        if message is not None and self.kind == VIDEO:
            self._keyframes.append(self._is_keyframe(message))
        self._log_ns.append(min(log_ns, INT64.max))
        self._stamp_ns.append(min(max(stamp_ns(message, log_ns), INT64.min), INT64.max))
        self._places.extend((*place, self.channels.index(channel)))

    def _is_keyframe(self, message: Any) -> bool:
        try:
            self.codec = self.codec or video_codec(message)
            if self.codec not in CODECS:
                fault = f"{self.topic}: video in {self.codec!r} cannot be read"
                raise EpisodeError(self._where, fault, f"these can: {', '.join(CODECS)}")
            data = payload(message)
            self.b_slices = self.b_slices or (self.codec == "h264" and has_b_slices(data))
            return is_keyframe(data, self.codec)
        except (KeyError, TypeError, ValueError) as fault:
            said = f"{self.topic}: a message is not a frame of a video: {fault!r}"
            raise EpisodeError(self._where, said) from fault

    @property
    def times(self) -> MessageTimes:
        """Return the times of the messages; none can be added while the caller holds them.

        A stamp of 0 is none, but a simulation's first messages may have it, at the start of its clock.
        """
        stamps = np.frombuffer(self._stamp_ns, np.int64)
        zeros = int(np.argmax(stamps != 0)) if len(stamps) else 0
        begins = not zeros or stamps[zeros] < DAY_S * SECOND_NS
        known = bool(len(stamps) and begins and np.all(stamps[zeros:])) and not self.frozen
        received = np.frombuffer(self._log_ns, np.int64)
        return MessageTimes(self.topic, received, stamps if known else None, self.places()[:, 0])

    @property
    def frozen(self) -> bool:
        """Check whether the messages' own times never change: such stamps are not a clock."""
        stamps = np.frombuffer(self._stamp_ns, np.int64)
        return bool(len(stamps) > 1 and stamps[0] and np.all(stamps == stamps[0]))

    def places(self) -> Ints:
        """Return (T, 4): file, two numbers of the place in it, index into `channels`."""
        return np.frombuffer(self._places, np.int64).reshape(-1, 4)

    def keyframes(self) -> Bools:
        """Return (T,) whether decoding can begin at a message."""
        return np.array(self._keyframes, bool)


# -- cameras


def camera_stream(
    bag: Bag,
    track: TopicTrack,
    clock: str,
    shown: tuple[int, int] | None = None,
    levels: tuple[float, float] | None = None,
) -> Stream:
    """Return the stream of a camera whose topic was recorded.

    Args:
        clock: header, receive, or stored for the order of the file.
        shown: [from, to) of the frames, in order of receipt; all by default. Video may need other
            messages too, to be decoded.
        levels: of the camera, for frames in mono16.

    Raises:
        EpisodeError: the topic holds no images, or video that never begins; or the clock was set back.
    """
    where = f"{bag.path}, {track.topic}"
    if track.kind is None:
        stated = track.channels[0].type or track.channels[0].encoding
        raise EpisodeError(where, f"holds {stated}, not images", "name a topic of images as the camera's key")
    times = track.times
    rows = times.by_receipt()
    begin, stop = shown or (0, len(rows))
    if track.kind == VIDEO:
        return _video_stream(bag, track, clock, (begin, stop), where)
    rows = np.sort(rows[begin:stop])
    rows = rows[times[rows].order_or_raise(clock, where)]
    messages = Messages(bag, track.channels, track.places()[rows], where)
    return StillStream(times.seconds(clock)[rows], messages, track.kind, levels)


def _video_stream(bag: Bag, track: TopicTrack, clock: str, shown: tuple[int, int], where: str) -> VideoStream:
    begin, stop = shown
    times = track.times
    rows = times.by_receipt()
    keyframes = track.keyframes()
    key_places = np.flatnonzero(keyframes[rows])
    if not len(key_places):
        raise EpisodeError(where, f"the {track.codec} video has no key frame")
    reorders = track.b_slices
    if track.codec == "h265":
        head = Messages(bag, track.channels, track.places()[rows[key_places[:1]]], where)
        reorders = is_reordered(payload(next(head.read([0]))), track.codec)
        if reorders:  # frames shown before a key frame may be stored after it, and need what precedes it
            key_places = key_places[:1]
            keyframes = np.arange(len(track)) == rows[key_places[0]]
    # Messages before the first key frame cannot be decoded.
    earlier = key_places[key_places <= begin]
    first = int(earlier[-1] if len(earlier) else key_places[0])
    begin = max(begin, first)
    if begin >= stop:
        raise EpisodeError(where, f"the {track.codec} video has no key frame before frame {stop}")
    if reorders:  # the last frames may build on messages up to the next key frame
        later = key_places[key_places >= stop]
        rows = np.sort(rows[first : int(later[0]) if len(later) else len(rows)])
        times = times[rows]
        seconds = times.seconds(clock)[times.order_or_raise(clock, where)]
    else:
        rows = np.sort(rows[first:stop])
        rows = rows[times[rows].order_or_raise(clock, where)]
        overtaken = int(np.argmax(keyframes[rows]))  # messages that arrived late, from before the key frame
        rows, begin = rows[overtaken:], max(begin - overtaken, first)
        seconds = times.seconds(clock)[rows]
    messages = Messages(bag, track.channels, track.places()[rows], where)
    decoder_rows = keyframes[rows]
    return VideoStream(
        seconds[begin - first : stop - first], messages, decoder_rows, track.codec, begin - first, reorders
    )
