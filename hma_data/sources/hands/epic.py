"""Read EPIC-KITCHENS-100's published hand-object detections, one file a video.

The published files are Python pickles of a list of byte strings; each byte string is a protobuf message of
one frame. Nothing is unpickled here: the file's instructions are read one by one, and only those that make a
list of byte strings are accepted; any other file is refused. A plain stream of the same messages, each after
its length as a varint (`.pb`), is read too.

Format: types.proto of epic-kitchens/epic-kitchens-100-hand-object-bboxes. Boxes are fractions of the picture;
frames count from 1.
"""

import pickletools
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any, cast

import numpy as np

from hma_data.errors import EpisodeError
from hma_data.sources.hands.layout import HandsLayout
from hma_data.sources.hands.runs import HandLabels, labels_from_rows

PICKLES, STREAMS = (".pkl", ".pickle"), (".pb", ".pb2", ".bin")
LARGEST = 2 << 30  # bytes; the longest video's file has some 50 MB
_BYTES = ("SHORT_BINBYTES", "BINBYTES", "BINBYTES8")
_REMEDY = (
    "save the frames' messages as a .pb stream, or as a table with the columns "
    "video, frame, side, left, top, right, bottom, score"
)


def epic_labels(path: Path, layout: HandsLayout) -> HandLabels:
    """Return the hands of one video.

    Raises:
        EpisodeError: the file is damaged, or of another form.
    """
    if path.stat().st_size > LARGEST:
        raise EpisodeError(path, f"has {path.stat().st_size:,} bytes, more than {LARGEST:,}")
    from google.protobuf.message import DecodeError  # type: ignore[import-untyped]

    content = path.read_bytes()
    messages = _pickled(content, path) if path.suffix.lower() in PICKLES else _stream(content, path)
    looked_at, rows = [], []
    for number, message in enumerate(messages):
        try:
            frame = _message_class().FromString(message)
        except DecodeError as fault:
            raise EpisodeError(path, f"message {number} is no frame's detections", _REMEDY) from fault
        index = frame.frame_number - layout.frame_offset
        looked_at.append(index)
        for hand in frame.hands:
            if hand.score >= layout.min_score:
                box = hand.bbox
                centre = ((box.left + box.right) / 2, (box.top + box.bottom) / 2)
                rows.append((index, hand.side, hand.score, *centre))
    if not looked_at:
        raise EpisodeError(path, "has no frames", _REMEDY)
    table = np.array(rows, np.float64).reshape(-1, 5)
    return labels_from_rows(
        table[:, 0].astype(np.int64),
        table[:, 1].astype(np.int64),
        table[:, 2],
        {"center": table[:, 3:]},
        looked_at,
    )


def _pickled(content: bytes, path: Path) -> Iterator[bytes]:
    """Yield the byte strings of a pickled list by reading its instructions; nothing in it is run."""
    kept: dict[int, Any] = {}  # the pickle's memo: values that later instructions refer to
    last: Any = None
    try:
        for instruction, given, _ in pickletools.genops(content):
            name, value = instruction.name, cast(Any, given)
            if name in _BYTES:
                last = value
                yield value
            elif name == "EMPTY_LIST":
                last = None
            elif name in ("MEMOIZE", "BINPUT", "LONG_BINPUT"):
                kept[len(kept) if value is None else value] = last
            elif name in ("BINGET", "LONG_BINGET") and isinstance(kept.get(value), bytes):
                yield kept[value]
            elif name not in ("PROTO", "FRAME", "MARK", "APPEND", "APPENDS", "STOP"):
                raise EpisodeError(path, f"holds more than byte strings ({name}), and is not opened", _REMEDY)
    except ValueError as fault:
        raise EpisodeError(path, f"is damaged or no pickled list: {fault}", _REMEDY) from fault


def _stream(content: bytes, path: Path) -> Iterator[bytes]:
    """Yield messages that each follow their length, seven bits a byte, low ones first."""
    at = 0
    while at < len(content):
        length = shift = 0
        more = True
        while more and at < len(content) and shift < 64:
            length |= (content[at] & 0x7F) << shift
            more, shift, at = content[at] >= 0x80, shift + 7, at + 1
        if more or at + length > len(content):
            raise EpisodeError(path, f"is cut off or damaged at byte {at:,}", _REMEDY)
        yield content[at : at + length]
        at += length


@cache
def _message_class() -> Any:
    """Return the class of a frame's detections; its field numbers are those of types.proto."""
    from google.protobuf import descriptor_pb2, descriptor_pool, message_factory  # type: ignore[import-untyped]

    kinds = descriptor_pb2.FieldDescriptorProto
    real, whole, text = kinds.TYPE_FLOAT, kinds.TYPE_INT32, kinds.TYPE_STRING
    file = descriptor_pb2.FileDescriptorProto(name="hands.proto", package="hands", syntax="proto3")
    layout: dict[str, list[tuple[str, int, Any]]] = {
        "Box": [("left", 1, real), ("top", 2, real), ("right", 3, real), ("bottom", 4, real)],
        "Hand": [("bbox", 1, ".hands.Box"), ("score", 2, real), ("side", 5, whole)],
        "Frame": [("video_id", 1, text), ("frame_number", 2, whole), ("hands", 3, ".hands.Hand")],
    }
    for name, fields in layout.items():
        message = file.message_type.add(name=name)
        for field, number, kind in fields:
            added = message.field.add(name=field, number=number, label=kinds.LABEL_OPTIONAL)
            added.type = kinds.TYPE_MESSAGE if isinstance(kind, str) else kind
            if isinstance(kind, str):
                added.type_name = kind
            if field == "hands":
                added.label = kinds.LABEL_REPEATED
    pool = descriptor_pool.DescriptorPool()
    pool.Add(file)
    return message_factory.GetMessageClass(pool.FindMessageTypeByName("hands.Frame"))
