"""LeRobotDatasets of every version, against what was written."""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from hma_data.conversion.job import convert
from hma_data.episodes.align import to_clip
from hma_data.errors import EpisodeError, SourceError
from hma_data.registry.embodiment import Embodiment, find
from hma_data.sources.base import open_source
from hma_data.sources.common.video_file import VideoFile
from hma_data.sources.detect import detect
from hma_data.sources.lerobot.writer import origin_of
from tests.data.hub_cache import as_snapshot
from tests.data.videos import CAMERA, HEIGHT, STILL, TASKS, WIDTH, actions_of, make_v2, make_v3, number_of
from tests.hub_server import Hub, connect, serve

LENGTHS = (12, 9, 15)


def embodiment(**changes: Any) -> Embodiment:
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


def test_the_footer_of_a_file_of_many_episodes_is_parsed_once_until_it_changes(tmp_path, monkeypatch) -> None:
    parsed: list[str] = []
    opened = pq.ParquetFile

    def counted(path: Path, metadata: Any = None) -> pq.ParquetFile:
        parsed.extend([] if metadata else [path.parts[-3]])
        return opened(path, metadata=metadata)

    folder, robot, source = make_v3(tmp_path / "v3", LENGTHS), embodiment(), open_source("lerobot")
    monkeypatch.setattr(pq, "ParquetFile", counted)
    path = folder / "data/chunk-000/file-000.parquet"
    for reads, group_rows in ((1, None), (2, 5)):
        if group_rows:  # the same rows elsewhere in the file
            pq.write_table(pq.read_table(path)[::-1], path, row_group_size=group_rows)
        for episode, length in enumerate(LENGTHS):
            read = source.read(str(folder), f"episode_{episode:06d}", robot)
            np.testing.assert_array_equal(read.actions[0].values, actions_of(episode, length))
            shown = [number_of(frame) for frame in read.streams["still"].frames(range(length))]
            assert shown == [10 * episode + i for i in range(length)]
        assert parsed.count("data") == reads


@pytest.fixture(scope="session", params=["v2.0", "v2.1", "v2.1 av1", "v3.0", "v3.0 av1"])
def whole(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
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
    def make(name: str) -> Path:
        return Path(shutil.copytree(originals[name], tmp_path / name))

    return make


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
    info = folder / "meta/info.json"
    info.write_text(json.dumps(json.loads(info.read_text()) | {"splits": {"train": "0:2", "val": "2:3"}}))
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


@pytest.mark.parametrize("rate", [10.05, "unknown", None])
def test_a_rate_within_a_hundredth_or_not_stated_is_accepted(originals: dict[str, Path], rate: Any) -> None:
    robot = embodiment(frequency_hz=rate, stride=5)
    assert len(open_source("lerobot").index(str(originals["v2"]), robot)) == 3


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
def test_a_recording_of_an_evaluation_in_a_model_is_synthetic(highest, made_by, tmp_path) -> None:
    (tmp_path / "meta").mkdir()
    (tmp_path / "meta" / "info.json").write_text(json.dumps({"features": {"synthetic": {"shape": [1]}}}))
    (tmp_path / "meta" / "stats.json").write_text(json.dumps({"synthetic": {"max": [highest]}}))
    assert origin_of(tmp_path.joinpath) == made_by


# -- datasets of the hub


HUB_LENGTHS = (7, 5, 6)


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Path]:
    made = {name: tmp_path_factory.mktemp(name) for name in ("v2", "v3", "old")}
    make_v2(made["v2"], HUB_LENGTHS)
    make_v3(made["v3"], HUB_LENGTHS)
    make_v2(made["old"], HUB_LENGTHS[:2])
    return made


@pytest.fixture
def hub(tmp_path: Path, folders: dict[str, Path], monkeypatch: pytest.MonkeyPatch) -> Iterator[Hub]:
    with serve() as server:
        server.add_folder("team/two", "main", folders["v2"])
        server.add_folder("team/two", "v0.9", folders["old"])
        server.add_folder("team/three", "main", folders["v3"])
        connect(monkeypatch, server, tmp_path / "cache", None)
        yield server


def test_only_metadata_is_fetched_to_list_and_inspect_episodes(hub: Hub) -> None:
    for name in ("two", "three"):
        refs = open_source("lerobot").index(f"hf://datasets/team/{name}", embodiment())
        assert [ref.frames for ref in refs] == list(HUB_LENGTHS)
        assert open_source("lerobot").inspect(f"hf://datasets/team/{name}").lengths == HUB_LENGTHS
    assert hub.served() and all(path.startswith("meta/") for path in hub.served())


