"""What inspect says of the dtype of numbers in bags: what the message definition states."""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from mcap.writer import Writer
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.data.bag_files import SOURCE

KIND = "own_msgs/msg/Gripper"
TEXT = "bool closed\nuint64 count\nfloat32 width\nint8[] codes\nchar mode\nown_msgs/Part[2] parts\n"
PART = "int16 x\nint32 y\nfloat32[2] z\n"
PROTO_TYPES = {"closed": 8, "count": 4, "width": 2, "codes": 17, "mode": 13}  # of FieldDescriptorProto.Type
ROS = {
    "/grip.closed": "bool", "/grip.count": "uint64", "/grip.width": "float32", "/grip.codes": "int8",
    "/grip.mode": "uint8", "/grip.parts": "float64",
}  # fmt: skip
PROTOBUF = ROS | {"/grip.codes": "int32", "/grip.mode": "uint32"}
JSON = dict.fromkeys(ROS, "float64") | {"/grip.closed": "bool"}
VALUES: dict[str, Any] = {"closed": True, "count": 7, "width": 0.5, "codes": [1, -2], "mode": 65}


def ros(encoding: str) -> tuple[str, str, bytes, bytes]:
    store = get_typestore(Stores.ROS1_NOETIC if encoding == "ros1" else Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(TEXT, KIND) | get_types_from_msg(PART, "own_msgs/msg/Part"))
    part = store.types["own_msgs/msg/Part"](x=1, y=2, z=np.array([3, 4], np.float32))
    codes = np.array(VALUES["codes"], np.int8)
    message = store.types[KIND](**(VALUES | {"codes": codes, "parts": [part, part]}))
    if encoding == "ros1":
        schema = store.generate_msgdef(KIND, ros_version=1)[0]
        return (
            KIND.replace("/msg", ""),
            "ros1msg",
            schema.encode(),
            bytes(store.serialize_ros1(message, KIND)),
        )
    schema = store.generate_msgdef(KIND, ros_version=2)[0]
    return KIND, "ros2msg", schema.encode(), bytes(store.serialize_cdr(message, KIND))


def protobuf() -> tuple[str, str, bytes, bytes]:
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

    files = descriptor_pb2.FileDescriptorSet()
    own = files.file.add(name="own.proto", package="own", syntax="proto3")
    part, kind = own.message_type.add(name="Part"), own.message_type.add(name="Gripper")
    for i, (name, number, label) in enumerate([("x", 5, 1), ("y", 17, 1), ("z", 2, 3)]):
        part.field.add(name=name, number=i + 1, type=number, label=label)
    for i, (name, number) in enumerate(PROTO_TYPES.items()):
        kind.field.add(name=name, number=i + 1, type=number, label=3 if name == "codes" else 1)
    kind.field.add(name="parts", number=9, type=11, label=3, type_name=".own.Part")
    pool = descriptor_pool.DescriptorPool()
    pool.Add(own)
    made = message_factory.GetMessageClass(pool.FindMessageTypeByName("own.Gripper"))(**VALUES)
    for _ in range(2):
        made.parts.add(x=1, y=2, z=[3, 4])
    return "own.Gripper", "protobuf", files.SerializeToString(), made.SerializeToString()


def as_json() -> tuple[str, str, bytes, bytes]:
    said = json.dumps(VALUES | {"parts": [{"x": 1, "y": 2, "z": [3, 4]}] * 2})
    return "Gripper", "jsonschema", b"{}", said.encode()


@pytest.mark.parametrize(
    ("encoding", "stated"), [("cdr", ROS), ("ros1", ROS), ("protobuf", PROTOBUF), ("json", JSON)]
)
def test_the_dtype_is_that_of_the_definition(tmp_path: Path, encoding: str, stated: dict[str, str]) -> None:
    made = {"protobuf": protobuf, "json": as_json}.get(encoding, lambda: ros(encoding))()
    kind, schema_encoding, schema, data = made
    with (tmp_path / "v.mcap").open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel(
            "/grip", encoding, writer.register_schema(kind, schema_encoding, schema)
        )
        for i in range(3):
            writer.add_message(channel, i * 10**8, data, i * 10**8)
        writer.finish()
    keys = SOURCE.inspect(str(tmp_path / "v.mcap")).keys
    assert {key.key: key.dtype for key in keys} == stated
