"""Read features.json of a TFDS folder, and decode the columns and images of its records.

TensorFlow Datasets joins the names of nested features with "/". A feature inside one sequence (RLDS'
`steps`) is stored as one flat list over the steps. A feature inside two or more sequences is ragged:
`<name>/ragged_flat_values` and `<name>/ragged_row_lengths_<i>`. Numbers are stored as float32 or int64
whatever their dtype, unless the tensor is encoded to bytes. (Source: tensorflow_datasets 4.9, features and
example_serializer.)

T steps of an episode, H×W pixels.
"""

import json
import math
import zlib
from dataclasses import dataclass
from functools import cache
from typing import Any

import numpy as np

from hma_data.arrays import Array
from hma_data.episodes.episode import Decode
from hma_data.episodes.images import decode_image
from hma_data.errors import EpisodeError, SourceError
from hma_data.sources.rlds.example import Example

Shape = tuple[int | None, ...]
BFLOAT16 = "bfloat16"  # NumPy lacks this dtype: values become float32
MAX_TENSOR_BYTES = 1 << 28  # most bytes of one value, against decompression bombs and errors

FIXED: dict[str, tuple[str, Shape, str]] = {  # content key in features.json -> kind, shape and dtype
    "text": ("text", (), "string"),
    "classLabel": ("number", (), "int64"),
    "boundingBox": ("number", (4,), "float32"),
}


@dataclass(frozen=True)
class RldsFeature:
    """One leaf of features.json."""

    name: str  # flattened, as records name it: steps/observation/image
    kind: str  # number, text, image or other (stored in a way that is not read here)
    shape: Shape  # of one value, with None where a size varies; images are (H, W, C)
    dtype: str  # of one value, e.g. float32; "string" for text
    nesting: Shape = ()  # lengths of the sequences around it, outermost first, with None where they vary
    encoding: str = "none"  # none, bytes or zlib
    codec: str | None = None  # png or jpeg for images, as stated; the images themselves may differ

    @property
    def width(self) -> int | None:
        """Return the number of values a step; None where it varies."""
        sizes = self.nesting[1:] + self.shape
        return None if None in sizes else math.prod(size for size in sizes if size is not None)


def read_features(text: bytes, where: str) -> dict[str, RldsFeature]:
    """Return the leaves of a features.json by name, in its order.

    Raises:
        SourceError: it is not JSON, or not what TFDS writes.
    """
    try:
        return {leaf.name: leaf for leaf in _leaves(json.loads(text), "", ())}
    except (ValueError, KeyError, TypeError, AttributeError, OverflowError, RecursionError) as fault:
        said = f"is not a TFDS features.json: {fault!r}"
        raise SourceError(where, said, "write it again with tensorflow_datasets") from fault


def _leaves(node: dict[str, Any], name: str, nesting: Shape) -> list[RldsFeature]:
    if "featuresDict" in node:
        children = node["featuresDict"].get("features", {})
        home = f"{name}/" if name else ""
        return [leaf for key, child in children.items() for leaf in _leaves(child, home + key, nesting)]
    if "sequence" in node:
        content = node["sequence"]
        return _leaves(content["feature"], name, (*nesting, _size(content.get("length"))))
    return [_leaf(node, name, nesting)]


def _leaf(node: dict[str, Any], name: str, nesting: Shape) -> RldsFeature:
    for key, fixed in FIXED.items():
        if key in node:
            return RldsFeature(name, *fixed, nesting)
    content = node.get("tensor") or node.get("image")
    if not content:
        return RldsFeature(name, "other", (), str(node["pythonClassName"]).rsplit(".", 1)[-1], nesting)
    shape = tuple(map(_size, content.get("shape", {}).get("dimensions", ())))
    dtype = str(content.get("dtype") or "")
    if "image" in node:
        codec = content.get("encodingFormat") or "png"
        return RldsFeature(name, "image", shape or (None, None, 3), dtype or "uint8", nesting, codec=codec)
    if dtype in ("string", "object", "str"):
        return RldsFeature(name, "text", shape, "string", nesting)
    try:
        readable = dtype == BFLOAT16 or np.dtype(dtype).kind in "fiub"
    except TypeError:  # float8 and the like
        readable = False
    encoding = str(content.get("encoding") or "none")
    return RldsFeature(name, "number" if readable else "other", shape, dtype, nesting, encoding)


