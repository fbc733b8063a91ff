"""Read the numbers at the keys of bags.

A camera's key is its topic. A number's key is the topic and a path into its messages:
`/joint_states.position`, `/joint_states.position[0:7]`, `/markers.poses[2].position.x`, `/cmd_vel`,
`/cmd_vel.linear` (a message of numbers gives them in the order of its fields).

A key's dtype is the one in the message definition: ROS messages are looked up in the typestore, protobuf
messages in their descriptor; JSON states none.

T messages of a topic, A values of a component.
"""

import re
from array import array
from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.episode import Floats
from hma_data.errors import EpisodeError
from hma_data.registry.components import Component
from hma_data.sources.bags.container import Channel
from hma_data.sources.bags.messages import child, field_names, is_list, numbers, ros_store

STEP = re.compile(r"\.(?P<name>[A-Za-z_]\w*)|\[(?P<start>\d*)(?P<colon>:?)(?P<stop>\d*)\]")
Step = str | int | slice
SHOWN = 30  # topics or names in an error
ROS_BYTES = {"byte": "uint8", "char": "uint8", "octet": "uint8"}
# By the numbers of FieldDescriptorProto.Type; 14 is an enum.
PROTOBUF = {
    1: "float64", 2: "float32", 3: "int64", 4: "uint64", 5: "int32", 6: "uint64", 7: "uint32", 8: "bool",
    13: "uint32", 14: "int32", 15: "int32", 16: "int64", 17: "int32", 18: "int64",
}  # fmt: skip


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
        for step in self.steps:
            if isinstance(step, str):
                try:
                    message = child(message, step)
                except KeyError as fault:
                    known = ", ".join(field_names(message)) or "none, it is not a message"
                    raise EpisodeError(
                        where, f"{self.key}: there is no field {step!r}", f"the fields there: {known}"
                    ) from fault
                continue
            if not is_list(message):
                raise EpisodeError(where, f"{self.key}: what is before [ is not a list")
            if (step + 1 if isinstance(step, int) else step.stop or 0) > len(message):
                fault_of = f"{self.key}: the list has {len(message)} values in one of the messages"
                raise EpisodeError(where, fault_of)
            message = message[step]
        return message

    def owner(self, message: Any, where: str) -> Any:
        """Return the message that holds the last field."""
        return Field(self.key, self.topic, self.steps[:-1]).value(message, where)


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
    near = get_close_matches(re.split(r"[.\[]", key)[0], known, n=2, cutoff=0.5)
    hint = f"did you mean {' or '.join(near)}? " if near else ""
    more = f" and {len(known) - SHOWN} more" if len(known) > SHOWN else ""
    listed = f"its topics: {', '.join(known[:SHOWN])}{more}" if known else "it has no topics"
    return EpisodeError(where, f"the bag has no topic for {key}", hint + listed)


class Column:
    """The values of one component, gathered message by message.

    Where the message that holds the field also has a list `name` (JointState), the component's `names` select
    and order the values, unless the key or the YAML slices. Messages of another publisher, with none of those
    names, are left out.
    """

    def __init__(self, component: Component, field: Field, where: str) -> None:
        self.component, self.field = component, field
        self._where = where
        self._values, self._rows = array("d"), array("q")
        self._width: int | None = None
        self._picks: dict[tuple[str, ...], list[int] | None] = {}
        whole = not component.slice and field.steps and isinstance(field.steps[-1], str)
        self._selects = bool(component.names and whole)

    def add(self, message: Any, row: int) -> None:
        """Add the values of message `row`."""
        value = self.field.value(message, self._where)
        try:
            values = numbers(value)
        except TypeError as fault:
            known = ", ".join(field_names(value))
            raise EpisodeError(
                self._where,
                f"{self.field.key} holds {fault}, not numbers alone",
                f"name a field of it: {known}" if known else "",
            ) from fault
        if self._selects:
            picks = self._pick(message, len(values))
            if picks is None:
                return
            values = [values[i] for i in picks]
        if not values:
            raise EpisodeError(self._where, f"{self.field.key} is empty in message {row}")
        self._width = self._width or len(values)
        if len(values) != self._width:
            said = f"{self.field.key} has {self._width} values, then {len(values)} in message {row}"
            raise EpisodeError(self._where, said)
        self._values.extend(values)
        self._rows.append(row)

    def rows(self) -> NDArray[np.int64]:
        """Return the indices of the messages that gave values.

        Raises:
            EpisodeError: none did.
        """
        if not self._rows:
            seen = sorted({name for names in self._picks for name in names})[:SHOWN]
            names = ", ".join(self.component.names or ())
            raise EpisodeError(
                self._where, f"{self.field.key}: no message names {names}", f"names there: {', '.join(seen)}"
            )
        return np.frombuffer(self._rows, np.int64)

    def values(self) -> Floats:
        """Return the values (T, A) as recorded."""
        return np.frombuffer(self._values, np.float64).reshape(len(self._rows), -1)

    def _pick(self, message: Any, width: int) -> list[int] | None:
        """Return the indices of the wanted names; None where the message has none of them."""
        owner = self.field.owner(message, self._where)
        stated = child(owner, "name") if "name" in field_names(owner) else ()
        if not is_list(stated) or not len(stated):
            return list(range(width))
        names = tuple(stated)
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


# -- dtypes


def stated_dtype(channel: Channel, message: Any, steps: Sequence[Step]) -> str | None:
    """Return the dtype that the definition states for the numbers at a path.

    Args:
        channel: of the message.
        message: any decoded message of the channel.
        steps: of the key.

    Returns:
        numpy's name of the dtype; for a message of several dtypes, one that holds all; None where none
        is stated.
    """
    names: Iterator[str] = iter(())
    try:
        if channel.encoding in ("ros1", "cdr"):
            from rosbags.interfaces import Nodetype

            store, kind = ros_store(channel)
            names = _ros_dtypes(store, (Nodetype.NAME, kind), steps)
        elif channel.encoding == "protobuf":
            path = [step for step in steps if isinstance(step, str)]
            names = _protobuf_dtypes(message.DESCRIPTOR, path)
        found = sorted(set(names))
        return str(np.result_type(*found)) if found else None
    except (KeyError, TypeError, AttributeError, RecursionError):  # not a numpy number, or a recursive type
        return None


def _ros_dtypes(store: Any, field: Any, steps: Sequence[Step]) -> Iterator[str]:
    """Yield the dtypes at a path below one of rosbags's fields, (node type, content)."""
    from rosbags.interfaces import Nodetype

    node, content = field
    if node == Nodetype.BASE:
        yield ROS_BYTES.get(content[0], content[0])
    elif node == Nodetype.NAME:
        for name, inner in store.fielddefs[content][1]:
            if not steps or name == steps[0]:
                yield from _ros_dtypes(store, inner, steps[1:])
    else:  # a list
        yield from _ros_dtypes(store, content[0], steps[1:])


def _protobuf_dtypes(kind: Any, path: Sequence[str]) -> Iterator[str]:
    for field in kind.fields:
        if path and field.name != path[0]:
            continue
        if field.message_type is None:
            yield PROTOBUF[field.type]
        else:
            yield from _protobuf_dtypes(field.message_type, path[1:])
