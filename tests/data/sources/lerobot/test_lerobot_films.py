"""Videos that do not fit the rows of a LeRobotDataset: frame t stands beside row t, or the video is refused.

The datasets have episodes of 12, 9 and 15 rows; in version 3 all of them share one video. Frame i of episode
e shows 10 e + i, and so does its action.
"""

import gc
import json
import weakref
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hma_data.episodes.align import to_clip
from hma_data.errors import EpisodeError
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import open_source
from hma_data.sources.common.video_file import _cached_table, frame_table
from hma_data.sources.lerobot import films
from tests.data.sources.lerobot.test_lerobot import embodiment
from tests.data.videos import CAMERA, TASKS, encode, make_v2, make_v3, number_of
from tests.hostile import Edit, Row

LENGTHS = (12, 9, 15)
SHOWN = [10 * episode + i for episode, length in enumerate(LENGTHS) for i in range(length)]
EPISODES = [f"episode_{i:06d}" for i in range(3)]


def robot(**source: Any) -> Embodiment:
    return embodiment(
        cameras=[{"name": "cam", "key": CAMERA}], state=None, source={"format": "lerobot", **source}
    )


def outcome(folder: Path, **source: Any) -> list[str]:
    arm, found = robot(**source), []
    for name in EPISODES:
        try:
            clip = to_clip(open_source("lerobot").read(str(folder), name, arm), arm)
        except EpisodeError as fault:
            found.append(str(fault))
            continue
        shown = [number_of(frame) for frame in clip.frames_at("cam", np.arange(len(clip)))]
        is_right = shown == (10 * clip.actions[:, 0] + clip.actions[:, 1]).tolist()
        found.append("right" if is_right else f"shifted: {shown}")
    return found


def change_column(path: Path, name: str, change: Callable[[Any, dict[str, Any]], Any]) -> None:
    table = pq.read_table(path)
    column = pa.array([change(row[name], row) for row in table.to_pylist()], table.schema.field(name).type)
    pq.write_table(table.set_column(table.column_names.index(name), name, column), path, row_group_size=10)


def starts(folder: Path, *seconds: float) -> Path:
    path = folder / "meta/episodes/chunk-000/file-000.parquet"
    change_column(path, f"videos/{CAMERA}/from_timestamp", lambda _, row: seconds[row["episode_index"]])
    return folder


def film(
    folder: Path, shown: Sequence[int], stamps: Sequence[float] | None = None, b_frames: int = 0
) -> Path:
    encode(next(folder.rglob("*.mp4")), shown, b_frames=b_frames, stamps=stamps)
    return folder


@pytest.fixture
def shared(tmp_path: Path) -> Path:
    return make_v3(tmp_path / "v3", LENGTHS)


@pytest.mark.parametrize(("late", "b_frames"), [(0.4, 0), (1, 0), (7, 0), (2, 3)])
def test_a_video_that_begins_late_is_moved_as_a_whole(shared: Path, late: float, b_frames: int) -> None:
    film(shared, SHOWN, late + np.arange(36), b_frames)
    assert outcome(shared) == ["right"] * 3


def test_a_late_video_of_one_episode_is_moved(tmp_path: Path) -> None:
    folder = make_v2(tmp_path / "v2", LENGTHS)
    for path, first, length in zip(sorted(folder.rglob("*.mp4")), (0, 10, 20), LENGTHS, strict=True):
        encode(path, range(first, first + length), stamps=1 + np.arange(length))
    assert outcome(folder) == ["right"] * 3


def test_a_late_video_that_keeps_a_removed_episode_is_moved(shared: Path) -> None:
    film(shared, [*SHOWN[:21], *[50] * 12, *SHOWN[21:]], 1 + np.arange(48))
    assert outcome(starts(shared, 0.0, 1.2, 3.3)) == ["right"] * 3


