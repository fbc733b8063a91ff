"""LeRobotDatasets of every version, against what was written."""

import json
import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hma_data.episodes.align import to_clip
from hma_data.errors import EpisodeError, HMAError, SourceError
from hma_data.registry.embodiment import Embodiment, find
from hma_data.sources.base import open_source
from hma_data.sources.common.video_file import VideoFile
from hma_data.sources.detect import detect
from hma_data.sources.lerobot.metadata import fill
from hma_data.sources.lerobot.writer import origin_of
from tests.command import fails, hma
from tests.data.hub_cache import as_snapshot
from tests.data.videos import (
    CAMERA,
    HEIGHT,
    STILL,
    TASKS,
    WIDTH,
    actions_of,
    encode,
    make_v2,
    make_v3,
    number_of,
)
from tests.hostile import damage

LENGTHS = (12, 9, 15)


def embodiment(**changes: Any) -> Embodiment:
    """The robot of the made datasets."""
    values: dict[str, Any] = {
        "id": "testbot",
        "kind": "real",
        "frequency_hz": 10,
        "action": {"space": "joint_position", "components": [{"key": "action", "dims": 2}]},
        "state": {"components": [{"key": "observation.state", "dims": 1, "slice": [1, 2]}]},
        "cameras": [{"name": "cam", "key": CAMERA}, {"name": "still", "key": STILL}],
        "source": {"format": "lerobot"},
    }
    for path, value in changes.items():
        section, _, key = path.partition("__")
        values[section] = {**values[section], key: value} if key else value
    return Embodiment.from_values(values, "test")


def test_the_episodes_of_one_file_are_read_from_one_open_file_in_order(tmp_path, monkeypatch) -> None:
    opened: list[str] = []
    reopen = VideoFile._reopen

    def counted(self: VideoFile) -> None:
        opened.append(str(self.path))
        reopen(self)

    monkeypatch.setattr(VideoFile, "_reopen", counted)
    folder, robot, source = make_v3(tmp_path / "v3", LENGTHS), embodiment(), open_source("lerobot")
    for episode, ref in enumerate(source.index(str(folder), robot)):
        stream = source.read(str(folder), ref.id, robot).streams["cam"]
        shown = [number_of(frame) for frame in stream.frames(range(LENGTHS[episode]))]
        assert shown == [10 * episode + i for i in range(LENGTHS[episode])]
    assert len(opened) == len(set(opened)) == len(list(folder.rglob("*.mp4")))


