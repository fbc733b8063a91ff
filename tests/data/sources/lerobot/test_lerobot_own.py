"""LeRobotDatasets written by lerobot itself (version 3.0), read by us and by lerobot's own reader.

Numbers, texts and times are equal; pictures are equal to those of lerobot's PyAV backend, byte for byte.
"""

import json
import shutil
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq
import pytest

from hma_data.errors import EpisodeError, SourceError
from hma_data.inspection.infer import infer
from hma_data.inspection.inspect import examine
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import open_source
from hma_data.storage.yaml_io import parse_yaml

pytestmark = pytest.mark.slow  # of the import of lerobot, and of encoding AV1

FPS, HEIGHT, WIDTH = 10, 64, 96
LENGTHS = (7, 5, 9, 2, 6)
TASKS = ("push the block", "größer als 3 → weiter")
CAM, SIDE, STILL = (f"observation.images.{name}" for name in ("cam", "side", "still"))
SIDES = ["height", "width", "channels"]
FEATURES: dict[str, dict[str, Any]] = {
    "action": {"dtype": "float32", "shape": (7,), "names": [f"j{i}" for i in range(7)]},
    "observation.state": {"dtype": "float64", "shape": (3,), "names": ["x", "y", "z"]},
    "observation.matrix": {"dtype": "float32", "shape": (2, 3), "names": None},
    "observation.count": {"dtype": "int64", "shape": (1,), "names": None},
    "observation.pair": {"dtype": "int32", "shape": (2,), "names": None},
    "next.success": {"dtype": "bool", "shape": (1,), "names": None},
    "note": {"dtype": "string", "shape": (1,), "names": None},
    CAM: {"dtype": "video", "shape": (HEIGHT, WIDTH, 3), "names": SIDES},
    SIDE: {"dtype": "video", "shape": (HEIGHT, WIDTH, 3), "names": SIDES},
    STILL: {"dtype": "image", "shape": (HEIGHT, WIDTH, 3), "names": SIDES},
}
NUMBERS = ("action", "observation.state", "observation.matrix", "observation.count", "observation.pair")


def arm(**changes: Any) -> Embodiment:
    """A robot whose state is every number of the dataset but the action."""
    parts = [{"key": key, "dims": int(np.prod(FEATURES[key]["shape"]))} for key in NUMBERS[1:]]
    values: dict[str, Any] = {
        "id": "testbot",
        "kind": "real",
        "frequency_hz": FPS,
        "action": {"space": "joint_position", "components": [{"key": "action", "dims": 7}]},
        "state": {"components": parts},
        "cameras": [
            {"name": key.rsplit(".")[-1], "key": key}
            for key in FEATURES
            if FEATURES[key]["shape"][-1:] == (3,) and FEATURES[key]["dtype"] in ("video", "image")
        ],
        "source": {"format": "lerobot"},
    }
    return Embodiment.from_values(values | changes, "test")


def frame_of(episode: int, row: int, features: dict[str, Any]) -> dict[str, Any]:
    rng = np.random.default_rng([episode, row])
    ramp = (np.arange(HEIGHT)[:, None] + np.arange(WIDTH) * 2 + 5 * row) % 256
    made: dict[str, Any] = {}
    for key, feature in features.items():
        shape, dtype = feature["shape"], feature["dtype"]
        if dtype in ("video", "image"):
            shift = rng.integers(0, 40, shape)
            made[key] = ((ramp[..., None] + shift) % 256).astype(np.uint8)
        elif dtype == "string":
            made[key] = f"episode {episode}, row {row}"
        elif dtype == "bool":
            made[key] = np.array([row == LENGTHS[episode] - 1 and episode % 2 == 0])
        else:
            made[key] = (rng.normal(size=shape) * 100).astype(dtype)
    return made