def test_an_offset_that_was_never_reset_for_a_new_video_does_no_harm(tmp_path: Path) -> None:
    assert outcome(starts(make_v3(tmp_path / "v3", LENGTHS), 4.0, 5.2, 6.1)) == ["right"] * 3


def test_how_a_film_fits_is_known_without_keeping_the_times_of_its_frames(tmp_path, monkeypatch) -> None:
    measured: list[int] = []
    measure = films.fit

    def counted(clock: Any, *args: Any) -> Any:
        measured.append(len(clock))
        return measure(clock, *args)

    monkeypatch.setattr(films, "fit", counted)
    folder, source = make_v2(tmp_path / "v2", LENGTHS), open_source("lerobot")
    paths = sorted(folder.rglob("*.mp4"))
    tables = [weakref.ref(frame_table(path)) for path in paths]
    for _ in range(2):
        for name in EPISODES:
            source.read(str(folder), name, robot())
        _cached_table.cache_clear()  # as after many other films
        gc.collect()
        assert sum(table() is not None for table in tables) <= 1  # the film that is open
        assert measured == list(LENGTHS)
    encode(paths[0], range(11), stamps=1 + np.arange(11))
    with pytest.raises(EpisodeError, match="11 frames for 12 rows"):
        source.read(str(folder), EPISODES[0], robot())


def of_no_rows(folder: Path) -> Path:
    """List an episode without rows at the end of the video."""
    path = folder / "meta/episodes/chunk-000/file-000.parquet"
    listed = pq.read_table(path).to_pylist()
    empty = listed[-1] | {"episode_index": 3, "length": 0, f"videos/{CAMERA}/from_timestamp": 3.6}
    pq.write_table(pa.Table.from_pylist([*listed, empty]), path)
    return folder


def shows(shown: Sequence[int], stamps: Sequence[float] | None = None) -> Edit:
    return lambda folder: film(folder, shown, stamps)


def starting(*seconds: float) -> Edit:
    return lambda folder: starts(folder, *seconds)


def times_go_back(folder: Path) -> None:
    change_column(data(folder), "timestamp", lambda value, row: 0.3 if row["frame_index"] == 5 else value)


