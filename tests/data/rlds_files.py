"""Writes RLDS folders as TFDS does, independently of our reader: protobuf's own encoder, a bitwise CRC."""

import json
import struct
from pathlib import Path

import cv2
import numpy as np
from google.protobuf import descriptor_pb2, descriptor_pool, message_factory

from hma_data.sources.rlds.records import masked_crc


def _example_class():
    """tf.train.Example, described by hand for protobuf's runtime."""
    file = descriptor_pb2.FileDescriptorProto(name="example_of_test.proto", package="t", syntax="proto3")

    def message(name, *fields):
        item = file.message_type.add(name=name)
        for number, (field, kind, label, of) in enumerate(fields, 1):
            item.field.add(name=field, number=number, type=kind, label=label, type_name=of)
        return item

    one, many = 1, 3
    message("BytesList", ("value", 12, many, None))
    message("FloatList", ("value", 2, many, None))
    message("Int64List", ("value", 3, many, None))
    feature = message(
        "Feature",
        ("bytes_list", 11, one, ".t.BytesList"),
        ("float_list", 11, one, ".t.FloatList"),
        ("int64_list", 11, one, ".t.Int64List"),
    )
    feature.oneof_decl.add(name="kind")
    for field in feature.field:
        field.oneof_index = 0
    features = message("Features", ("feature", 11, many, ".t.Features.FeatureEntry"))
    entry = features.nested_type.add(name="FeatureEntry")
    entry.options.map_entry = True
    entry.field.add(name="key", number=1, type=9, label=one)
    entry.field.add(name="value", number=2, type=11, label=one, type_name=".t.Feature")
    message("Example", ("features", 11, one, ".t.Features"))
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("t.Example"))


PROTO = _example_class()


def encode(features: dict) -> bytes:
    example = PROTO()
    for name, values in features.items():
        values = list(np.ravel(values)) if isinstance(values, np.ndarray) else values
        slot = example.features.feature[name]
        if values and isinstance(values[0], bytes):
            slot.bytes_list.value.extend(values)
        elif values and isinstance(values[0], float | np.floating):
            slot.float_list.value.extend(map(float, values))
        else:
            slot.int64_list.value.extend(map(int, values))
    return example.SerializeToString()


def _bitwise_masked_crc(data: bytes) -> int:
    crc = 0xFFFFFFFF
    for byte in data:
        crc ^= byte
        for _ in range(8):
            crc = crc >> 1 ^ (0x82F63B78 if crc & 1 else 0)
    crc ^= 0xFFFFFFFF
    return ((crc >> 15 | crc << 17) + 0xA282EAD8) & 0xFFFFFFFF


def frame(record: bytes) -> bytes:
    length = struct.pack("<Q", len(record))
    crc = _bitwise_masked_crc if len(record) < 5000 else masked_crc
    return length + struct.pack("<I", crc(length)) + record + struct.pack("<I", crc(record))


def tensor(shape=(), dtype="float32", encoding="none"):
    dimensions = {"dimensions": [str(-1 if size is None else size) for size in shape]} if shape else {}
    return {
        "pythonClassName": "tensorflow_datasets.core.features.tensor_feature.Tensor",
        "tensor": {"shape": dimensions, "dtype": dtype, "encoding": encoding},
    }


def image(shape, codec="png", dtype="uint8"):
    return {
        "pythonClassName": "x.Image",
        "image": {"shape": tensor(shape)["tensor"]["shape"], "dtype": dtype, "encodingFormat": codec},
    }


SHARD = "toy-train.tfrecord-00000-of-00001"  # the name of an only one
TEXT = {"pythonClassName": "x.Text", "text": {}}


def features_dict(items):
    return {"pythonClassName": "x.FeaturesDict", "featuresDict": {"features": items}}


def sequence(item, kind="Sequence"):
    return {"pythonClassName": f"x.{kind}", "sequence": {"feature": item, "length": "-1"}}


def png(picture: np.ndarray) -> bytes:
    return cv2.imencode(".png", picture[..., ::-1] if picture.ndim == 3 else picture)[1].tobytes()


def write(folder: Path, shards: dict, steps: dict, metadata=None, file_format="tfrecord") -> Path:
    """A folder whose shards have TFDS's names, which dataset_info.json states with their records."""
    folder.mkdir(parents=True)
    tree = {"steps": sequence(features_dict(steps), "Dataset")}
    tree["episode_metadata"] = features_dict(metadata or {"file_path": TEXT})
    (folder / "features.json").write_text(json.dumps(features_dict(tree)))
    splits: dict[str, list[str]] = {}
    for name, records in shards.items():
        (folder / name).write_bytes(b"".join(frame(encode(item)) for item in records))
        splits.setdefault(name.split(".")[0].split("-")[-1], []).append(str(len(records)))
    stated = [{"name": split, "shardLengths": counts} for split, counts in splits.items()]
    info = {"name": "toy", "version": "1.0.0", "fileFormat": file_format, "splits": stated}
    (folder / "dataset_info.json").write_text(json.dumps(info))
    return folder