def write(
    root: Path, features: dict[str, Any], settle: Callable[[Any], None] = lambda writer: None, **options: Any
) -> Path:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    writer = LeRobotDataset.create("team/arm", FPS, features, root=root, robot_type="testbot", **options)
    settle(writer)
    for episode, length in enumerate(LENGTHS):
        for row in range(length):
            task = TASKS[(episode + row // 8) % 2]
            writer.add_frame(frame_of(episode, row, features) | {"task": task})
        writer.save_episode(parallel_encoding=False)  # else it forks this process, which has threads
    writer.finalize()
    return root


def many_files(writer: Any) -> None:
    writer.meta.info.chunks_size = 2
    writer.meta.info.data_files_size_in_mb = 1e-6  # a file that is being written looks empty
    writer.meta.info.video_files_size_in_mb = 1e-6


def encoder(codec: str) -> dict[str, Any]:
    from lerobot.configs.video import RGBEncoderConfig

    return {"rgb_encoder": RGBEncoderConfig(vcodec={"av1": "libsvtav1"}.get(codec, codec))}


@pytest.fixture(scope="module", params=["av1 many files", "h264 one file"])
def written(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    codec, _, files = request.param.partition(" ")
    settle = many_files if files == "many files" else lambda writer: None
    return write(tmp_path_factory.mktemp("own") / "set", FEATURES, settle, **encoder(codec))


@pytest.fixture(scope="module")
def items(written: Path) -> list[Any]:
    return list(theirs(written))


def theirs(root: Path) -> Any:
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    return LeRobotDataset("team/arm", root=root, video_backend="pyav", return_uint8=True)


def as_picture(tensor: Any) -> np.ndarray:
    values: np.ndarray = tensor.permute(1, 2, 0).numpy()
    return values if values.dtype == np.uint8 else np.rint(values * 255).astype(np.uint8)


def rows_of(items: list[Any], robot: Embodiment, root: Path) -> Iterator[tuple[Any, Any, int]]:
    source, at = open_source("lerobot"), 0
    for ref in source.index(str(root), robot):
        episode = source.read(str(root), ref.id, robot)
        for row in range(ref.frames):
            yield items[at], episode, row
            at += 1
    assert at == len(items) == sum(LENGTHS)


def test_numbers_times_and_words_are_equal(written: Path, items: list[Any]) -> None:
    robot = arm(cameras=[{"name": "still", "key": STILL}])
    for item, episode, row in rows_of(items, robot, written):
        np.testing.assert_array_equal(episode.actions[0].values[row], item["action"].numpy())
        state = np.concatenate([np.atleast_1d(item[key].numpy()).reshape(-1) for key in NUMBERS[1:]])
        np.testing.assert_array_equal(episode.states[0].values[row], state.astype(np.float32))
        assert episode.streams["still"].timestamps[row] == item["timestamp"].item()
        assert row or episode.instruction == item["task"]


def test_every_picture_is_equal_byte_for_byte(written: Path, items: list[Any]) -> None:
    robot = arm()
    assert [camera.name for camera in robot.cameras] == ["cam", "side", "still"]
    for item, episode, row in rows_of(items, robot, written):
        for camera in robot.cameras:
            mine = episode.streams[camera.name].frames([row])[0]
            np.testing.assert_array_equal(mine, as_picture(item[camera.key]), str((episode.id, row)))


def test_it_is_inspected_without_a_problem(written: Path) -> None:
    found = open_source("lerobot").inspect(str(written))
    assert (found.episodes, found.lengths, found.hz, found.problems) == (5, LENGTHS, FPS, ())
    kinds = {info.key: info.kind for info in found.keys}
    assert [kinds[key] for key in (CAM, STILL, "note", "action", "next.success")] == [
        "camera", "camera", "text", "vector", "vector",
    ]  # fmt: skip


def test_success_and_a_text_column_are_the_episodes(written: Path) -> None:
    robot = arm(source={"format": "lerobot", "instruction": "note"})
    source = open_source("lerobot")
    read = [source.read(str(written), f"episode_{i:06d}", robot) for i in range(len(LENGTHS))]
    assert [episode.success for episode in read] == [True, False, True, False, True]
    assert [episode.instruction for episode in read] == [f"episode {i}, row 0" for i in range(len(LENGTHS))]


def test_depth_is_a_feature_but_no_camera(tmp_path: Path) -> None:
    depth = {"dtype": "video", "shape": (HEIGHT, WIDTH, 1), "names": SIDES, "info": {"is_depth_map": True}}
    still = depth | {"dtype": "image"}
    features = {key: FEATURES[key] for key in ("action", CAM)} | {"depth": depth, "still_depth": still}
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    root = tmp_path / "set"
    writer = LeRobotDataset.create("team/arm", FPS, features, root=root, **encoder("h264"))
    for row in range(6):
        metres = np.full((HEIGHT, WIDTH, 1), 400 + 100 * row, np.uint16)
        colour = frame_of(0, row, {key: FEATURES[key] for key in ("action", CAM)})
        writer.add_frame(colour | {"depth": metres, "still_depth": metres, "task": "look"})
    writer.save_episode(parallel_encoding=False)
    writer.finalize()
    kinds = {info.key: info.kind for info in open_source("lerobot").inspect(str(root)).keys}
    assert (kinds[CAM], kinds["depth"], kinds["still_depth"]) == ("camera", "other", "other")
    source = open_source("lerobot")
    read = source.read(str(root), "episode_000000", arm(cameras=[{"name": "c", "key": CAM}], state=None))
    assert read.streams["c"].frames([5]).shape == (1, HEIGHT, WIDTH, 3)
    for key in ("depth", "still_depth"):
        with pytest.raises(SourceError, match=rf"'{key}' is a depth map, not colour"):
            source.read(str(root), "episode_000000", arm(cameras=[{"name": "d", "key": key}], state=None))


def test_episodes_deleted_by_lerobot_leave_the_others_equal(tmp_path: Path) -> None:
    from lerobot.datasets.dataset_tools import delete_episodes

    features = {key: FEATURES[key] for key in ("action", CAM)}
    root = write(tmp_path / "set", features, **encoder("h264"))
    delete_episodes(theirs(root), [1, 3], output_dir=tmp_path / "less", repo_id="team/less")
    robot, source = arm(cameras=[{"name": "cam", "key": CAM}], state=None), open_source("lerobot")
    refs = source.index(str(tmp_path / "less"), robot)
    assert [ref.frames for ref in refs] == [7, 9, 6]
    kept, at = list(theirs(tmp_path / "less")), 0
    for ref, original in zip(refs, (0, 2, 4), strict=True):
        episode = source.read(str(tmp_path / "less"), ref.id, robot)
        frames = episode.streams["cam"].frames(range(ref.frames))
        for row in range(ref.frames):
            wanted = frame_of(original, row, features)["action"]
            np.testing.assert_array_equal(episode.actions[0].values[row], wanted)
            np.testing.assert_array_equal(frames[row], as_picture(kept[at][CAM]))
            at += 1


# -- sets as other writers leave them: lerobot's own, altered


@pytest.fixture(scope="module")
def plain(tmp_path_factory: pytest.TempPathFactory) -> Path:
    features = {key: FEATURES[key] for key in ("action", CAM)}
    return write(tmp_path_factory.mktemp("plain") / "set", features, **encoder("h264"))


@pytest.fixture
def altered(plain: Path, tmp_path: Path) -> Path:
    return Path(shutil.copytree(plain, tmp_path / "set"))


def change_spans(root: Path, change: Callable[[dict[str, Any]], Any]) -> None:
    (path,) = (root / "meta/episodes").rglob("*.parquet")
    table = pq.read_table(path)
    name = f"videos/{CAM}/to_timestamp"
    column = pa.array([change(row) for row in table.to_pylist()], pa.float64())
    pq.write_table(table.set_column(table.column_names.index(name), name, column), path)


@pytest.mark.parametrize("frames", [-1, 2])
def test_where_an_episode_ends_in_a_video_is_judged_as_lerobot_does(altered: Path, frames: int) -> None:
    change_spans(altered, lambda row: row[f"videos/{CAM}/to_timestamp"] + frames / FPS)
    robot = arm(cameras=[{"name": "cam", "key": CAM}], state=None)
    for item, episode, row in rows_of(list(theirs(altered)), robot, altered):
        np.testing.assert_array_equal(episode.streams["cam"].frames([row])[0], as_picture(item[CAM]))
    assert open_source("lerobot").inspect(str(altered)).problems == ()


def as_v21(root: Path, out: Path, row_hz: float = FPS) -> Path:
    """Bring a set to version 2.1 with the names of version 3 in its templates, and rows at another rate."""
    files = sorted(root.rglob("*.mp4"))
    whole = pa.concat_tables([pq.read_table(path) for path in sorted((root / "data").rglob("*.parquet"))])
    info = json.loads((root / "meta/info.json").read_text())
    info |= {"codebase_version": "v2.1", "chunks_size": 1000}
    info["data_path"] = "data/chunk-{chunk_index:03d}/episode_{episode_index:06d}.parquet"
    info["video_path"] = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
    (out / "meta").mkdir(parents=True)
    (out / "meta/info.json").write_text(json.dumps(info))
    listed = [{"episode_index": i, "tasks": [], "length": n} for i, n in enumerate(LENGTHS)]
    (out / "meta/episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in listed))
    (out / "meta/tasks.jsonl").write_text(json.dumps({"task_index": 0, "task": TASKS[0]}))
    for i, length in enumerate(LENGTHS):
        data, film = (
            out / f"data/chunk-000/episode_{i:06d}.parquet",
            out / f"videos/{CAM}/chunk-000/file-{i:03d}.mp4",
        )
        data.parent.mkdir(parents=True, exist_ok=True)
        film.parent.mkdir(parents=True, exist_ok=True)
        rows = whole.filter(pc.equal(whole["episode_index"], i))
        times = pa.array((np.arange(length) / row_hz).astype(np.float32))
        pq.write_table(rows.set_column(rows.column_names.index("timestamp"), "timestamp", times), data)
        shutil.copy(files[i], film)
    return out


@pytest.fixture(scope="module")
def apart(tmp_path_factory: pytest.TempPathFactory) -> Path:
    features = {key: FEATURES[key] for key in ("action", CAM)}
    root = tmp_path_factory.mktemp("apart") / "set"
    return write(root, features, many_files, **encoder("h264"))


def test_templates_of_version_3_are_filled_in_version_2(apart: Path, tmp_path: Path) -> None:
    robot, old = arm(cameras=[{"name": "cam", "key": CAM}], state=None), as_v21(apart, tmp_path / "old")
    for item, episode, row in rows_of(list(theirs(apart)), robot, old):
        np.testing.assert_array_equal(episode.streams["cam"].frames([row])[0], as_picture(item[CAM]))
        np.testing.assert_array_equal(episode.actions[0].values[row], item["action"].numpy())


def test_where_the_stated_rate_is_not_that_of_the_rows_infer_takes_the_measured_one(apart, tmp_path) -> None:
    twice = as_v21(apart, tmp_path / "twice")
    for keeps in (True, False):
        info = json.loads((twice / "meta/info.json").read_text()) | {"fps": 2 * FPS}
        if not keeps:  # some writers leave the times out of the features
            info["features"].pop("timestamp", None)
        (twice / "meta/info.json").write_text(json.dumps(info))
        values = parse_yaml(infer(str(twice), "twice"), "twice.yaml")
        assert values["frequency_hz"] == FPS and "layout" not in values["source"]
        assert "the timestamps of the rows" in values["provenance"]["frequency_hz"]


def test_stamps_that_drift_are_found_and_pairing_by_index_reads_them(apart: Path, tmp_path: Path) -> None:
    drifting = as_v21(apart, tmp_path / "cloth", row_hz=9.15)
    source = open_source("lerobot")
    cameras = [{"name": "cam", "key": CAM}]
    with pytest.raises(EpisodeError, match=r"both count 7: if row i belongs to frame i.*pairing: index"):
        source.read(str(drifting), "episode_000000", arm(cameras=cameras, state=None))
    (told,) = (one for one in examine(str(drifting)) if one.check == "skew")
    assert "pairing: index" in told.remedy and told.severity == "warn"

    yaml = infer(str(drifting), "cloth")
    values = parse_yaml(yaml, "cloth.yaml")
    assert values["source"]["layout"] == {"pairing": "index"} and values["frequency_hz"] == 9.15
    values |= {"kind": "real", "robot": "testbot", "action": values["action"] | {"space": "joint_position"}}
    robot = Embodiment.from_values(values, "cloth.yaml")
    (tmp_path / "cloth.yaml").write_text(robot.to_yaml())
    told_again = examine(str(drifting), str(tmp_path / "cloth.yaml"))
    assert not {"skew", "rate", "usable"} & {one.check for one in told_again}
    for item, episode, row in rows_of(list(theirs(apart)), robot, drifting):
        (camera,) = episode.streams.values()
        np.testing.assert_array_equal(camera.frames([row])[0], as_picture(item[CAM]))
        assert camera.timestamps[row] == pytest.approx(row / 9.15)
