"""Any byte of any file of a recording is cut off or changed: it is read, or the error is one line."""

import shutil
from collections.abc import Callable
from pathlib import Path

import h5py
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hma_data.errors import HMAError
from hma_data.registry.embodiment import Embodiment
from tests.data import bag_parts, hands_files, hdf5_files, rh20t_files
from tests.data.bag_files import KINDS, arm, make_recording
from tests.data.sources.hands.test_hands_hostile import EGO4D, EPIC, LENGTH, write_labels
from tests.data.sources.lerobot.test_lerobot import embodiment as lerobot
from tests.data.videos import encode, make_v2, make_v3
from tests.hostile import damage, use_all

type Made = Callable[[Path], Embodiment]  # writes a recording into a folder


def hdf5(folder: Path) -> Embodiment:
    with h5py.File(folder / "demos.hdf5", "w") as file:
        for i in range(3):
            hdf5_files.fill(file.create_group(f"data/demo_{i}"), hdf5_files.T + i, i)
    return hdf5_files.embodiment()


def dataset(make: Callable[..., Path]) -> Made:
    return lambda folder: (make(folder, (12, 9, 15)), lerobot())[1]


def bag(kind: str) -> Made:
    return lambda folder: (KINDS[kind](folder, make_recording()), arm())[1]


def parts(kind: str) -> Made:
    run = bag_parts.make_run(20, pause_after=(10,))
    return lambda folder: (bag_parts.KINDS[kind](folder, run), bag_parts.parted("{gap_s: 1}"))[1]


def hands(labels: str, table: str = "hands.csv") -> Made:
    def make(folder: Path) -> Embodiment:
        encode(folder / "a.mp4", range(LENGTH))
        write_labels(folder, labels, ["a"], table)
        return hands_files.hand_video(labels)

    return make


def rh20t(folder: Path) -> Embodiment:
    rh20t_files.write_scene(folder)
    return rh20t_files.robot()


SINGLE = ("ros1", "ros1-bz2", "ros1-lz4", "mcap-cdr-zstd", "mcap-json", "mcap-without-chunks",
          "mcap-protobuf", "ros2-sqlite3")  # fmt: skip
MADE: dict[str, Made] = {
    "hdf5": hdf5, "lerobot v2": dataset(make_v2), "lerobot v3": dataset(make_v3), "rh20t": rh20t,
    "hands, pickle": hands(EPIC), "hands, JSON": hands(EGO4D), "hands, CSV": hands("landmarks"),
    "hands, parquet": hands("landmarks", "hands.parquet"),
    **{f"bag, {kind}": bag(kind) for kind in SINGLE},
    **{f"bag of parts, {kind}": parts(kind) for kind in ("ros1-without-index", "mcap-zstd", "sqlite")},
}  # fmt: skip


@pytest.fixture(scope="module", params=MADE)
def made(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Embodiment]:
    folder = tmp_path_factory.mktemp("whole")
    return folder, MADE[request.param](folder)


@settings(max_examples=12)
@given(data=st.data())
def test_a_damaged_recording_is_read_or_its_error_is_one_line(made, tmp_path_factory, data) -> None:
    whole, robot = made
    folder = tmp_path_factory.mktemp("damaged") / "set"
    shutil.copytree(whole, folder)
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    damage(data, data.draw(st.sampled_from(files)))
    try:
        use_all(folder, robot)
    except HMAError as fault:
        assert "\n" not in str(fault)