def _size(value: Any) -> int | None:
    return None if value is None or int(value) < 0 else int(value)


# -- records


class Steps:
    """One record and its columns over the steps; `features` are by their path in a step.

    Raises:
        EpisodeError: (here and in every method) there are no steps, or a feature is missing, of another
            kind, ragged, or has not T rows.
    """

    def __init__(self, example: Example, features: dict[str, RldsFeature], name: str) -> None:
        self.example, self.features, self.name = example, features, name
        counts = map(self._rows, sorted(features.values(), key=lambda item: item.width or 0))
        count = next((count for count in counts if count is not None), None)
        if count is None:
            raise EpisodeError(name, "holds none of the features that features.json names")
        if not count:
            raise EpisodeError(name, "has no steps")
        self.count = count

    def numbers(self, key: str) -> Array:
        """Return a feature of numbers over the steps: (T, …) in its dtype."""
        feature = self.features[key]
        name, sizes = self._stored(feature)
        inner = feature.shape
        if feature.encoding != "none":
            values = self._decoded(feature, name)
            inner = values.shape[1:]
        else:
            values = self.example.numbers(name).astype(_given(feature), copy=False)
        try:
            return values.reshape([*sizes, *(-1 if size is None else size for size in inner)])
        except ValueError as fault:
            said = f"{name} has {values.size} values, {self.count} steps of {_printed(feature)} are expected"
            raise EpisodeError(self.name, said) from fault

    def blobs(self, key: str) -> list[bytes]:
        """Return a feature of byte strings over the steps: T of them."""
        name, _ = self._stored(self.features[key])
        blobs = self.example.blobs(name)
        if len(blobs) != self.count:
            raise EpisodeError(self.name, f"{name} has {len(blobs)} entries for {self.count} steps")
        return blobs

    def text(self, key: str) -> str:
        """Return the first text of a key, which may have several a step; empty where the steps have none."""
        name = self.features[key].name
        ragged = f"{name}/ragged_flat_values"
        blobs = self.example.blobs(ragged if ragged in self.example else name)
        return next(filter(None, blobs), b"").decode(errors="replace")

    def decoder(self, key: str) -> Decode:
        """Return a function that maps a step to the image (H, W, 3) of a key."""
        feature, where = self.features[key], f"{self.name}: {key}"
        if feature.kind == "number" and (feature.encoding == "none" or feature.shape.count(None) > 1):
            whole = cache(lambda: self.numbers(key))  # decoded when the first image is asked for
            return lambda index, least=0: whole()[index]
        blobs = self.blobs(key)
        if feature.kind == "number":
            return lambda index, least=0: _tensor_of(blobs[index], feature, feature.shape, self.name)
        return lambda index, least=0: decode_image(blobs[index], f"{where}, step {index}", least)

    def _rows(self, feature: RldsFeature) -> int | None:
        """Return the number of steps of a feature, if it can be known without the other features."""
        lengths = f"{feature.name}/ragged_row_lengths_0"
        if lengths in self.example:
            return len(self.example.ints(lengths))
        if feature.name not in self.example:
            return None
        if feature.kind in ("image", "text") or feature.encoding != "none":
            count = len(self.example.blobs(feature.name))
            return count // feature.width if feature.kind == "text" and feature.width else count
        return len(self.example.numbers(feature.name)) // feature.width if feature.width else None

    def _stored(self, feature: RldsFeature) -> tuple[str, list[int]]:
        """Return (name that holds the values, sizes of the sequences around each value, T first)."""
        if f"{feature.name}/ragged_flat_values" not in self.example:
            inner = [-1 if size is None else size for size in feature.nesting[1:]]
            dynamic = f"{feature.name}/value"  # a tensor of several unknown sizes keeps its shape beside it
            return dynamic if dynamic in self.example else feature.name, [self.count, *inner]
        sizes = [self.count]
        for level in range(len(feature.nesting) - 1):
            lengths = self.example.ints(f"{feature.name}/ragged_row_lengths_{level}")
            if len(lengths) != math.prod(sizes):
                said = f"{feature.name} has {len(lengths)} rows for {math.prod(sizes)}"
                raise EpisodeError(self.name, said)
            if len(lengths) and (lengths != lengths[0]).any():
                said = f"{feature.name} varies from {lengths.min()} to {lengths.max()} entries per step"
                raise EpisodeError(self.name, said)
            sizes.append(int(lengths[0]) if len(lengths) else 0)
        return f"{feature.name}/ragged_flat_values", sizes

    def _decoded(self, feature: RldsFeature, name: str) -> Array:
        """Decode the tensors that are stored as bytes or zlib; return (n, …)."""
        blobs = self.example.blobs(name)
        shapes: Any = [feature.shape] * len(blobs)
        if name.endswith("/value"):
            shapes = self.example.ints(f"{feature.name}/shape")
            if len(shapes) != len(blobs) * len(feature.shape):
                said = f"{feature.name} has {len(shapes)} sizes for {len(blobs)} tensors"
                raise EpisodeError(self.name, said)
            shapes = shapes.reshape(len(blobs), -1)
        values = [_tensor_of(blob, feature, shape, self.name) for blob, shape in zip(blobs, shapes)]
        if len({value.shape for value in values}) > 1:
            raise EpisodeError(self.name, f"{feature.name} changes shape from step to step")
        return np.stack(values) if values else np.zeros((0, 0), _given(feature))


