"""hma inspect: the same checks for every format, each finding one defect and none where there is none."""

import json
import tracemalloc
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest
from skimage import data

from hma_data.inspection.infer import infer
from hma_data.inspection.inspect import inspect_recording
from hma_data.sources.base import Inspection, open_source
from hma_data.sources.common import checks
from hma_data.sources.common.checks import CameraLook, choose, measure, ycbcr_share
from hma_data.sources.common.survey import CHECKS
from tests.data.bag_files import make_recording, write_ros1, write_ros2
from tests.data.hdf5_files import embodiment
from tests.data.rlds_files import TEXT, image, png, tensor, write
from tests.data.videos import encode as encode_video
from tests.data.videos import make_v2

# -- one recording in each format


def hdf5(folder: Path) -> Path:
    draw = np.random.default_rng(0)
    with h5py.File(folder / "demo.hdf5", "w") as file:
        for i, length in enumerate((20, 22, 24)):
            group = file.create_group(f"data/demo_{i}")
            group["actions"] = draw.normal(size=(length, 3))
            group["obs/image"] = draw.integers(0, 256, (length, 16, 16, 3), np.uint8)
    return folder / "demo.hdf5"


def rlds(folder: Path) -> Path:
    draw = np.random.default_rng(0)
    records = []
    for _ in range(3):
        pictures = [png(draw.integers(0, 256, (8, 10, 3), np.uint8)) for _ in range(5)]
        actions = draw.normal(size=15).tolist()
        record = {"steps/image": pictures, "steps/action": actions, "steps/language_instruction": [b"go"] * 5}
        records.append(record | {"episode_metadata/file_path": [b"x"]})
    steps = {"image": image((8, 10, 3)), "action": tensor((3,)), "language_instruction": TEXT}
    return write(folder / "rlds", {"toy-train.tfrecord-00000-of-00001": records}, steps)


def bag(folder: Path) -> Path:
    return write_ros2(folder / "bag", make_recording(), "MCAP")


def lerobot(folder: Path) -> Path:
    return make_v2(folder / "lerobot")


def hands(folder: Path) -> Path:
    (folder / "videos").mkdir()
    encode_video(folder / "videos/a.mp4", range(24))
    return folder / "videos"


FORMATS: dict[str, Callable[[Path], Path]] = {
    "hdf5": hdf5, "rlds": rlds, "rosbag": bag, "lerobot": lerobot, "hands": hands,
}  # fmt: skip


@pytest.mark.parametrize("name", FORMATS)
def test_every_format_answers_the_same_checks(name: str, tmp_path: Path) -> None:
    report = inspect_recording(str(FORMATS[name](tmp_path)))
    assert report["format"] == name and list(report["checks"]) == list(CHECKS)
    assert report["looked_at"] >= 1
    vectors = [key for key in report["keys"] if key["kind"] == "vector" and name != "hands"]
    assert name == "hands" or (vectors and all(key["low"] <= key["high"] for key in vectors))
    said = " ".join(report["problems"])
    assert said.startswith("hands were not detected: hand models are not given" if name == "hands" else "")
    assert name == "hands" or not said
    assert {"readable", "size", "blank", "colour"} <= {
        check for check, result in report["checks"].items() if result != "not checked"
    }
    assert json.loads(json.dumps(report)) == json.loads(json.dumps(report, default=str))


def found(inspection: Inspection) -> dict[str, list[str]]:
    said: dict[str, list[str]] = {}
    for finding in inspection.findings:
        said.setdefault(finding.check, []).append(str(finding))
    return said


def damaged(tmp_path: Path, damage: Callable[[h5py.File], None], episodes: int = 20) -> dict[str, list[str]]:
    path = hdf5(tmp_path)
    with h5py.File(path, "a") as file:
        damage(file)
    return found(open_source("hdf5").inspect(str(path), episodes))


@pytest.mark.parametrize("step", [0, 1])
def test_a_dimension_that_never_changes_in_any_episode_is_told(tmp_path: Path, step: int) -> None:
    def freeze(file: h5py.File) -> None:
        for i, demo in enumerate(file["data"].values()):
            demo["actions"][:, 1] = 3 + step * i

    told = ["actions never changes in dim 1"]
    assert damaged(tmp_path, freeze).get("constant", []) == told * (step == 0)


def test_values_that_are_not_finite_are_counted_over_the_episodes(tmp_path: Path) -> None:
    def spoil(file: h5py.File) -> None:
        file["data/demo_0/actions"][4, 2] = np.nan
        file["data/demo_2/actions"][1] = np.inf

    (said,) = damaged(tmp_path, spoil)["finite"]
    assert said == "demo_0: actions is not finite at step 4 (4 of 198 values checked, in 2 episodes)"


def test_only_so_many_episodes_are_looked_into(tmp_path: Path) -> None:
    def spoil(file: h5py.File) -> None:
        file["data/demo_1/actions"][4, 2] = np.nan

    assert "finite" not in damaged(tmp_path, spoil, episodes=1)


