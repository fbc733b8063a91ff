"""Read the fields of a message from its bytes: ROS 1, CDR, JSON and protobuf.

ROS definitions come from the bag. ROS 2 bags before Iron have none; for them the standard types of Humble are
used, and then those of the newest release. A message of any encoding is read through `child` and
`field_names`.
"""

import dataclasses
import json
import re
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from importlib import import_module
from typing import Any

import numpy as np

from hma_data.errors import EpisodeError
from hma_data.sources.bags.clocks import DAY_S, SECOND_NS
from hma_data.sources.bags.container import Channel, Data
from hma_data.storage.kinds import one_line

Decode = Callable[[Data], Any]
IDL_SEPARATOR = "=" * 80 + r"\nIDL: .*\n"  # between the types of a definition
TIME_FIELDS = (("sec", "nanosec"), ("sec", "nsec"), ("seconds", "nanos"))
PLAIN_CDR = 1  # the last of RTPS's kinds of encapsulation that is plain; then parameter lists and XCDR2
WELL_KNOWN = "google/protobuf/"
UNITS_NS = (1, 10**3, 10**6, 10**9)
LATEST = 2.0**63  # nanoseconds since 1970
STAMPS = (("header", "stamp"), ("timestamp",), ("stamp",))


def decode(channel: Channel, data: Data, where: str) -> Any:
    """Return the decoded message.

    Raises:
        EpisodeError: its encoding or type is unknown, or the bytes do not fit it.
    """
    form = int.from_bytes(data[:2]) if channel.encoding == "cdr" else 0
    if form > PLAIN_CDR:
        fault = f"a message on {channel.topic} has the encapsulation {form:#06x}, not plain CDR"
        raise EpisodeError(where, fault, "record again with XCDR1 as the publisher's data representation")
    # The libraries below raise almost any error for damaged definitions and bytes.
    try:
        return _decoder(channel)(data)
    except Exception as fault:
        kind, said = channel.type or channel.encoding, one_line(fault)
        raise EpisodeError(where, f"{channel.topic}: a message cannot be read as {kind}: {said}") from fault


@lru_cache(maxsize=256)
def _decoder(channel: Channel) -> Decode:
    if channel.encoding in ("ros1", "cdr"):
        store, kind = ros_store(channel)
        read = store.deserialize_ros1 if channel.encoding == "ros1" else store.deserialize_cdr
        return partial(read, typename=kind)
    if channel.encoding == "json":
        return lambda data: json.loads(bytes(data))
    if channel.encoding == "protobuf":
        return _protobuf_decoder(channel)
    raise ValueError(
        f"messages encoded as {channel.encoding!r} cannot be read; ros1, cdr, json and protobuf can"
    )


def _protobuf_decoder(channel: Channel) -> Decode:
    from google.protobuf import (  # type: ignore[import-untyped]
        descriptor_pb2,
        descriptor_pool,
        message_factory,
    )

    files = list(descriptor_pb2.FileDescriptorSet.FromString(channel.schema).file)
    needed = {name for item in files for name in item.dependency} - {item.name for item in files}
    for name in needed:
        if name.startswith(WELL_KNOWN):  # some writers leave out what protobuf brings along
            # The import makes the default pool know the file.
            import_module(f"{name.removesuffix('.proto').replace('/', '.')}_pb2")
            item = descriptor_pb2.FileDescriptorProto()
            descriptor_pool.Default().FindFileByName(name).CopyToProto(item)
            files.append(item)
    pool = descriptor_pool.DescriptorPool()
    message_factory.GetMessages(files, pool)  # adds files to the pool after those that they depend on
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(channel.type))
    return lambda data: kind.FromString(bytes(data))


# -- ROS definitions


@lru_cache(maxsize=256)
def ros_store(channel: Channel) -> tuple[Any, str]:
    """Return a type store that knows the channel's type, and the type's name in it."""
    from rosbags.typesys import Stores, get_typestore
    from rosbags.typesys.msg import normalize_msgtype

    kind = normalize_msgtype(channel.type)
    stores = [get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.LATEST)]
    if channel.schema.strip():
        stores = [get_typestore(Stores.EMPTY)]
        stores[0].register(_definitions(channel, kind))
    for store in stores:
        if kind in store.types:
            return store, kind
    raise ValueError(
        f"the bag does not carry the definition of {channel.type}, and it is not one of ROS 2's own types: "
        "record with ROS 2 Iron or later, or convert the bag to MCAP with its definitions"
    )


def _definitions(channel: Channel, kind: str) -> Any:
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    text = channel.schema.decode("utf-8")
    if channel.schema_encoding in ("ros1msg", "ros2msg"):
        return get_types_from_msg(text, kind)
    if channel.schema_encoding != "ros2idl":
        raise ValueError(f"definitions written as {channel.schema_encoding!r} cannot be read")
    parts = filter(None, re.split(IDL_SEPARATOR, text))
    return {name: fields for part in parts for name, fields in get_types_from_idl(part).items()}


