"""Parse the features of a record, a tf.train.Example: names -> lists of bytes, float32 or int64.

TensorFlow is not needed for it: the messages are described here, as in its example.proto and feature.proto.
"""

from typing import Any

import numpy as np
from google.protobuf.message import DecodeError  # type: ignore[import-untyped]

from hma_data.arrays import Float32s, Ints
from hma_data.errors import EpisodeError
from hma_data.sources.common.protobuf import message_class

BYTES, FLOATS, INTS = "bytes_list", "float_list", "int64_list"
_DEFINITION = """
    name: "example.proto" package: "tensorflow" syntax: "proto3"
    message_type {
        name: "BytesList" field { name: "value" number: 1 label: LABEL_REPEATED type: TYPE_BYTES }
    }
    message_type {
        name: "FloatList" field { name: "value" number: 1 label: LABEL_REPEATED type: TYPE_FLOAT }
    }
    message_type {
        name: "Int64List" field { name: "value" number: 1 label: LABEL_REPEATED type: TYPE_INT64 }
    }
    message_type {
        name: "Feature" oneof_decl { name: "kind" }
        field { name: "bytes_list" number: 1 type: TYPE_MESSAGE type_name: "BytesList" oneof_index: 0 }
        field { name: "float_list" number: 2 type: TYPE_MESSAGE type_name: "FloatList" oneof_index: 0 }
        field { name: "int64_list" number: 3 type: TYPE_MESSAGE type_name: "Int64List" oneof_index: 0 }
    }
    message_type {
        name: "Features"
        field {
            name: "feature" number: 1 label: LABEL_REPEATED type: TYPE_MESSAGE type_name: "FeatureEntry"
        }
        nested_type {
            name: "FeatureEntry" options { map_entry: true }
            field { name: "key" number: 1 type: TYPE_STRING }
            field { name: "value" number: 2 type: TYPE_MESSAGE type_name: "Feature" }
        }
    }
    message_type {
        name: "Example" field { name: "features" number: 1 type: TYPE_MESSAGE type_name: "Features" }
    }
"""


class Example:
    """The features of one record of the episode `where`.

    Attributes:
        size: number of bytes of the record.

    Raises:
        EpisodeError: (here and in every method) the bytes are not an Example, a feature is missing
            or of another kind.
    """

    def __init__(self, data: bytes, where: str) -> None:
        self.size, self._where = len(data), where
        try:
            example = message_class(_DEFINITION, "tensorflow.Example").FromString(data)
        except DecodeError as fault:
            raise EpisodeError(where, f"is not a tf.train.Example: {fault}") from fault
        self._features = example.features.feature

    def __contains__(self, name: str) -> bool:
        return name in self._features

    def blobs(self, name: str) -> list[bytes]:
        """Return the byte strings of a feature."""
        return list(self._values(name, BYTES))

    def numbers(self, name: str) -> Float32s | Ints:
        """Return the (n,) numbers of a feature, float32 or int64 as stored."""
        if name in self and self._features[name].HasField(FLOATS):
            return np.array(self._values(name, FLOATS), np.float32)
        return self.ints(name)

    def ints(self, name: str) -> Ints:
        """Return the (n,) integers of a feature."""
        return np.array(self._values(name, INTS), np.int64)

    def _values(self, name: str, kind: str) -> Any:
        if name not in self:
            raise EpisodeError(self._where, f"has no feature {name!r}")
        found = self._features[name].WhichOneof("kind") or kind  # an empty list may state none
        if found != kind:
            raise EpisodeError(self._where, f"{name} is a {found}, not a {kind}")
        return getattr(self._features[name], kind).value
