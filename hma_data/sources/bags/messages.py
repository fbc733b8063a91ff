"""From a message's bytes to its fields: ROS 1, CDR, JSON and protobuf.

ROS definitions come from inside the bag; ROS 2 bags before Iron carry none, then the standard
types of Humble, and after them of the newest release, are used. Whatever the encoding, a message is
read through `child` and `field_names`.
"""

import dataclasses
import json
import struct
from collections.abc import Callable, Sequence
from functools import lru_cache, partial
from typing import Any

import numpy as np

from hma_data.errors import EpisodeError
from hma_data.sources.bags.container import FAULTS, Channel, Data
from hma_data.sources.bags.services import event_definitions, is_service_event

Decode = Callable[[Data], Any]
IDL_SEPARATOR = "=" * 80 + "\n"
TIME_FIELDS = (("sec", "nanosec"), ("sec", "nsec"), ("seconds", "nanos"))
TIME = "builtin_interfaces/msg/Time"
STAMPS = (("header", "stamp"), ("timestamp",), ("stamp",))


def decode(channel: Channel, data: Data, where: str) -> Any:
    """The message.

    Raises:
        EpisodeError: its encoding or type is unknown, or the bytes do not fit it.
    """
    try:
        read = _decoder(channel)
    except (*FAULTS, TypeError, AssertionError, SyntaxError, AttributeError) as fault:
        raise EpisodeError(where, f"{channel.topic}: {_line(fault)}") from fault
    try:
        return read(data)
    except (*FAULTS, TypeError) as fault:
        kind = channel.type or channel.encoding
        raise EpisodeError(where, f"a message on {channel.topic} is not a {kind}: {_line(fault)}") from fault


def head_stamp(channel: Channel) -> Callable[[Data], int] | None:
    """What reads a ROS message's own time, in nanoseconds, from its first HEAD bytes.

    None where the time is not at a fixed place there; `decode` is needed then.
    """
    try:
        return _head_stamp(channel)
    except (*FAULTS, TypeError, AssertionError, SyntaxError, AttributeError):
        return None  # `decode` meets it again and says what it is


@lru_cache(maxsize=256)
def _head_stamp(channel: Channel) -> Callable[[Data], int] | None:
    if channel.encoding not in ("ros1", "cdr"):
        return None
    store, kind = ros_store(channel)
    fields = [(name, spec[1]) for name, spec in store.fielddefs[kind][1]]
    at = 0 if channel.encoding == "ros1" else 4  # CDR begins with four bytes on its encoding
    if fields and fields[0] == ("header", "std_msgs/msg/Header"):
        fields = [(name, spec[1]) for name, spec in store.fielddefs["std_msgs/msg/Header"][1]]
        if fields[0][0] == "seq":
            fields, at = fields[1:], at + 4
    elif {name for name, _ in fields[1:]} & {"header", "timestamp"}:
        return None
    if not fields or fields[0] not in [(name, TIME) for name in ("stamp", "timestamp")]:
        return None
    return partial(_time_at, at, channel.encoding == "cdr")


def _time_at(at: int, cdr: bool, data: Data) -> int:
    big = cdr and not data[1] & 1
    seconds, nanoseconds = struct.unpack_from(">iI" if big else "<iI", data, at)
    return int(seconds * 10**9 + nanoseconds)


def _line(fault: BaseException) -> str:
    """A fault of a library in one short line."""
    return " ".join(str(fault.args[0] if fault.args else fault).split())[:200]


@lru_cache(maxsize=256)
def _decoder(channel: Channel) -> Decode:
    if channel.encoding in ("ros1", "cdr"):
        return _ros_decoder(channel)
    if channel.encoding == "json":
        return lambda data: json.loads(bytes(data))
    if channel.encoding == "protobuf":
        return _protobuf_decoder(channel)
    raise ValueError(
        f"messages encoded as {channel.encoding!r} cannot be read; ros1, cdr, json and protobuf can"
    )


# -- ROS


def _ros_decoder(channel: Channel) -> Decode:
    from rosbags.serde import SerdeError

    store, kind = ros_store(channel)
    read = store.deserialize_ros1 if channel.encoding == "ros1" else store.deserialize_cdr
    return _telling(partial(read, typename=kind), SerdeError)


@lru_cache(maxsize=256)
def ros_store(channel: Channel) -> tuple[Any, str]:
    """A store that knows the channel's type, and its name there."""
    from rosbags.typesys import Stores, TypesysError, get_typestore
    from rosbags.typesys.msg import normalize_msgtype

    kind = normalize_msgtype(channel.type)
    stores = [get_typestore(Stores.ROS2_HUMBLE), get_typestore(Stores.LATEST)]
    if is_service_event(channel) or channel.schema.strip():
        stores = [get_typestore(Stores.EMPTY)]
        try:
            stores[0].register(_definitions(channel, kind))
        except TypesysError as fault:
            raise ValueError(f"the definition of {channel.type} cannot be read: {_line(fault)}") from fault
    for store in stores:
        if kind in store.types:
            return store, kind
    raise ValueError(
        f"the bag does not carry the definition of {channel.type}, and it is not one of ROS 2's own types: "
        "record with ROS 2 Iron or later, or convert the bag to MCAP with its definitions"
    )