# -- any message


def is_message(value: Any) -> bool:
    """Check whether a value has fields."""
    return isinstance(value, dict) or dataclasses.is_dataclass(value) or hasattr(value, "DESCRIPTOR")


def field_names(message: Any) -> list[str]:
    """Return the names of the fields in order.

    Constants do not count (in rosbags: fields with a default), nor what a message of protobuf leaves out.
    """
    if isinstance(message, dict):
        return list(message)
    if dataclasses.is_dataclass(message):
        kind: Any = type(message)
        return list(_ros_fields(kind))
    if hasattr(message, "DESCRIPTOR"):
        return [item.name for item in message.DESCRIPTOR.fields if not _is_left_out(message, item)]
    return []


@lru_cache(maxsize=256)
def _ros_fields(kind: Any) -> list[str]:
    return [item.name for item in dataclasses.fields(kind) if item.default is dataclasses.MISSING]


def _is_left_out(message: Any, field: Any) -> bool:
    """Check whether a message of protobuf has no such part, or another one of a `oneof`: it would read 0."""
    is_part = field.message_type is not None or field.containing_oneof is not None
    return is_part and field.has_presence and not message.HasField(field.name)


def child(message: Any, name: str) -> Any:
    """Return the value of a field.

    Raises:
        KeyError: there is no field of that name.
    """
    if isinstance(message, dict):
        return message[name]
    fields = getattr(message, "__dataclass_fields__", None)
    if fields is None and hasattr(message, "DESCRIPTOR"):
        fields = message.DESCRIPTOR.fields_by_name
        if name in fields and _is_left_out(message, fields[name]):
            raise KeyError(name)
    if not fields or name not in fields:
        raise KeyError(name)
    return getattr(message, name)


def child_of_each(messages: Sequence[Any], name: str) -> list[Any]:
    """Return the value of a field in each message of a list; empty where one lacks it."""
    there = all(is_message(one) and name in field_names(one) for one in messages)
    return [child(one, name) for one in messages] if there else []


def is_list(value: Any) -> bool:
    """Check whether a value is a list or an array, not text or bytes."""
    return isinstance(value, np.ndarray | Sequence) and not isinstance(value, str | bytes)


def is_message_list(value: Any) -> bool:
    """Check whether a value is a list of messages, such as the motors of a robot."""
    return is_list(value) and len(value) > 0 and is_message(value[0])


NAMES_FIRST = ("name", "joint_names", "names")  # lists of names, before others that a message may have
ELEMENT_NAMES = ("name", "joint_name", "child_frame_id", "label")  # of the elements of a list


def value_names(owners: Sequence[Any], width: int) -> tuple[str, ...]:
    """Return the names that a message gives its values; empty where it gives none.

    JointState lists them beside the values, JointTrajectory a message above, others in a list's elements.

    Args:
        owners: the messages, or lists of messages, that hold the values; the innermost first.
        width: number of values.
    """
    for owner in owners:
        if is_message_list(owner):
            lists = (child_of_each(owner, name) for name in ELEMENT_NAMES)
        else:
            known = field_names(owner)
            first = [name for name in NAMES_FIRST if name in known]
            lists = (child(owner, name) for name in dict.fromkeys([*first, *known]))
        for names in lists:
            if not is_list(names) or len(names) != width:
                continue
            texts = [name for name in names if isinstance(name, str)]
            if len(set(texts)) == width:
                return tuple(texts)
    return ()


def numbers(value: Any) -> list[float]:
    """Return all numbers of a value: an array's in order, a message's field by field.

    Raises:
        TypeError: something in it is not a number; the error says what.
    """
    if isinstance(value, bool | int | float | np.number | np.bool_):
        return [float(value)]
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        flat: list[float] = value.astype(np.float64).ravel().tolist()
        return flat
    if is_list(value):
        return [number for item in value for number in numbers(item)]
    if is_message(value):
        return [number for name in field_names(value) for number in numbers(child(value, name))]
    raise TypeError(f"a value of the type {type(value).__name__}")


def stamp_ns(message: Any, received_ns: int) -> int:
    """Return the message's own time in nanoseconds; 0 where it has none.

    A single number is a time if it is one in some unit, near the time of receipt; others count from a start.
    """
    for path in STAMPS:
        value = message
        try:
            for name in path:
                value = child(value, name)
        except KeyError:
            continue
        if isinstance(value, int | float):
            times = (round(value * unit) for unit in UNITS_NS if abs(value) < LATEST)  # false for NaN
            near = min(DAY_S * SECOND_NS, received_ns / 1000)  # so that one unit fits at most
            return next((ns for ns in times if abs(ns - received_ns) < near), 0)
        for names in TIME_FIELDS:
            try:
                seconds, nanoseconds = (child(value, name) for name in names)
            except KeyError:
                continue
            if isinstance(seconds, int) and isinstance(nanoseconds, int):
                return seconds * 10**9 + nanoseconds
    return 0