def scalar(example: Example, feature: RldsFeature) -> Any:
    """Return a feature outside the steps as a bool, int, float or str; None where it is not one value."""
    if feature.name not in example or feature.nesting or feature.shape or feature.encoding != "none":
        return None
    if feature.kind == "text":
        blobs = example.blobs(feature.name)
        return blobs[0].decode(errors="replace") if blobs else None
    values = example.numbers(feature.name) if feature.kind == "number" else ()
    return np.asarray(values).astype(_given(feature))[0].item() if len(values) == 1 else None


def _tensor_of(blob: bytes, feature: RldsFeature, shape: Any, where: str) -> Array:
    """Decode one tensor that is encoded to bytes; at most one of the sizes of `shape` is None."""
    sizes = [-1 if size is None else int(size) for size in shape]
    dtype = np.dtype(np.uint16 if feature.dtype == BFLOAT16 else feature.dtype)
    limit = MAX_TENSOR_BYTES if -1 in sizes else math.prod(sizes) * dtype.itemsize + 1
    try:
        if feature.encoding == "zlib":
            blob = zlib.decompressobj().decompress(blob, min(limit, MAX_TENSOR_BYTES))
        values = np.frombuffer(blob, dtype).reshape(sizes)
    except (zlib.error, ValueError) as fault:
        raise EpisodeError(where, f"{feature.name} is not {_printed(feature)}: {fault}") from fault
    if feature.dtype == BFLOAT16:
        return (values.astype(np.uint32) << 16).view(np.float32)
    return values


def _given(feature: RldsFeature) -> np.dtype:
    """Return the dtype of the values that are handed out."""
    return np.dtype(np.float32 if feature.dtype == BFLOAT16 else feature.dtype)


def _printed(feature: RldsFeature) -> str:
    sizes = ", ".join("?" if size is None else str(size) for size in (*feature.nesting[1:], *feature.shape))
    return f"{feature.dtype} ({sizes})"