def test_an_empty_episode_is_told_and_no_example_of_the_others(tmp_path: Path) -> None:
    def empty(file: h5py.File) -> None:
        del file["data/demo_0"]
        file["data/demo_0/actions"] = np.zeros((0, 3))

    said = damaged(tmp_path, empty)
    assert said["readable"] == ["demo_0: has no frames"] and "keys" not in said


def test_a_key_that_only_the_first_episode_lacks_is_told(tmp_path: Path) -> None:
    def spoil(file: h5py.File) -> None:
        del file["data/demo_0/actions"]

    (said,) = damaged(tmp_path, spoil)["keys"]
    assert said == "demo_0: has no actions, which others have"


@pytest.mark.parametrize("shape", [(4, 20_000, 20_000, 3), (4, 1 << 30)])
def test_pictures_that_claim_more_than_any_have_are_not_read(tmp_path: Path, shape: tuple[int, ...]) -> None:
    def bomb(file: h5py.File) -> None:
        file.create_dataset(
            "data/demo_0/bomb", shape, "u1", chunks=(1, *(1000,) * len(shape[1:3]), *shape[3:])
        )

    tracemalloc.start()
    damaged(tmp_path, bomb)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100 << 20


@pytest.mark.parametrize("name", ["fps", "instruction", "data/demo_0/bomb"])
def test_a_single_value_that_states_many_bytes_is_not_read(tmp_path: Path, name: str) -> None:
    def bomb(file: h5py.File) -> None:
        file.create_dataset(name, (1,), f"S{1 << 28}")

    tracemalloc.start()
    damaged(tmp_path, bomb)
    robot = embodiment(cameras=[{"name": "front", "key": "obs/image"}])
    open_source("hdf5").read(str(tmp_path / "demo.hdf5"), "demo_0", robot)
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert peak < 100 << 20


def test_stamps_of_hdf5_are_checked_against_the_stated_rate(tmp_path: Path) -> None:
    def stamp(file: h5py.File) -> None:
        file["data"].attrs["fps"] = 30
        for demo in file["data"].values():
            times = 1.7e9 + np.arange(len(demo["actions"])) / 20
            times[5] = times[4]
            times[8] = times[6]
            demo["timestamps"] = times

    said = damaged(tmp_path, stamp)
    assert "demo_0: timestamps: 1 timestamps equal the previous one (and in 2 more" in said["repeated"][0]
    assert "demo_0: timestamps: 1 timestamps go back in time (and in 2 more episodes)" in said["back"]
    assert "timestamps: runs at 20 Hz, the recording states 30" in said["rate"][0]


@pytest.mark.parametrize("value", [1e300, -1e39])
def test_a_number_that_float32_cannot_hold_is_told(tmp_path: Path, value: float) -> None:
    def raise_it(file: h5py.File) -> None:
        file["data/demo_1/actions"][4, 2] = value

    assert f"actions reaches {value:.3g}" in damaged(tmp_path, raise_it)["finite"][0]


def test_a_rate_measured_in_one_episode_is_not_called_stated(tmp_path: Path) -> None:
    def stamp(file: h5py.File) -> None:
        for hz, demo in zip((20, 30, 30), file["data"].values(), strict=True):
            demo["timestamps"] = 1.7e9 + np.arange(len(demo["actions"])) / hz

    told = damaged(tmp_path, stamp)["rate"]
    assert told and all("timestamps: runs at 30 Hz, demo_0 at 20" in one for one in told)


@pytest.mark.parametrize(
    ("key", "values", "count"),
    [
        ("episode_ends", [10, 20, 30], 3),
        ("terminals", [0] * 9 + [1] + [0] * 19 + [1], 2),
        ("dones", [False] * 20 + [True] * 10, None),
        ("episode_ends", [30], None),
        ("meta/episode_ends", [10, 20, 30], 3),  # as diffusion policy's arrays
    ],
)
def test_episodes_end_to_end_in_one_file_are_told(tmp_path, key, values, count) -> None:
    with h5py.File(tmp_path / "flat.hdf5", "w") as file:
        file["images"] = np.random.default_rng(0).integers(0, 256, (30, 16, 16, 3), np.uint8)
        file["actions"], file[key] = np.random.default_rng(0).normal(size=(30, 3)), values
    told = found(open_source("hdf5").inspect(str(tmp_path / "flat.hdf5"))).get("rows", [])
    assert any(f"{key} marks {count} — write" in said for said in told) == (count is not None)


def test_a_bag_tells_skew_and_lost_frames(tmp_path: Path) -> None:
    path = write_ros1(tmp_path / "run.bag", make_recording())
    inspection = open_source("rosbag").inspect(str(path))
    skews = {key.topic.name: key.skew_ms for key in inspection.keys if key.kind == "vector" and key.topic}
    assert skews and all(skew and 0 <= skew[0] <= skew[1] <= skew[2] for skew in skews.values())
    assert "skew" in inspection.checks and "skew" not in found(inspection)


