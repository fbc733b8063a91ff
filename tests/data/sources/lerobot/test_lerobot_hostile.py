"""LeRobotDatasets that are damaged, hostile, or not what the robot's YAML says."""

import shutil
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hma_data.sources.lerobot import rows
from tests.data.sources.lerobot.test_lerobot import embodiment
from tests.data.videos import CAMERA, STILL, encode, make_v2, make_v3
from tests.hostile import Edit, Row, check_refused, cut, linked_away, of, swap, untouched, values, whole

INFO, LISTED, TASKS = "meta/info.json", "meta/episodes.jsonl", "meta/tasks.jsonl"
ROWS, FILM = "data/chunk-000/episode_000000.parquet", f"videos/chunk-000/{CAMERA}/episode_000000.mp4"
FIRST = '{"episode_index": 0, "length": 3}\n'


def info(**changes: Any) -> Edit:
    return of(INFO, values(**changes))


def film(frames: int, fps: int = 10) -> Edit:
    return of(FILM, lambda path: encode(path, range(frames), fps=fps))


def column(name: str, content: list[Any]) -> Edit:
    def edit(path: Path) -> None:
        table = pq.read_table(path)
        others = table.drop_columns([name] if name in table.column_names else [])
        pq.write_table(others.append_column(name, pa.array(content)), path)

    return of(ROWS, edit)


def sees(key: str) -> dict[str, Any]:
    return {"cameras": [{"name": "cam", "key": key}]}


NO_INFO = "has no meta/info.json — give the folder of a whole LeRobotDataset"
TOLD_BY_NUMBER = {"source__instruction": "frame_index"}
PAIR, STILLS = [1.0, 2.0], sees(STILL)
SIX = {"action__components": [{"key": "action", "dims": 6}]}
ONE: dict[str, Row] = {  # one episode is refused
    "a film is missing": (of(FILM, Path.unlink), r"episode_000000\.mp4: no such video"),
    "a short film": (film(11), "has 11 frames for 12 rows"),
    "a long film": (film(13), "has 13 frames for 12 rows"),
    "a film of another rate": (film(12, fps=15), "disagree on time"),
    "an empty film": (of(FILM, cut(0)), r"episode_000000\.mp4: is empty — copy"),
    "a film cut short": (of(FILM, cut(900)), r"episode_000000\.mp4: .* cut off"),
    "no rows": (of(ROWS, Path.unlink), r"episode_000000\.parquet"),
    "rows cut short": (of(ROWS, cut(500)), r"episode_000000\.parquet: .*copy it again"),
    "a row less": (
        of(ROWS, lambda path: pq.write_table(pq.read_table(path).slice(1), path)),
        "has 11 rows of episode_000000, its metadata says 12",
    ),
    "more rows than can be": (of(LISTED, swap('"length": 12', f'"length": {2**63}')), "its metadata says 9"),
    "rows of no episode": (
        of(ROWS, lambda path: pq.write_table(pq.read_table(path).drop_columns(["episode_index"]), path)),
        "has no column 'episode_index' — it has action",
    ),
    "too many rows": (
        of(ROWS, lambda path: pq.write_table(pa.table({"episode_index": [0] * 1001}), path)),
        "'episode_index' claims 1,001 values of 1,001 rows",
    ),
    "a list too short": (column("action", [PAIR] * 11 + [[1.0]]), "holds lists of"),
    "a row without action": (column("action", [PAIR] * 11 + [None]), "1 missing values"),
    "rows without numbers": (column("action", [[1.0, None]] * 12), "12 missing values"),
    "actions of text": (column("action", [["a", "b"]] * 12), "not numbers"),
    "actions of NaN": (column("action", [[1.0, float("nan")]] * 12), "not finite at frame 0"),
    "language of numbers": (column("language_persistent", [3] * 12), "not as lerobot writes it: TypeError"),
    "language without times": (column("language_persistent", [[{"a": 1}]] * 12), "writes it: KeyError"),
    "subtasks of NaN": (column("subtask_index", [float("nan")] * 12), "not as lerobot writes it: ValueError"),
    "words of no task": (
        column("frame_index", [*range(7, 19)]),
        "'frame_index' is 7, which is not the index of a task",
        TOLD_BY_NUMBER,
    ),
    "a film that is a link": (of(FILM, linked_away), r"episode_000000\.mp4: is a link to a file outside"),
    "rows that are a link": (of(ROWS, linked_away), r"episode_000000\.parquet: is a link to a file outside"),
    "pictures elsewhere": (column(STILL, [{"path": "../../etc/passwd"}] * 12), "outside the dataset", STILLS),
}
ALL: dict[str, Row] = {  # no episode can be used
    "v3: a film is missing": (of("**/*.mp4", Path.unlink), r"file-000\.mp4: no such video"),
    "v3: no info": (of(INFO, Path.unlink), NO_INFO),
    "no info": (of(INFO, Path.unlink), NO_INFO),
    "info that is a link": (of(INFO, linked_away), r"info\.json: is a link to a file outside"),
    "v3: a folder of links": (of("meta", linked_away), r"set/meta: is a link to a file outside"),
    "v3: films elsewhere": (of("videos", linked_away), r"file-000\.mp4: is a link to a file outside"),
    "an old version": (info(codebase_version="v1.6"), r"info\.json.*'v1\.6'; v2\.0, v2\.1, v3\.0 are read"),
    "no version": (info(codebase_version=None), r"info\.json.*version None"),
    "fps of 0": (info(fps=0), r"info\.json.*fps is 0: must be greater than 0"),
    "fps of words": (info(fps="fast"), r"info\.json.*fps is 'fast'"),
    "no features": (info(features={}), r"info\.json.*features is {}"),
    "no shape": (info(features={"action": {"dtype": "f4"}}), r"info\.json.*lacks features\.action\.shape"),
    "info cut short": (of(INFO, cut(1)), r"info\.json: Invalid JSON"),
    "info that is a list": (of(INFO, whole("[1]")), r"info\.json: .*must be a mapping"),
    "info without fps": (of(INFO, whole('{"codebase_version": "v2.1"}')), r"info\.json: lacks .*fps"),
    "deep brackets": (of(INFO, whole("[" * 100_000)), r"info\.json.*Invalid JSON"),
    "a line cut short": (of(LISTED, whole(FIRST + '{"epi')), r"episodes\.jsonl line 2: is not JSON"),
    "lines nested too deeply": (of(LISTED, whole("[" * 100_000)), r"episodes\.jsonl line 1: is not JSON"),
    "episode -1": (of(LISTED, whole(FIRST.replace("0", "-1"))), "whole number from 0, is -1"),
    "an episode twice": (of(LISTED, whole(FIRST * 2)), "lists episode 0 a second time"),
    "no episodes": (of(LISTED, cut(0)), "has no episodes"),
    "a task that is a number": (of(TASKS, whole("3")), r"tasks\.jsonl: holds 3, not an object"),
    "another rate": (untouched, "runs at 10 fps.*frequency_hz 30", {"frequency_hz": 30}),
    "no such camera": (untouched, f"is not a feature.*did you mean '{CAMERA}", sees(CAMERA + "era")),
    "no camera": (untouched, f"'action' is float32, not colour images.*{CAMERA}, {STILL}", sees("action")),
    "another width": (untouched, "action has 2 values, the embodiment says 6", SIX),
}
OUT = ("../{episode_index:06d}.parquet", "/etc/{episode_index}.parquet", "a/../../x")
ALL |= {f"rows in {name}": (info(data_path=name), "outside the dataset") for name in OUT}
ODD = ("{episode_index.__class__}", "{episode_index!r}", "{episode_index:>999999999d}", "{other}", "{")
ALL |= {f"rows in {name}": (info(data_path=name), r"info\.json") for name in ODD}

