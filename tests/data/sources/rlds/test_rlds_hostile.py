"""RLDS folders that are damaged, hostile, or not what the robot's YAML says."""

import shutil
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from tests.data import rlds_files
from tests.data.rlds_files import encode, frame, image, png, tensor
from tests.data.sources.rlds.test_rlds import STEPS, embodiment, pictures, record
from tests.hostile import Edit, Row, check_refused, cut, flip, of, swap, untouched, values, whole

SHARD, INFO, FEATURES = "toy-train.tfrecord-00000-of-00001", "dataset_info.json", "features.json"
MORE = {
    "depth": image((8, 8, 1), dtype="uint16"), "zipped": tensor((3,), "float32", "zlib"),
    "text": STEPS["language_instruction"],
}  # fmt: skip


def episode(number: int, steps: int = 3) -> dict[str, Any]:
    own = {"zipped": [zlib.compress(bytes(12))] * steps, "text": [b"a"] * steps}
    own["depth"] = [png(np.zeros((8, 8), np.uint16))] * steps
    return record(number, steps) | {f"steps/{key}": value for key, value in own.items()}


def first(**changes: Any) -> Edit:
    """Return an edit that gives the first episode other values; None leaves it without any."""

    def edit(path: Path) -> None:
        begin = episode(0) | {f"steps/{name.replace('__', '/')}": value for name, value in changes.items()}
        records = [begin if changes else {}, episode(1), episode(2)]
        path.write_bytes(b"".join(frame(encode(item)) for item in records))

    return of(SHARD, edit)


def splits(count: Any) -> list[dict[str, Any]]:
    return [{"name": "train", "shardLengths": [count, "4"]}]


def acts(key: str, dims: int) -> dict[str, Any]:
    return {"action": {"space": "mixed", "components": [{"key": key, "dims": dims}]}, "state": None}


def sees(key: str) -> dict[str, Any]:
    return {"cameras": [{"name": "a", "key": key}]}


EMPTY: dict[str, list[bytes]] = {name.removeprefix("steps/").replace("/", "__"): [] for name in episode(0)}
NAN = np.array([0.0, 1.0, float("nan"), 0.0, 0.0, 0.0], np.float32)
WIDE = acts("observation/state", 7)
BOMB = [zlib.compress(bytes(50_000_000))] * 3
ONE: dict[str, Row] = {  # one episode is refused
    "an action too many": (first(action__move=np.zeros(8, np.float32)), "8 values"),
    "a value too many": (first(action__move=np.zeros(7, np.float32)), "7 values"),
    "an image for three steps": (first(observation__image=[png(pictures(0, 1)[0])]), "1 entries for 3 steps"),
    "junk for images": (first(observation__image=[b"junk"] * 3), "observation/image"),
    "no steps": (first(**EMPTY), "no steps"),
    "none of the features": (first(), "none of the features"),
    "actions of NaN": (first(action__move=NAN), "not finite"),
    "a bomb": (first(zipped=BOMB), r"is not float32 \(3\)", acts("zipped", 3)),
    "a record cut short": (of(SHARD, cut(-9)), "cut off at byte"),
    "a changed byte": (of(SHARD, flip(40)), "checksum"),
}
INSPECTED = {"actions of NaN": "action/move is not finite at step 1", "a record cut short": "cut off at byte"}
INFINITE = '{"tensor": {"dtype": "float32", "shape": {"dimensions": [1e400]}}}'
ALL: dict[str, Row] = {  # no episode can be used
    "no features": (of(FEATURES, Path.unlink), "has no features.json"),
    "features cut short": (of(FEATURES, cut(1)), "not a TFDS features.json"),
    "features nested too deeply": (of(FEATURES, whole("[" * 100_000)), "not a TFDS features.json"),
    "a size of infinity": (of(FEATURES, whole(INFINITE)), "not a TFDS features.json"),
    "more records than can be": (
        of(INFO, swap('"3"', '"3000000000"')),
        r"shardLengths\.0 is '3000000000': must",
    ),
    "info cut short": (of(INFO, cut(1)), "Invalid JSON"),
    "another container": (of(INFO, whole('{"fileFormat": "riegeli"}')), "riegeli files"),
    "records left out": (of(INFO, swap('"3"', '"2"')), r"has 3 records, dataset_info\.json says 2"),
    "no shard": (of(SHARD, Path.unlink), "holds no TFRecord file"),
    "an empty shard": (of(SHARD, cut(0)), "holds no readable episode"),
    "a packed shard": (of(SHARD, whole(b"\x1f\x8b" + bytes(40))), "gzip-compressed"),
    "zeros": (of(SHARD, whole(bytes(400))), "holds no readable episode"),
    "nothing": (shutil.rmtree, "does not exist"),
    "no such key": (untouched, "no key 'action/mov'.*did you mean action/move", acts("action/mov", 2)),
    "another width": (untouched, "state has 3 values a step, the embodiment says 7", WIDE),
    "text": (untouched, "text is text of string, not numbers", acts("text", 1)),
    "numbers": (untouched, "action/move is a tensor of float32, not a colour image", sees("action/move")),
    "depth": (untouched, "depth is an image of uint16, not a colour image", sees("depth")),
}

ALL |= {
    f"{count!r} records": (of(INFO, values(splits=splits(count))), r"splits\.0\.shardLengths\.0 is")
    for count in (-3, "many", None)
}


@pytest.mark.parametrize("case", [*ONE, *ALL])
def test_a_hostile_folder_is_one_line(case: str, tmp_path: Path) -> None:
    folder = rlds_files.write(tmp_path / "set", {SHARD: [episode(i) for i in range(3)]}, STEPS | MORE)
    row, inspected = (ONE | ALL)[case], INSPECTED.get(case, "")
    robot = embodiment(**dict(*row[2:]))
    check_refused(row, folder, robot, tmp_path / "out", one=case in ONE, inspected=inspected)