@pytest.fixture(scope="session", params=["v2.0", "v2.1", "v2.1 av1", "v3.0", "v3.0 av1"])
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A dataset of each version and codec, not to be changed."""
    version, _, codec = request.param.partition(" ")
    folder = tmp_path_factory.mktemp("lerobot")
    if version == "v3.0":
        return make_v3(folder, LENGTHS, codec or "h264")
    return make_v2(folder, LENGTHS, version, codec or "h264")


@pytest.fixture(scope="session")
def originals(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    made = {"v2": make_v2, "v3": make_v3}
    return {name: make(tmp_path_factory.mktemp(name), LENGTHS) for name, make in made.items()}


@pytest.fixture
def copy(originals: dict[str, Path], tmp_path: Path) -> Callable[[str], Path]:
    """Gives a dataset that may be damaged."""

    def make(name: str) -> Path:
        return Path(shutil.copytree(originals[name], tmp_path / name))

    return make


def change_info(folder: Path, **changes: Any) -> None:
    path = folder / "meta/info.json"
    path.write_text(json.dumps(json.loads(path.read_text()) | changes))


# -- reading


def test_every_frame_goes_with_its_action(whole: Path) -> None:
    source = open_source("lerobot")
    for episode, length in enumerate(LENGTHS):
        clip = to_clip(source.read(str(whole), f"episode_{episode:06d}", embodiment()), embodiment())
        np.testing.assert_array_equal(clip.actions, actions_of(episode, length))
        np.testing.assert_array_equal(clip.states, 2 * actions_of(episode, length)[:, 1:])
        np.testing.assert_allclose(clip.timestamps, np.arange(length) / 10, atol=1e-6)
        for camera in ("cam", "still"):
            shown = [number_of(frame) for frame in clip.frames_at(camera, np.arange(length))]
            assert shown == [10 * episode + i for i in range(length)], camera


def test_task_and_success_are_the_episodes_own(whole: Path) -> None:
    source = open_source("lerobot")
    read = [source.read(str(whole), f"episode_{i:06d}", embodiment()) for i in range(3)]
    assert [episode.instruction for episode in read] == [TASKS[0], TASKS[1], TASKS[0]]
    assert [episode.success for episode in read] == [True, False, True]


def test_the_index_needs_no_decoding(whole: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hma_data.sources.lerobot.films.VideoFile", None)
    refs = open_source("lerobot").index(str(whole), embodiment())
    assert [(ref.id, ref.frames) for ref in refs] == [(f"episode_{i:06d}", n) for i, n in enumerate(LENGTHS)]
    assert len({ref.fingerprint for ref in refs}) == 3
    assert open_source("lerobot").index(str(whole)) == refs


def test_inspect_tells_features_lengths_and_rate(whole: Path) -> None:
    found = open_source("lerobot").inspect(str(whole))
    keys = {info.key: info for info in found.keys}
    assert detect(str(whole)) == "lerobot"
    assert (found.episodes, found.frames, found.lengths, found.hz) == (3, 36, LENGTHS, 10)
    assert keys["action"].names == ("which", "row") == keys["observation.state"].names
    assert (keys[CAMERA].kind, keys[CAMERA].shape) == ("camera", (HEIGHT, WIDTH, 3))
    assert keys[CAMERA].codec in ("h264", "av1") and keys[STILL].codec == "png"
    assert (found.robot, found.problems) == ("testbot", ())


def test_splits_count_where_there_are_two(copy: Callable[[str], Path]) -> None:
    folder = copy("v2")
    index = open_source("lerobot").index
    assert {ref.split for ref in index(str(folder))} == {None}
    change_info(folder, splits={"train": "0:2", "val": "2:3"})
    assert [ref.split for ref in index(str(folder))] == ["train", "train", "val"]
    chosen = index(str(folder), embodiment(source__split="val"))
    assert [(ref.id, ref.split) for ref in chosen] == [("episode_000002", None)]
    with pytest.raises(SourceError, match="no split 'gold'.*train, val"):
        index(str(folder), embodiment(source__split="gold"))


def test_pictures_named_by_path_are_read(copy: Callable[[str], Path]) -> None:
    folder = copy("v2")
    path = folder / "data/chunk-000/episode_000000.parquet"
    table = pq.read_table(path)
    column = table.column_names.index(STILL)
    rows = table[STILL].to_pylist()
    (folder / "images").mkdir()
    for i, row in enumerate(rows):
        (folder / f"images/{i}.png").write_bytes(row["bytes"])
    named = [{"bytes": None, "path": f"images/{i}.png"} for i in range(len(rows))]
    pq.write_table(table.set_column(column, STILL, pa.array(named)), path)
    still = open_source("lerobot").read(str(folder), "episode_000000", embodiment()).streams["still"]
    assert [number_of(frame) for frame in still.frames([2, 11])] == [2, 11]
    pq.write_table(
        table.set_column(column, STILL, pa.array([{"path": "../../etc/passwd"}] * len(rows))), path
    )
    with pytest.raises(EpisodeError, match="outside the dataset"):
        open_source("lerobot").read(str(folder), "episode_000000", embodiment()).streams["still"].frames([0])


# -- what is refused


def test_another_rate_names_both_numbers(originals: dict[str, Path]) -> None:
    for call in ("index", "read"):
        arguments = [str(originals["v2"]), *(["episode_000000"] if call == "read" else [])]
        with pytest.raises(SourceError, match=r"runs at 10 fps.*frequency_hz 30"):
            getattr(open_source("lerobot"), call)(*arguments, embodiment(frequency_hz=30))


@pytest.mark.parametrize("rate", [10.05, "unknown", None])
def test_a_rate_within_a_hundredth_or_not_stated_is_accepted(originals: dict[str, Path], rate: Any) -> None:
    robot = embodiment(frequency_hz=rate, stride=5)
    assert len(open_source("lerobot").index(str(originals["v2"]), robot)) == 3


@pytest.mark.parametrize("name", ["v2", "v3"])
def test_a_missing_video_is_one_refused_episode(copy: Callable[[str], Path], name: str) -> None:
    folder, source = copy(name), open_source("lerobot")
    videos = sorted(folder.rglob("*.mp4"))
    videos[0].unlink()
    assert len(source.index(str(folder), embodiment())) == 3
    with pytest.raises(EpisodeError, match=rf"{videos[0].name}: no such video"):
        source.read(str(folder), "episode_000000", embodiment())
    (said,) = (one for one in source.inspect(str(folder)).problems if "missing" in one)
    assert f"1 of {len(videos)} videos of {CAMERA} are missing" in said and videos[0].name in said


ROWS, FILM = "data/chunk-000/episode_000000.parquet", f"videos/chunk-000/{CAMERA}/episode_000000.mp4"
MISMATCHES = {
    "short video": (lambda folder: encode(folder / FILM, range(11)), "has 11 frames for 12 rows"),
    "long video": (lambda folder: encode(folder / FILM, range(13)), "has 13 frames for 12 rows"),
    "another rate": (lambda folder: encode(folder / FILM, range(12), fps=15), "disagree on time"),
    "a row less": (
        lambda folder: pq.write_table(pq.read_table(folder / ROWS).slice(1), folder / ROWS),
        "has 11 rows of episode_000000, its metadata says 12",
    ),
    "too many rows": (
        lambda folder: pq.write_table(pa.table({"episode_index": [0] * 1001}), folder / ROWS),
        r"'episode_index' claims 1,001 values of 1,001 rows",
    ),
}


@pytest.mark.parametrize("mismatch", MISMATCHES)
def test_a_film_or_rows_that_do_not_fit_are_refused(copy, monkeypatch, mismatch: str) -> None:
    folder, source = copy("v2"), open_source("lerobot")
    change, said = MISMATCHES[mismatch]
    monkeypatch.setattr("hma_data.sources.lerobot.rows.MAX_VALUES", 1000)
    change(folder)
    with pytest.raises(EpisodeError, match=said):
        source.read(str(folder), "episode_000000", embodiment())
    if "video" in mismatch:
        assert said in source.inspect(str(folder)).problems[0]


def test_a_key_that_is_no_feature_names_the_nearest(originals: dict[str, Path]) -> None:
    arm = embodiment(cameras=[{"name": "cam", "key": "observation.images.camera"}])
    with pytest.raises(SourceError, match=rf"is not a feature.*did you mean {CAMERA}"):
        open_source("lerobot").read(str(originals["v2"]), "episode_000000", arm)
    arm = embodiment(cameras=[{"name": "cam", "key": "action"}])
    with pytest.raises(SourceError, match=rf"'action' is float32, not colour images.*{CAMERA}, {STILL}"):
        open_source("lerobot").read(str(originals["v2"]), "episode_000000", arm)


def test_a_wrong_width_is_told_with_both_numbers(originals: dict[str, Path]) -> None:
    arm = embodiment(action__components=[{"key": "action", "dims": 6}])
    with pytest.raises(EpisodeError, match="action has 2 values, the embodiment says 6"):
        open_source("lerobot").read(str(originals["v3"]), "episode_000000", arm)


@pytest.mark.parametrize(
    ("column", "said"),
    [
        (pa.array([[1.0, 2.0]] * 11 + [[1.0]]), "holds lists of"),
        (pa.array([[1.0, 2.0]] * 11 + [None]), "1 missing values"),
        (pa.array([[1.0, None]] * 12), "12 missing values"),
        (pa.array([["a", "b"]] * 12), "not numbers"),
        (pa.array([[1.0, float("nan")]] * 12), "not finite at frame 0"),
    ],
)
def test_actions_that_are_none_are_refused(copy: Callable[[str], Path], column: pa.Array, said: str) -> None:
    folder = copy("v2")
    path = folder / "data/chunk-000/episode_000000.parquet"
    table = pq.read_table(path)
    pq.write_table(table.set_column(table.column_names.index("action"), "action", column), path)
    with pytest.raises(EpisodeError, match=said):
        to_clip(open_source("lerobot").read(str(folder), "episode_000000", embodiment()), embodiment())


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"codebase_version": "v1.6"}, r"version 'v1\.6'; v2\.0, v2\.1, v3\.0 are read"),
        ({"codebase_version": None}, "version None"),
        ({"fps": 0}, "fps is 0: Input should be greater than 0"),
        ({"fps": "fast"}, "fps is 'fast'"),
        ({"features": {}}, "features is {}"),
        ({"features": {"action": {"dtype": "float32"}}}, r"lacks features\.action\.shape"),
    ],
)
def test_metadata_out_of_bounds_is_one_clear_line(copy, change, said) -> None:
    folder = copy("v2")
    change_info(folder, **change)
    with pytest.raises(SourceError, match=said) as found:
        open_source("lerobot").index(str(folder))
    assert "info.json" in str(found.value) and "\n" not in str(found.value)


@pytest.mark.parametrize(
    ("name", "text", "said"),
    [
        ("info.json", "{", r"info\.json: Invalid JSON"),
        ("info.json", "[1]", "Input should be an object"),
        ("info.json", '{"codebase_version": "v2.1", "robot_type": "so100"}', r"info\.json: lacks fps —"),
        ("info.json", "[" * 100_000, "Invalid JSON"),
        (
            "episodes.jsonl",
            '{"episode_index": 0, "length": 3}\n{"epi',
            r"episodes\.jsonl line 2: is not JSON",
        ),
        ("episodes.jsonl", '{"episode_index": -1, "length": 3}', "whole number from 0, is -1"),
        ("episodes.jsonl", '{"episode_index": 0, "length": 3}\n' * 2, "lists episode 0 a second time"),
        ("episodes.jsonl", "", "has no episodes"),
        ("tasks.jsonl", "3", r"tasks\.jsonl: holds 3, not an object"),
    ],
)
def test_damaged_metadata_is_one_clear_line(copy, name, text, said) -> None:
    folder = copy("v2")
    path = folder / "meta" / name
    path.unlink() if text is None else path.write_text(text)
    with pytest.raises(SourceError, match=said) as found:
        open_source("lerobot").index(str(folder))
    assert "\n" not in str(found.value)


@pytest.mark.parametrize(
    "template",
    ["{episode_index.__class__}", "{episode_index!r}", "{episode_index:>999999999d}", "{other}", "{"],
)
def test_a_template_that_is_more_than_names_and_widths_is_refused(template: str) -> None:
    with pytest.raises(SourceError, match=r"info\.json"):
        fill(template, {"episode_index": 1, "video_key": "cam"}, "info.json")


@pytest.mark.parametrize(
    "template", ["../{episode_index:06d}.parquet", "/etc/{episode_index}.parquet", "a/../../x"]
)
def test_a_template_that_leaves_the_folder_is_refused(copy: Callable[[str], Path], template: str) -> None:
    folder = copy("v2")
    change_info(folder, data_path=template)
    with pytest.raises(EpisodeError, match="outside the dataset"):
        open_source("lerobot").read(str(folder), "episode_000000", embodiment())


def test_a_snapshot_in_the_hubs_cache_is_read_where_it_lies(originals, tmp_path) -> None:
    folders = (originals["v3"], as_snapshot(originals["v3"], tmp_path))
    plain, cached = (open_source("lerobot").read(str(f), "episode_000001", embodiment()) for f in folders)
    assert np.array_equal(cached.actions[0].values, plain.actions[0].values)
    assert np.array_equal(cached.streams["cam"].frames([3]), plain.streams["cam"].frames([3]))


def test_a_folder_that_is_none_says_so(tmp_path: Path) -> None:
    (tmp_path / "toy.hdf5").touch()
    missing = "has no meta/info.json"
    for uri, said in (
        (tmp_path, missing), (tmp_path / "toy.hdf5", missing), (tmp_path / "no", "does not exist"),
    ):  # fmt: skip
        with pytest.raises(SourceError, match=said):
            open_source("lerobot").index(str(uri))


@pytest.mark.parametrize("name", ["v2", "v3"])
def test_a_dataset_without_its_info_is_known_as_one(copy: Callable[[str], Path], name: str) -> None:
    folder = copy(name)
    (folder / "meta/info.json").unlink()
    fails(hma("inspect", folder), 1, "has no meta/info.json — give the folder of a whole LeRobotDataset")
    shutil.rmtree(folder / "meta")
    assert detect(folder) == "lerobot"


@pytest.mark.slow
@settings(max_examples=12)
@given(data=st.data())
def test_a_cut_or_flipped_file_gives_only_our_errors(originals, tmp_path_factory, data) -> None:
    folder = tmp_path_factory.mktemp("bad") / "set"
    shutil.copytree(originals[data.draw(st.sampled_from(["v2", "v3"]))], folder)
    files = sorted(path for path in folder.rglob("*.*") if path.is_file())
    path = data.draw(st.sampled_from(files))
    damage(data, path)
    source = open_source("lerobot")
    try:
        source.inspect(str(folder))
        for ref in source.index(str(folder), embodiment()):
            episode = source.read(str(folder), ref.id, embodiment())
            for stream in episode.streams.values():
                stream.frames([0, len(stream.timestamps) - 1])
    except HMAError as fault:
        assert "\n" not in str(fault)


# -- real recordings (test_lerobot_own.py compares with lerobot)


@pytest.mark.real
def test_the_real_g1_reads_its_four_episodes_and_refuses_the_rest(real_data: Path) -> None:
    uri, arm, source = str(real_data / "lerobot/g1_v21"), find("g1_inspire"), open_source("lerobot")
    refs = source.index(uri, arm)
    assert len(refs) == 100 and sum(ref.frames for ref in refs) == 35_965
    read, refused = [], 0
    for ref in refs:
        try:
            read.append(source.read(uri, ref.id, arm))
        except EpisodeError as fault:
            assert f"{ref.id}.mp4: no such video" in str(fault)
            refused += 1
    assert [episode.id for episode in read] == [f"episode_{i:06d}" for i in (1, 2, 4, 5)] and refused == 96
    clip = to_clip(read[0], arm)
    assert clip.actions.shape == (393, 26) and clip.frames_at("head", np.arange(390, 393)).shape == (
        3,
        480,
        640,
        3,
    )
    assert read[0].instruction == "Pick up the yellow bottle on the table."


@pytest.mark.real
def test_the_real_g1_is_inspected(real_data: Path) -> None:
    found = open_source("lerobot").inspect(str(real_data / "lerobot/g1_v21"))
    keys = {info.key: info for info in found.keys}
    assert keys["action"].names == tuple(find("g1_inspire").action.names())
    assert keys["observation.images.cam_high"].codec == "av1" and found.frames == 35_965
    assert "96 of 100 videos" in found.problems[0]


@pytest.mark.parametrize(
    ("highest", "made_by"), [(1.0, {"by": "lerobot-eval", "synthetic": True}), (0.0, {})]
)
def test_a_recording_of_an_evaluation_in_a_model_is_synthetic(
    highest: float, made_by: dict[str, Any], tmp_path: Path
) -> None:
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text(json.dumps({"features": {"synthetic": {"shape": [1]}}}))
    (tmp_path / "meta" / "stats.json").write_text(json.dumps({"synthetic": {"max": [highest]}}))
    assert origin_of(tmp_path) == made_by
