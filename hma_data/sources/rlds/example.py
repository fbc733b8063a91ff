"""Parse the features of a record, a tf.train.Example.

An Example maps names to lists of bytes, float32 or int64. Parsing only finds where each list lies; byte
strings stay views into the record. So a feature that is not read costs nothing.
(Format: protobuf encoding; messages Example, Features, Feature of TensorFlow.)
"""

from collections.abc import Callable, Iterator

import numpy as np
from numpy.typing import NDArray

from hma_data.arrays import Float32s, Ints
from hma_data.errors import EpisodeError

VARINT, FIXED64, BYTES, FIXED32 = 0, 1, 2, 5  # wire types of protobuf
KINDS = {1: "bytes", 2: "float", 3: "int"}  # field numbers of Feature's lists
Span = tuple[int, int]


class Example:
    """The features of one record of the episode `where`.

    Raises:
        EpisodeError: (here and in every method) the bytes are not an Example, a feature is missing
            or of another kind.
    """

    def __init__(self, data: bytes, where: str) -> None:
        self._data, self._where = data, where
        try:
            self._lists = dict(_features(data))
        except ValueError as fault:
            raise EpisodeError(where, f"is not a tf.train.Example: {fault}") from fault

    def __contains__(self, name: str) -> bool:
        return name in self._lists

    @property
    def size(self) -> int:
        """Return the number of bytes of the record."""
        return len(self._data)

    def blobs(self, name: str) -> list[memoryview]:
        """Return the byte strings of a feature, as views into the record."""
        return self._items(name, "bytes")

    def numbers(self, name: str) -> Float32s | Ints:
        """Return the (n,) numbers of a feature, float32 or int64 as stored."""
        if self._list(name)[0] == "float":
            return self._joined(name, "float", lambda data: data.view("<f4"))
        return self.ints(name)

    def ints(self, name: str) -> Ints:
        """Return the (n,) integers of a feature."""
        return self._joined(name, "int", varints)

    def _joined(self, name: str, kind: str, parse: Callable[[NDArray[np.uint8]], NDArray]) -> NDArray:
        try:
            parts = [parse(np.frombuffer(item, np.uint8)) for item in self._items(name, kind)]
        except ValueError as fault:
            raise EpisodeError(self._where, f"{name}: {fault}") from fault
        return parts[0] if len(parts) == 1 else np.concatenate([parse(np.zeros(0, np.uint8)), *parts])

    def _list(self, name: str) -> tuple[str, Span]:
        if name not in self._lists:
            raise EpisodeError(self._where, f"has no feature {name!r}")
        return self._lists[name]

    def _items(self, name: str, kind: str) -> list[memoryview]:
        found, (start, stop) = self._list(name)
        if found not in (kind, "empty"):
            raise EpisodeError(self._where, f"{name} is a list of {found}, not of {kind}")
        view = memoryview(self._data)
        try:
            return [view[slice(*span)] for number, _, span in fields(self._data, start, stop) if number == 1]
        except ValueError as fault:
            raise EpisodeError(self._where, f"{name}: {fault}") from fault


def varints(data: NDArray[np.uint8]) -> Ints:
    """Decode packed varints to int64, without a loop over them.

    Raises:
        ValueError: the last is cut off, or one is longer than ten bytes.
    """
    last = np.flatnonzero(data < 0x80)
    if len(last) == len(data):
        return data.astype(np.int64)
    if not len(last) or last[-1] != len(data) - 1:
        raise ValueError("its last varint is cut off")
    first = np.concatenate([[0], last[:-1] + 1])
    lengths = last - first + 1
    if lengths.max() > 10:
        raise ValueError("a varint is longer than ten bytes")
    values = np.zeros(len(last), np.uint64)
    for place in range(int(lengths.max())):
        longer = np.flatnonzero(lengths > place)
        bits = (data[first[longer] + place] & 0x7F).astype(np.uint64)
        values[longer] |= bits << np.uint64(7 * place)
    return values.view(np.int64)


def _features(data: bytes) -> Iterator[tuple[str, tuple[str, Span]]]:
    """Yield (name, (kind, span of its list)) of each feature: the entries of Example.features.feature."""
    for number, wire, (start, stop) in fields(data, 0, len(data)):
        if number != 1 or wire != BYTES:
            continue
        for entry, entry_wire, span in fields(data, start, stop):
            if entry == 1 and entry_wire == BYTES:
                yield _entry(data, *span)


def _entry(data: bytes, start: int, stop: int) -> tuple[str, tuple[str, Span]]:
    """Parse a map entry: key 1, value 2."""
    name, value = "", ("empty", (start, start))
    for number, wire, span in fields(data, start, stop):
        if wire == BYTES and number == 1:
            name = data[slice(*span)].decode()
        elif wire == BYTES and number == 2:
            for kind, kind_wire, inner in fields(data, *span):
                if kind in KINDS and kind_wire == BYTES:
                    value = (KINDS[kind], inner)
    return name, value


def fields(data: bytes, position: int, end: int) -> Iterator[tuple[int, int, Span]]:
    """Yield (field number, wire type, span of its payload) of each field of a message.

    Raises:
        ValueError: it is no message.
    """
    while position < end:
        tag, position = varint(data, position, end)
        wire, start = tag & 7, position
        if wire == BYTES:
            length, start = varint(data, position, end)
            position = start + length
        elif wire == VARINT:
            position = varint(data, position, end)[1]
        elif wire in (FIXED32, FIXED64):
            position += 4 if wire == FIXED32 else 8
        else:
            raise ValueError(f"wire type {wire} at byte {start}")
        if position > end:
            raise ValueError(f"the field at byte {start} reaches beyond its message")
        yield tag >> 3, wire, (start, position)


def varint(data: bytes, position: int, end: int) -> tuple[int, int]:
    """Return (value, position after it).

    Raises:
        ValueError: it is cut off, or longer than ten bytes.
    """
    value = shift = 0
    while position < end and shift < 70:
        byte = data[position]
        position += 1
        value |= (byte & 0x7F) << shift
        if byte < 0x80:
            return value, position
        shift += 7
    raise ValueError(f"no varint at byte {position}")
