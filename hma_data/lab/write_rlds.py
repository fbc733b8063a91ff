"""Write episodes as TFDS writes RLDS: TFRecord shards of tf.train.Example, with features.json beside them.

    features.json dataset_info.json <name>-train.tfrecord-00000-of-00001

Only the features of `RldsEpisode` are written: pictures as files, vectors of float32, a text. T steps.
"""

import json
import struct
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

_CORE = "tensorflow_datasets.core.features"


@dataclass(frozen=True)
class RldsEpisode:
    """One episode of T steps.

    Attributes:
        pictures: path inside a step -> T files, JPEG or PNG.
        vectors: path inside a step -> (T, A) float32.
            instruction: the task in words.
    """

    pictures: Mapping[str, list[bytes]]
    vectors: Mapping[str, NDArray[np.float32]]
    instruction: str


def write_rlds(
    folder: Path, name: str, sizes: Mapping[str, tuple[int, int]], codec: str, episodes: Iterable[RldsEpisode]
) -> None:
    """Write a folder of one split with one shard; episodes are read one by one.

    Args:
        folder: folder to make.
        name: name of the dataset.
        sizes: path of each camera -> (height, width).
        codec: jpeg or png.
        episodes: the episodes; all have the same keys.
    """
    folder.mkdir(parents=True)
    count, widths = 0, {}
    with (folder / f"{name}-train.tfrecord-00000-of-00001").open("wb") as file:
        for episode in episodes:
            file.write(_record(_example(episode)))
            widths = {key: values.shape[1] for key, values in episode.vectors.items()}
            count += 1
    (folder / "features.json").write_text(json.dumps(_features(sizes, codec, widths)))
    splits = [{"name": "train", "shardLengths": [str(count)]}]
    info = {"name": name, "version": "1.0.0", "fileFormat": "tfrecord", "splits": splits}
    (folder / "dataset_info.json").write_text(json.dumps(info))


def _features(sizes: Mapping[str, tuple[int, int]], codec: str, widths: Mapping[str, int]) -> dict[str, Any]:
    leaves: dict[str, Any] = {"language_instruction": {"pythonClassName": f"{_CORE}.Text", "text": {}}}
    for key, (height, width) in sizes.items():
        shape = {"dimensions": [str(height), str(width), "3"]}
        image = {"shape": shape, "dtype": "uint8", "encodingFormat": codec}
        leaves[key] = {"pythonClassName": f"{_CORE}.Image", "image": image}
    for key, width in widths.items():
        tensor = {"shape": {"dimensions": [str(width)]}, "dtype": "float32", "encoding": "none"}
        leaves[key] = {"pythonClassName": f"{_CORE}.Tensor", "tensor": tensor}
    nested: dict[str, Any] = {}
    for path, leaf in leaves.items():
        *parents, last = path.split("/")
        at = nested
        for parent in parents:
            at = at.setdefault(parent, {})
        at[last] = leaf
    steps = {"feature": _dict(nested), "length": "-1"}
    return _dict({"steps": {"pythonClassName": f"{_CORE}.Dataset", "sequence": steps}})


def _dict(items: dict[str, Any]) -> dict[str, Any]:
    known = {key: value if "pythonClassName" in value else _dict(value) for key, value in items.items()}
    return {"pythonClassName": f"{_CORE}.FeaturesDict", "featuresDict": {"features": known}}


def _example(episode: RldsEpisode) -> bytes:
    """Return a tf.train.Example, a map from names to lists, in protobuf's wire format."""
    length = len(next(iter(episode.pictures.values())))
    lists: dict[str, bytes] = {
        f"steps/{key}": _field(1, b"".join(_field(1, data) for data in files))
        for key, files in episode.pictures.items()
    }
    for key, values in episode.vectors.items():
        lists[f"steps/{key}"] = _field(2, _field(1, np.ascontiguousarray(values, "<f4").tobytes()))
    lists["steps/language_instruction"] = _field(1, _field(1, episode.instruction.encode()) * length)
    entries = (_field(1, name.encode()) + _field(2, content) for name, content in lists.items())
    return _field(1, b"".join(_field(1, entry) for entry in entries))


def _field(number: int, content: bytes) -> bytes:
    return bytes([number << 3 | 2]) + _varint(len(content)) + content


def _varint(number: int) -> bytes:
    out = bytearray()
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    return bytes(out) + bytes([number])


def _record(data: bytes) -> bytes:
    from hma_data.sources.rlds.records import masked_crc

    length = struct.pack("<Q", len(data))
    return length + struct.pack("<I", masked_crc(length)) + data + struct.pack("<I", masked_crc(data))
