"""Records that cannot be used as they are: one line of error, or the rest of them with a finding."""

import shutil
import zlib
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hma_data.episodes.align import to_clip
from hma_data.errors import EpisodeError
from hma_data.inspection.infer import infer
from hma_data.inspection.inspect import examine
from hma_data.sources.base import open_source
from hma_data.storage.yaml_io import parse_yaml
from tests.data import rlds_files
from tests.data.rlds_files import SHARD, encode, frame, image, png, tensor
from tests.data.sources.rlds.test_rlds import STEPS, embodiment, pictures, read, record, write
from tests.hostile import Edit, Row, check_refused, cut, flip, of, swap, untouched, values, whole

INFO, FEATURES = "dataset_info.json", "features.json"
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
    "no info": (of(INFO, Path.unlink), "has no dataset_info.json.* copy it from where the records are from"),
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
    "no shard": (
        of(SHARD, Path.unlink),
        r"no file that dataset_info\.json names — .* like toy-train\.",
    ),
    "an empty shard": (of(SHARD, cut(0)), "holds no readable episode"),
    "a packed shard": (of(SHARD, whole(b"\x1f\x8b" + bytes(40))), "gzip-compressed"),
    "zeros": (of(SHARD, whole(bytes(400))), "holds no readable episode"),
    "nothing": (shutil.rmtree, "does not exist"),
    "no such key": (untouched, "no key 'action/mov'.*did you mean 'action/move'", acts("action/mov", 2)),
    "another width": (untouched, "state has 3 values per step, the embodiment says 7", WIDE),
    "text": (untouched, r"text holds text values \(string\), not numbers", acts("text", 1)),
    "numbers": (untouched, r"move holds number values \(float32\), not colour images", sees("action/move")),
    "depth": (untouched, r"depth holds image values \(uint16\), not colour images", sees("depth")),
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


# -- steps


COUNT = 8
FLAGS = {"is_first": tensor((), "bool"), "is_last": tensor((), "bool")}


def flagged(last_action: tuple[float, float] | None = None, first=(0,), last=(COUNT - 1,)) -> dict:
    """A record whose flags are 1 at those steps, and whose last action is another if given."""
    found = record(0, COUNT)
    found["steps/action/move"] = np.arange(1, 2 * COUNT + 1, dtype=np.float32)
    if last_action is not None:
        found["steps/action/move"][-2:] = last_action
    found["steps/is_first"] = [int(i in first) for i in range(COUNT)]
    found["steps/is_last"] = [int(i in last) for i in range(COUNT)]
    return found


def folder_of(path: Path, *records: dict) -> Path:
    return write(path / "toy", {SHARD: list(records)}, STEPS | FLAGS)


@pytest.mark.parametrize("padding", [(0.0, 0.0), (np.nan, np.nan), (np.inf, 1.0)])
def test_the_padding_of_the_last_step_is_left_out_and_said(padding, tmp_path: Path) -> None:
    folder = folder_of(tmp_path, flagged(padding))
    clip = to_clip(read(folder, "train/000000"), embodiment())
    assert len(clip) == COUNT - 1 and clip.flags["padded_steps"] == 1
    np.testing.assert_array_equal(clip.actions[:, :2].ravel(), np.arange(1, 2 * COUNT - 1))
    assert clip.frames_at("primary" if "primary" in clip.frame_indices else "top", np.arange(7)).shape[0] == 7
    found = open_source("rlds").inspect(folder)
    assert found.problems == ()
    (said,) = [one.message for one in found.findings if one.check == "padding"]
    assert "action/move" in said and "is_last" in said
    assert not [one for one in examine(folder) if one.severity == "error"]
    assert "is_last" in parse_yaml(infer(str(folder), "x"), "x")["provenance"]["last_step"]


@pytest.mark.parametrize(
    "item",
    [
        flagged(),  # a last action of its own
        flagged((0.0, 3.0)),
        flagged((0.0, 0.0), last=()),  # zeros that no flag calls padding
    ],
)
def test_a_last_action_that_is_no_padding_is_kept(item: dict, tmp_path: Path) -> None:
    clip = to_clip(read(folder_of(tmp_path, item), "train/000000"), embodiment())
    assert len(clip) == COUNT and "padded_steps" not in clip.flags


def test_nan_within_an_episode_is_no_padding(tmp_path: Path) -> None:
    item = flagged((np.nan, np.nan))
    item["steps/action/move"][4] = np.nan
    with pytest.raises(EpisodeError, match="not finite at frame 2"):
        to_clip(read(folder_of(tmp_path, item), "train/000000"), embodiment())


def test_a_record_of_two_episodes_is_refused_with_the_step(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, flagged(first=(0, 5), last=(4, 7)), flagged())
    with pytest.raises(EpisodeError, match="is_first again at step 5: the record holds 2 episodes"):
        read(folder, "train/000000")
    assert len(to_clip(read(folder, "train/000001"), embodiment())) == COUNT
    assert any("is_first again at step 5" in one for one in open_source("rlds").inspect(folder).problems)


def test_flags_that_are_set_at_every_step_say_nothing(tmp_path: Path) -> None:
    folder = folder_of(tmp_path, flagged(first=range(COUNT)))
    assert len(to_clip(read(folder, "train/000000"), embodiment())) == COUNT