def test_an_episode_fetches_its_own_files_alone(hub: Hub) -> None:
    source = open_source("lerobot")
    source.index("team/two", embodiment())
    hub.log.clear()
    episode = source.read("team/two", "episode_000001", embodiment())
    shown = [number_of(frame) for frame in episode.streams["cam"].frames(range(5))]
    assert shown == [10, 11, 12, 13, 14]
    np.testing.assert_array_equal(episode.actions[0].values, actions_of(1, 5))
    assert sorted(hub.served()) == [
        "data/chunk-000/episode_000001.parquet",
        f"videos/chunk-000/{CAMERA}/episode_000001.mp4",
    ]


def test_a_camera_not_asked_for_is_not_fetched(hub: Hub) -> None:
    still = embodiment(cameras=[{"name": "still", "key": STILL}])
    episode = open_source("lerobot").read("team/three", "episode_000002", still)
    assert number_of(episode.streams["still"].frames([3])[0]) == 23
    assert not any(path.endswith(".mp4") for path in hub.served())


def test_a_revision_is_the_one_named(hub: Hub) -> None:
    index = open_source("lerobot").index
    assert len(index("hf://datasets/team/two@v0.9")) == 2 and len(index("team/two@main")) == 3
    assert index("team/two@v0.9")[0].fingerprint != index("team/two@main")[0].fingerprint
    commit = hub.repositories["datasets/team/two"].refs["v0.9"]
    assert index(f"team/two@{commit}") == index("team/two@v0.9")


def test_what_was_fetched_is_read_without_network(hub: Hub, monkeypatch: pytest.MonkeyPatch) -> None:
    from huggingface_hub import constants

    before = open_source("lerobot").index("team/two", embodiment())
    open_source("lerobot").read("team/two", "episode_000000", embodiment())
    monkeypatch.setattr(constants, "HF_HUB_OFFLINE", True)
    hub.repositories.clear()
    source = open_source("lerobot")
    assert source.index("team/two", embodiment()) == before
    assert source.read("team/two", "episode_000000", embodiment()).streams["cam"].frames([2]).shape[0] == 1
    with pytest.raises((EpisodeError, SourceError), match=r"episode_000001|cannot be fetched"):
        source.read("team/two", "episode_000001", embodiment())


@pytest.mark.parametrize("uri", ["hf://datasets/team/none", "team/none", "team/two@v7"])
def test_what_the_hub_does_not_have_is_one_line(hub: Hub, uri: str) -> None:
    with pytest.raises(SourceError, match="cannot be fetched from the Hub") as found:
        open_source("lerobot").index(uri)
    assert "\n" not in str(found.value) and uri in str(found.value)
    assert ("no such revision" if "@" in uri else "no such repository, or no access") in str(found.value)


def test_a_file_the_hub_lacks_is_one_refused_episode(hub, folders, tmp_path) -> None:
    copy = Path(shutil.copytree(folders["v2"], tmp_path / "copy"))
    (copy / f"videos/chunk-000/{CAMERA}/episode_000001.mp4").unlink()
    hub.add_folder("team/holes", "main", copy)
    source = open_source("lerobot")
    assert len(source.index("team/holes", embodiment())) == 3
    with pytest.raises(EpisodeError, match=r"episode_000001\.mp4: no such video"):
        source.read("team/holes", "episode_000001", embodiment())
    assert source.read("team/holes", "episode_000002", embodiment()).id == "episode_000002"


def test_a_synthetic_dataset_of_the_hub_is_known_as_one(hub, folders, tmp_path, block_tokenizer) -> None:
    copy = Path(shutil.copytree(folders["v2"], tmp_path / "copy"))
    (copy / "synthetic.json").write_text('{"synthetic": true}')
    hub.add_folder("team/made", "main", copy)
    done = convert(embodiment(), "team/made", block_tokenizer, tmp_path / "shards")
    assert done.manifest.plan["made_by"] == {"synthetic": True}
    (copy / "synthetic.json").replace(tmp_path / "elsewhere.json")
    (copy / "synthetic.json").symlink_to(tmp_path / "elsewhere.json")
    with pytest.raises(EpisodeError, match=r"synthetic\.json: is a link to a file outside"):
        convert(embodiment(), str(copy), block_tokenizer, tmp_path / "linked")


def test_a_name_on_the_hub_is_known_as_a_lerobot_dataset() -> None:
    for uri in ("hf://datasets/team/two", "hf://datasets/team/two@v0.9", "team/two", "team/two@v0.9"):
        assert detect(uri) == "lerobot"
    for uri in ("./team/two", "team/two.h5", "/team/two", "team/two/three", "tests/none"):
        with pytest.raises(SourceError, match="does not exist"):
            detect(uri)