def _telling(read: Decode, error: type[Exception]) -> Decode:
    """`read`, with a library's own error told as ValueError."""

    def told(data: Data) -> Any:
        try:
            return read(data)
        except error as fault:
            raise ValueError(str(fault)) from fault

    return told


def _definitions(channel: Channel, kind: str) -> Any:
    from rosbags.typesys import get_types_from_idl, get_types_from_msg

    text = channel.schema.decode("utf-8")
    if is_service_event(channel) and channel.schema_encoding != "ros2idl":
        return event_definitions(channel.type, kind, text)
    if channel.schema_encoding in ("ros1msg", "ros2msg"):
        return get_types_from_msg(text, kind)
    if channel.schema_encoding != "ros2idl":
        raise ValueError(f"definitions written as {channel.schema_encoding!r} cannot be read")
    if not text.startswith(IDL_SEPARATOR):
        return get_types_from_idl(text)
    types: dict[str, Any] = {}
    for part in text.split(IDL_SEPARATOR)[1:]:
        types |= get_types_from_idl(part.partition("\n")[2])  # the first line names the type
    return types


# -- protobuf


def _protobuf_decoder(channel: Channel) -> Decode:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory  # type: ignore[import-untyped]
    from google.protobuf.message import DecodeError  # type: ignore[import-untyped]

    files = descriptor_pb2.FileDescriptorSet()
    try:
        files.ParseFromString(channel.schema)
    except DecodeError as fault:
        raise ValueError(f"the definition of {channel.type} is damaged") from fault
    pool = descriptor_pool.DescriptorPool()
    for item in files.file:
        pool.Add(item)
    kind = message_factory.GetMessageClass(pool.FindMessageTypeByName(channel.type))
    return _telling(lambda data: kind.FromString(bytes(data)), DecodeError)


# -- any message


def is_message(value: Any) -> bool:
    """Whether it has fields."""
    return isinstance(value, dict) or dataclasses.is_dataclass(value) or hasattr(value, "DESCRIPTOR")


def field_names(message: Any) -> list[str]:
    """Names of its fields, in order; constants, which rosbags makes fields with a default, are none."""
    if isinstance(message, dict):
        return list(message)
    if dataclasses.is_dataclass(message):
        return [item.name for item in dataclasses.fields(message) if item.default is dataclasses.MISSING]
    if hasattr(message, "DESCRIPTOR"):
        return [item.name for item in message.DESCRIPTOR.fields]
    return []


def child(message: Any, name: str) -> Any:
    """The value of a field.

    Raises:
        KeyError: there is none of that name.
    """
    if isinstance(message, dict):
        return message[name]
    fields = getattr(message, "__dataclass_fields__", None)
    if fields is None and hasattr(message, "DESCRIPTOR"):
        fields = message.DESCRIPTOR.fields_by_name
    if not fields or name not in fields:
        raise KeyError(name)
    return getattr(message, name)


def is_list(value: Any) -> bool:
    """Whether it is a list or an array, not text or bytes."""
    return isinstance(value, np.ndarray | Sequence) and not isinstance(value, str | bytes)


def numbers(value: Any) -> list[float]:
    """All its numbers: an array's in order, a message's field by field.

    Raises:
        TypeError: something in it is not a number; the message says what.
    """
    if isinstance(value, bool | int | float | np.number | np.bool_):
        return [float(value)]
    if isinstance(value, np.ndarray) and value.dtype.kind in "fiub":
        flat: list[float] = value.astype(np.float64).ravel().tolist()
        return flat
    if is_list(value):
        return [number for item in value for number in numbers(item)]
    if is_message(value):
        return [number for name in field_names(value) for number in _field_numbers(value, name)]
    raise TypeError(
        {"str": "text", "bytes": "bytes", "NoneType": "null"}.get(type(value).__name__, "no number")
    )


def _field_numbers(message: Any, name: str) -> list[float]:
    try:
        return numbers(child(message, name))
    except TypeError as fault:
        text = str(fault)
        raise TypeError(f"{text} in {name}" if " in " not in text else f"{text} of {name}") from fault


def stamp_ns(message: Any) -> int:
    """The time the message itself carries, in nanoseconds; 0 when it carries none."""
    for path in STAMPS:
        value = message
        try:
            for name in path:
                value = child(value, name)
        except KeyError:
            continue
        time = _time_ns(value)
        if time is not None:
            return time
    return 0


def _time_ns(value: Any) -> int | None:
    for seconds, nanoseconds in TIME_FIELDS:
        try:
            whole, part = child(value, seconds), child(value, nanoseconds)
        except KeyError:
            continue
        if isinstance(whole, int) and isinstance(part, int):
            return whole * 10**9 + part
    return None
