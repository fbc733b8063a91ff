"""The dtype of a key as the message definition states it, whatever Python makes of the value.

ROS messages are looked up in the typestore, protobuf's in their descriptor; JSON states none.
"""

from collections.abc import Iterator, Sequence
from typing import Any

import numpy as np

from hma_data.sources.bags.container import Channel
from hma_data.sources.bags.fields import Step
from hma_data.sources.bags.messages import ros_store

ROS_BYTES = {"byte": "uint8", "char": "uint8", "octet": "uint8"}
MAX_DEPTH = 32  # messages within messages; protobuf's may hold their own kind
# By the numbers of FieldDescriptorProto.Type; 14 is an enum.
PROTOBUF = {
    1: "float64", 2: "float32", 3: "int64", 4: "uint64", 5: "int32", 6: "uint64", 7: "uint32", 8: "bool",
    13: "uint32", 14: "int32", 15: "int32", 16: "int64", 17: "int32", 18: "int64",
}  # fmt: skip


def stated_dtype(channel: Channel, message: Any, steps: Sequence[Step]) -> str | None:
    """What the definition says of the numbers at that path.

    Args:
        channel: of the message.
        message: any of the channel, decoded.
        steps: of the key.

    Returns:
        numpy's name, of a message of several the one that holds all; None where nothing states it.
    """
    try:
        if channel.encoding in ("ros1", "cdr"):
            store, kind = ros_store(channel)
            names = set(_ros_dtypes(store, _ros_field(store, kind, steps), 0))
        elif channel.encoding == "protobuf":
            names = set(_protobuf_at(message.DESCRIPTOR, steps))
        else:
            return None
        return str(np.result_type(*sorted(names))) if names else None
    except (KeyError, TypeError, AttributeError):  # a kind of number that numpy has not
        return None


def _ros_field(store: Any, kind: str, steps: Sequence[Step]) -> Any:
    """rosbags's (node type, content) of the field at that path."""
    from rosbags.interfaces import Nodetype

    found: Any = (Nodetype.NAME, kind)
    for step in steps:
        if isinstance(step, str):
            found = dict(store.fielddefs[found[1]][1])[step]
        elif isinstance(step, int):
            found = found[1][0]
    return found


def _ros_dtypes(store: Any, field: Any, depth: int) -> Iterator[str]:
    from rosbags.interfaces import Nodetype

    node, content = field
    if depth > MAX_DEPTH:
        raise TypeError("messages within messages without end")
    if node == Nodetype.BASE:
        yield ROS_BYTES.get(content[0], content[0])
    elif node == Nodetype.NAME:
        for _, inner in store.fielddefs[content][1]:
            yield from _ros_dtypes(store, inner, depth + 1)
    else:
        yield from _ros_dtypes(store, content[0], depth + 1)


def _protobuf_at(kind: Any, steps: Sequence[Step]) -> Iterator[str]:
    field: Any = None
    for step in steps:
        if isinstance(step, str):
            field = kind.fields_by_name[step]
            kind = field.message_type
    if kind is None:
        yield PROTOBUF[field.type]
    else:
        yield from _protobuf_dtypes(kind, 0)


def _protobuf_dtypes(kind: Any, depth: int) -> Iterator[str]:
    if depth > MAX_DEPTH:
        raise TypeError("messages within messages without end")
    for field in kind.fields:
        if field.message_type is None:
            yield PROTOBUF[field.type]
        else:
            yield from _protobuf_dtypes(field.message_type, depth + 1)