INSPECTED = {
    "a film is missing": f"1 of 3 videos of {CAMERA} are missing.*episode_000000.mp4",
    "v3: a film is missing": f"1 of 1 videos of {CAMERA} are missing.*file-000.mp4",
    "a short film": "has 11 frames for 12 rows",
    "a long film": "has 13 frames for 12 rows",
}


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    return {make.__name__: make(tmp_path_factory.mktemp("set"), (12, 9, 15)) for make in (make_v2, make_v3)}


@pytest.mark.parametrize("case", [*ONE, *ALL])
def test_a_hostile_dataset_is_one_line(case: str, made: dict[str, Path], tmp_path: Path, monkeypatch) -> None:
    folder = Path(shutil.copytree(made["make_v3" if case[:2] == "v3" else "make_v2"], tmp_path / "set"))
    if case == "too many rows":
        monkeypatch.setattr("hma_data.sources.lerobot.rows.MAX_VALUES", 1000)
    row = (ONE | ALL)[case]
    robot = embodiment(**dict(*row[2:]))
    check_refused(row, folder, robot, tmp_path / "out", one=case in ONE, inspected=INSPECTED.get(case, ""))


def test_a_large_column_does_not_refuse_one_whose_name_begins_its_own(tmp_path: Path, monkeypatch) -> None:
    monkeypatch.setattr(rows, "MAX_BYTES", 10_000)
    whole = pa.table({"action": pa.array([[0.5]] * 9), "action_images": [bytes(2000)] * 9})
    pq.write_table(whole, tmp_path / "rows.parquet", use_dictionary=False)
    read = rows._read(tmp_path / "rows.parquet", rows._state(tmp_path / "rows.parquet"), 0, "action")
    assert read.to_pylist() == [[0.5]] * 9