MORE, FEWER = "has 37 frames for 36 rows of 3 episodes", "has 35 frames for 36 rows"
TOGETHER = "at the same time — their spans in meta/episodes overlap"
DRIFT = "has 36 frames for 36 rows of 3 episodes, but not at the times that meta/episodes says"
LATE = f"{MORE}, and begins at 0.100 s, its metadata says 0.000 s"
TWICE = [*SHOWN[:9], 8, *SHOWN[9:]]
HOSTILE: dict[str, Row] = {  # every episode of the video is refused
    "a frame twice": (shows(TWICE), MORE),
    "a frame four times": (shows([*SHOWN[:9], 8, 8, 8, *SHOWN[9:]]), "has 39 frames for 36 rows"),
    "the first twice": (shows([0, *SHOWN]), MORE),
    "the last twice": (shows([*SHOWN, 34]), MORE),
    "the last twice, and no rows": (lambda folder: film(of_no_rows(folder), [*SHOWN, 34]), f"{MORE[:-10]}4"),
    "a frame missing": (shows([*SHOWN[:4], *SHOWN[5:]]), FEWER),
    "the end missing": (shows(SHOWN[:-1]), FEWER),
    "late, a frame twice": (shows(TWICE, 1 + np.arange(37)), LATE),
    "not advanced": (starting(0.0, 1.2, 1.2), TOGETHER),
    "early": (starting(0.0, 1.1, 2.0), TOGETHER),
    "one late": (starting(0.0, 1.3, 2.1), TOGETHER),
    "all at the start": (starting(0.0, 0.0, 0.0), TOGETHER),
    "a frame late": (starting(0.0, 1.3, 2.2), DRIFT),
    "half a frame late": (starting(0.0, 1.26, 2.16), DRIFT),
    "times that go back": (times_go_back, "timestamps do not rise after row 4: 0.4 s, then 0.3 s"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_a_video_that_does_not_fit_is_refused(case: str, shared: Path) -> None:
    spoil, said, *_ = HOSTILE[case]
    spoil(shared)
    assert all(said in text for text in outcome(shared)), outcome(shared)
    if said in (MORE, FEWER):
        assert sum(said in found for found in open_source("lerobot").inspect(str(shared)).problems) == 1


def test_stamps_that_tell_which_frame_is_missing_refuse_one_episode(shared: Path) -> None:
    film(shared, [*SHOWN[:4], *SHOWN[5:]], [i for i in range(36) if i != 4])
    first, *others = outcome(shared)
    assert "has 11 frames from 0.000 to 1.200 s, the episode has 12 rows" in first and others == ["right"] * 2


def test_frames_of_removed_episodes_are_no_ones(shared: Path) -> None:
    film(shared, [*SHOWN[:21], *[50] * 12, *SHOWN[21:], *[51] * 20])
    starts(shared, 0.0, 1.2, 3.3)
    assert outcome(shared) == ["right"] * 3
    flags = [
        open_source("lerobot").read(str(shared), name, robot()).metadata.get("flags") for name in EPISODES
    ]
    assert flags == [{}, {"frames_without_row:cam": 12}, {"frames_without_row:cam": 20}]
    assert sum(
        "that belong to no row" in text for text in open_source("lerobot").inspect(str(shared)).problems
    )


def test_a_recorder_that_adds_a_frame_to_each_episode_is_understood(shared: Path) -> None:
    film(shared, [*SHOWN[:12], 11, *SHOWN[12:21], 18, *SHOWN[21:], 34])
    assert outcome(starts(shared, 0.0, 1.3, 2.3)) == ["right"] * 3


def test_pairing_says_what_is_known(shared: Path) -> None:
    film(shared, [*SHOWN, 34])
    assert outcome(shared, layout={"pairing": "time"}) == ["right"] * 3
    film(starts(shared, 0.0, 1.3, 2.2), SHOWN)
    assert outcome(shared, layout={"pairing": "index"}) == ["right"] * 3


def data(folder: Path) -> Path:
    return folder / "data/chunk-000/file-000.parquet"


@pytest.mark.parametrize("left_out", [(), ("timestamp",), ("timestamp", "frame_index")])
def test_rows_in_any_order_are_brought_into_the_episodes(shared: Path, left_out: tuple[str, ...]) -> None:
    table = pq.read_table(data(shared)).drop(list(left_out))
    order = np.random.default_rng(1).permutation(len(table))
    pq.write_table(table.take(pa.array(order)), data(shared), row_group_size=10)
    assert outcome(shared) == ["right"] * 3
    assert not any("back" in text for text in open_source("lerobot").inspect(str(shared)).problems)


@pytest.mark.parametrize("unit", [1e3, 1e6, 1e9])
def test_timestamps_in_another_unit_are_brought_to_seconds(shared: Path, unit: float) -> None:
    change_column(data(shared), "timestamp", lambda value, row: value * unit)
    assert outcome(shared) == ["right"] * 3
    assert open_source("lerobot").inspect(str(shared)).problems == ()


def test_a_row_that_is_there_twice_or_not_at_all_is_named(shared: Path) -> None:
    whole = pq.read_table(data(shared))
    doubled = pa.concat_tables([whole.slice(0, 5), whole.slice(4, 1), whole.slice(6)])
    pq.write_table(doubled, data(shared))
    assert "has row 4 of episode 0 twice, by frame_index" in outcome(shared)[0]
    change_column(data(shared), "frame_index", lambda value, row: value + (value > 6))
    assert "lacks rows of episode 1 after row 6" in outcome(shared)[1]


def instructions(folder: Path) -> list[str]:
    source = open_source("lerobot")
    return [source.read(str(folder), name, robot()).instruction for name in EPISODES]


def test_a_row_whose_task_is_unknown_has_the_episodes_own(shared: Path) -> None:
    change_column(data(shared), "task_index", lambda value, row: 99 if row["episode_index"] == 1 else value)
    assert instructions(shared) == [TASKS[0], TASKS[1], TASKS[0]]


@pytest.mark.parametrize(
    "content",
    [
        '[{"task_index": 0, "task": "push the block"}, {"task_index": 1, "task": "lift the block"}]',
        '{\n "task_index": 0,\n "task": "push the block"\n}',
        '\ufeff{"task_index": 0, "task": "push the block"}\r\n\r\n',
        '{"task_index": 0, "task": "push the block"}\n{"task_index": 1, "task": "a"}\n'
        '{"task_index": 1, "task": "b"}',
        "",
        None,
    ],
    ids=["list", "over lines", "BOM", "two texts", "empty", "no file"],
)
def test_tasks_in_any_form_give_each_episode_its_words(tmp_path: Path, content: str | None) -> None:
    folder = make_v2(tmp_path / "v2", LENGTHS)
    path = folder / "meta/tasks.jsonl"
    path.unlink()
    if content is not None:
        path.write_text(content)
    assert instructions(folder) == [TASKS[0], TASKS[1], TASKS[0]]


def test_the_task_of_an_episode_may_be_a_text_in_place_of_a_list(tmp_path: Path) -> None:
    folder = make_v2(tmp_path / "v2", LENGTHS)
    (folder / "meta/tasks.jsonl").unlink()
    path = folder / "meta/episodes.jsonl"
    path.write_text(path.read_text().replace("[", "").replace("]", ""))
    assert instructions(folder) == [TASKS[0], TASKS[1], TASKS[0]]


def test_words_may_be_numbers_of_tasks(shared: Path) -> None:  # as the annotations of GR00T are
    change_column(data(shared), "index", lambda _, row: int(row["episode_index"] == 1))
    read = open_source("lerobot").read
    said = [read(str(shared), name, robot(instruction="index")).instruction for name in EPISODES]
    assert said == [TASKS[0], TASKS[1], TASKS[0]]


def test_spans_may_be_whole_seconds(shared: Path) -> None:
    make_v3(shared, (10, 10, 10))
    path = shared / "meta/episodes/chunk-000/file-000.parquet"
    listed = [
        {key: int(value) if isinstance(value, float) else value for key, value in row.items()}
        for row in pq.read_table(path).to_pylist()
    ]
    pq.write_table(pa.Table.from_pylist(listed), path)
    assert outcome(shared) == ["right"] * 3


def test_an_episode_without_words_is_flagged_and_named(tmp_path: Path) -> None:
    folder = make_v2(tmp_path / "v2", LENGTHS)
    (folder / "meta/tasks.jsonl").unlink()
    path = folder / "meta/episodes.jsonl"
    path.write_text(path.read_text().replace(TASKS[1], ""))
    assert instructions(folder) == [TASKS[0], "", TASKS[0]]
    read = open_source("lerobot").read(str(folder), EPISODES[1], robot())
    assert read.metadata["flags"] == {"episodes_without_task": 1}
    assert "episode_000001: has no task in words" in open_source("lerobot").inspect(str(folder)).problems


def test_the_measured_rate_is_offered_where_features_lack_the_times(tmp_path: Path) -> None:
    folder = make_v2(tmp_path / "v2", LENGTHS)
    for path in folder.rglob("*.parquet"):
        change_column(path, "timestamp", lambda value, row: row["frame_index"] / 9.3)
    info = json.loads((folder / "meta/info.json").read_text())
    del info["features"]["timestamp"]
    (folder / "meta/info.json").write_text(json.dumps(info))
    found = open_source("lerobot").inspect(str(folder))
    assert found.hz == pytest.approx(9.3, rel=1e-3) and found.facts["pairing"] == "index"