def test_several_bags_are_looked_into(tmp_path: Path) -> None:
    for name in ("a", "b", "c"):
        write_ros1(tmp_path / f"{name}.bag", make_recording())
    shift = np.zeros(10, np.int64)
    shift[6:] = 5_000_000_000
    write_ros1(tmp_path / "d.bag", replace(make_recording(), stamp_shift_ns=shift))
    inspection = open_source("rosbag").inspect(str(tmp_path))
    assert inspection.looked_at == 4
    assert any(said.startswith("d: ") and "pauses for" in said for said in found(inspection)["gaps"])


def test_a_still_picture_key_in_lerobot_is_told(tmp_path: Path) -> None:
    folder = make_v2(tmp_path / "still")
    for video in folder.rglob("*.mp4"):
        length = {"0": 12, "1": 9, "2": 15}[video.stem[-1]]
        encode_video(video, [7] * length)
    said = found(open_source("lerobot").inspect(str(folder)))
    assert "100% of neighbouring images are equal" in said["still"][0]


def decoded(picture: np.ndarray) -> np.ndarray:
    stored = cv2.imdecode(cv2.imencode(".jpg", picture[..., ::-1])[1], cv2.IMREAD_COLOR)
    assert stored is not None
    return np.asarray(stored[..., ::-1], np.uint8)


@pytest.mark.parametrize("name", ["astronaut", "coffee", "chelsea"])
def test_swapped_channels_of_what_once_was_jpeg_are_certain(name: str) -> None:
    picture = decoded(getattr(data, name)())
    for order, verdict in ((picture, "no"), (picture[..., ::-1], "sure")):
        look = CameraLook()
        look.add(order[None], np.array([0]))
        assert look.swapped()[0] == verdict


def test_pictures_that_never_were_jpeg_are_no_proof() -> None:
    assert ycbcr_share(data.astronaut().reshape(-1, 3)[::20]) == pytest.approx(0.24, abs=0.04)


@pytest.mark.real
@pytest.mark.parametrize(
    "recording",
    [
        "rlds/bridge_dataset",
        "hdf5/lift_rendered.hdf5",
        "lerobot/g1_v21",
        "mcap/custom-camera-model.mcap",
        "hands",
    ],
)
def test_no_real_camera_is_suspected(real_data: Path, recording: str) -> None:
    report = inspect_recording(str(real_data / recording), episodes=5)
    assert report["checks"]["colour"] == "ok"


def test_a_clock_counts_what_was_done_to_it() -> None:
    draw = np.random.default_rng(1)
    times = np.arange(300) / 30 + draw.normal(scale=0.001, size=300)
    kept = np.delete(times, [50, 120, 121, 122, 200])
    kept[20] = kept[19]
    clock = measure(kept)
    assert (clock.lost, clock.repeated, clock.back) == (5, 1, 0)
    assert clock.hz == pytest.approx(30, rel=0.02)


def test_a_pause_changes_neither_rate_nor_jitter() -> None:
    times = np.arange(100) / 10 + 30.0 * (np.arange(100) >= 40)
    assert checks.rate(times) == (pytest.approx(10), pytest.approx(0, abs=1e-6))
    assert checks.rate(np.repeat(times, 2))[0] == pytest.approx(10)  # a driver that sends each frame twice
    bursts = np.concatenate([start + np.arange(5) / 1000 for start in range(20)])
    assert checks.rate(bursts)[0] == pytest.approx(5, rel=0.1)


def test_lost_frames_are_told_for_cameras_alone() -> None:
    times = np.delete(np.arange(100) / 10, [20, 40, 41, 60])
    (finding,) = checks.time_findings("cam", measure(times), camera=True)
    assert finding.check == "frames" and finding.numbers["lost"] == 4
    assert not list(checks.time_findings("arm", measure(times)))


def test_tables_beside_videos_are_told(tmp_path: Path) -> None:
    (tmp_path / "videos").mkdir()
    encode_video(tmp_path / "videos/a.mp4", range(24))
    (tmp_path / "videos/robot.csv").write_text("t,x\n")
    (finding,) = [one for one in inspect_recording(str(tmp_path))["findings"] if one["check"] == "files"]
    assert finding["severity"] == "info" and "next to them are 1 .csv" in finding["message"]
    assert "HDF5 with separate videos" in finding["remedy"]
    assert "next to them are 1 .csv" in infer(str(tmp_path), "my_arm").splitlines()[1]


def test_events_have_no_pauses() -> None:
    times = np.cumsum(np.random.default_rng(0).exponential(5.0, 200) ** 2)
    assert not list(checks.time_findings("/button", measure(times)))


def test_skew_is_the_distance_to_the_nearest_sample() -> None:
    primary = np.arange(10, dtype=np.float64)
    other = np.arange(100, dtype=np.float64) / 10 + 0.02
    assert checks.skew(other, primary) == pytest.approx((20, 20, 20), abs=1e-6)
    assert checks.skew(other + 50, primary) is None


@pytest.mark.parametrize(("length", "pairs"), [(1, 4), (2, 4), (30, 3), (5, 100)])
def test_chosen_frames_lie_in_the_episode(length: int, pairs: int) -> None:
    chosen = choose(length, pairs)
    assert len(chosen) <= 2 * pairs and chosen.min() >= 0 and chosen.max() < length
    assert (np.diff(chosen) > 0).all()
