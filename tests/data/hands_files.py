"""Annotations of hands made for tests, in their publishers' forms, by other code than the source's.

Hand places are made up so that each says its frame: the left hand moves right, the right one down.
"""

import json
import struct
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hma_data.registry.embodiment import Embodiment
from tests.data.videos import HEIGHT, WIDTH, encode

JOINTS = ["wrist"] + [f"{f}_{i}" for f in ("thumb", "index", "middle", "ring", "pinky") for i in range(1, 5)]


def place(side: str, frame: int) -> tuple[float, float]:
    return (0.1 + 0.01 * frame, 0.25) if side == "left" else (0.75, 0.2 + 0.01 * frame)


def expected(frames: Iterable[int]) -> np.ndarray:
    return np.array([[*place("left", i), *place("right", i)] for i in frames], np.float32)


def hand_video(
    labels: str, part: str = "center", action: str = "/next", hz: float | None = 10, **layout: str
) -> Embodiment:
    def vector(suffix: str) -> dict[str, Any]:
        keys = [f"{side}/{part}{suffix}" for side in ("left", "right")]
        return {"components": [{"key": key, "dims": 2} for key in keys]}

    values = {
        "id": "test_hands",
        "kind": "human",
        "frequency_hz": hz,
        "action": {"space": "hand_2d"} | vector(action),
        "state": vector(""),
        "cameras": [{"name": "primary", "key": "video"}],
        "sync": {} if hz else {"rate_hz": 20.0},
        "source": {"format": "hands", "layout": {"labels": labels} | layout},
    }
    return Embodiment.from_values(values, "test_hands")


Seen = Callable[[str, int], bool]


def always(side: str, frame: int) -> bool:
    return True


def rows(video: str, length: int, seen: Seen = always) -> list[dict[str, Any]]:
    return [
        {"video": video, "frame": i, "side": side, "x": place(side, i)[0], "y": place(side, i)[1]}
        for i in range(length)
        for side in ("left", "right")
        if seen(side, i)
    ]


LENGTH, GONE = 30, range(10, 13)  # frames of `write_gap`, and those without the right hand


def write_gap(folder: Path, table: str) -> Path:
    """Write a video of two hands, of which the right one is gone for some frames, and its table."""
    encode(folder / "a.mp4", range(LENGTH))
    write_table(folder / table, rows("a", LENGTH, lambda side, i: side == "left" or i not in GONE))
    return folder


def write_table(path: Path, table: list[dict[str, Any]]) -> Path:
    if path.suffix == ".parquet":
        pq.write_table(pa.Table.from_pylist(table), path)
    else:
        lines = [",".join(table[0]), *(",".join(map(str, row.values())) for row in table)]
        path.write_text("\n".join(lines) + "\n")
    return path


# -- EPIC-KITCHENS: protobuf by hand


def varint(number: int) -> bytes:
    out = b""
    while number > 0x7F:
        out, number = out + bytes([number & 0x7F | 0x80]), number >> 7
    return out + bytes([number])


def _field(number: int, content: bytes | int | float) -> bytes:
    if isinstance(content, float):
        return varint(number << 3 | 5) + struct.pack("<f", content)
    if isinstance(content, int):
        return varint(number << 3) + varint(content) if content else b""
    return varint(number << 3 | 2) + varint(len(content)) + content


def epic_message(number: int, hands: Iterable[tuple[str, float, tuple[float, float]]]) -> bytes:
    """One frame's detections: side, score and centre of each hand; an object and states stand beside them."""
    out = _field(1, b"P01_01") + _field(2, number)
    for side, score, (x, y) in hands:
        box = b"".join(_field(i + 1, v) for i, v in enumerate((x - 0.05, y - 0.1, x + 0.05, y + 0.1)))
        offset = _field(1, 0.1) + _field(2, -0.1)
        hand = _field(1, box) + _field(2, score) + _field(3, 3) + _field(4, offset)
        out += _field(3, hand + _field(5, int(side == "right")))
    return out + _field(4, _field(1, _field(1, 0.5)) + _field(2, 0.9))


def epic_messages(length: int) -> list[bytes]:
    hands = ("left", "right")
    return [epic_message(i + 1, [(side, 0.9, place(side, i)) for side in hands]) for i in range(length)]


# -- Ego4D and Ego-Exo4D


def ego4d_box(kind: str, x: float, y: float) -> dict[str, Any]:
    box = {"x": x * WIDTH - 5, "y": y * HEIGHT - 4, "width": 10, "height": 8}
    return {"object_type": kind, "structured_noun": None, "bbox": box}


def ego4d_action(frames: Iterable[int], text: str, **said: Any) -> dict[str, Any]:
    return {
        "uid": text,
        "narration_text": text,
        "is_rejected": False,
        "is_invalid_annotation": False,
        "stage": "post_condition",
        "critical_frames": {"pre_frame": 0, "pnr_frame": 1},
        "frames": [
            {
                "frame_number": i,
                "frame_type": "pre_45",
                "boxes": [
                    ego4d_box("left_hand", *place("left", i)),
                    ego4d_box("right_hand", *place("right", i)),
                    ego4d_box("object_of_change", 0.5, 0.5),
                ],
            }
            for i in frames
        ],
    } | said


def ego4d(videos: dict[str, list[dict[str, Any]]]) -> str:
    items = [
        {
            "video_uid": uid,
            "annotated_intervals": [{"clip_uid": uid, "start_sec": 0, "narrated_actions": actions}],
            "video_metadata": {"fps": 10},
        }
        for uid, actions in videos.items()
    ]
    return json.dumps({"date": "211014", "version": "v2", "videos": items})


def egoexo(length: int, camera: str = "cam01") -> str:
    """A take's hand labels: each joint a hundredth of the picture right of the one before."""
    found = {}
    for i in range(length):
        joints = {
            f"{side}_{joint}": {
                "x": (place(side, i)[0] + 0.01 * number) * WIDTH,
                "y": place(side, i)[1] * HEIGHT,
                "placement": "auto",
            }
            for side in ("left", "right")
            for number, joint in enumerate(JOINTS)
        }
        metadata = {"take_uid": "uid-1", "take_name": "cook_1", "frame_number": i}
        found[str(i)] = [
            {"metadata": metadata, "annotation2D": {camera: joints, "cam09": {}}, "annotation3D": {}}
        ]
    return json.dumps(found)
