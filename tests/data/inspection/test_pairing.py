"""Commands beside pictures: a bag gives each image the command that the same recording in HDF5 gives it."""

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
import yaml

from hma_data.inspection.inspect import examine, inspect_recording
from tests.command import hma
from tests.data.bag_files import START_NS, Recording, as_cdr, write_mcap, write_ros1
from tests.data.inferring import answered, first_clip, inferred

MS = 1_000_000
FRAMES = 30
PERIOD = 50 * MS
DRAW = np.random.default_rng(0)


@dataclass(frozen=True)
class Case:
    """When commands come (C,), which of them is each image's own (T,), and what `infer` says of it."""

    command_ns: np.ndarray
    own: np.ndarray
    said: str
    tolerance_ms: float | None


def each(delay_ns: np.ndarray | int, said: str, tolerance_ms: float | None) -> Case:
    return Case(np.arange(FRAMES) * PERIOD + delay_ns, np.arange(FRAMES), said, tolerance_ms)


CASES = {
    "1 ms before": each(-MS, "1.0 ± 0.0 ms before each image: actions: hold", None),
    "with the picture": each(0, "0.0 ± 0.0 ms after each image: actions: hold", None),
    "1 ms after": each(MS, "1.0 ± 0.0 ms after each image: actions: hold, tolerance_ms: 26", 26),
    "half a period after": each(PERIOD // 2, "25.0 ± 0.0 ms after each image, about midway", 50),
    "after, with jitter": each(DRAW.integers(MS, 12 * MS, FRAMES), "after each image", 32),
    "around, with jitter": each(DRAW.integers(-3 * MS, 3 * MS, FRAMES), "each image: actions: hold, ", 25),
    "100 Hz": Case(
        np.arange(FRAMES * 5) * PERIOD // 5 + 2 * MS,
        np.arange(FRAMES) * 5 - 1,
        "not tied to images; the last one is 8.0 ± 0.0 ms old",
        None,
    ),
    "every third picture": Case(
        np.arange(FRAMES // 3) * 3 * PERIOD + MS, np.arange(FRAMES) // 3, "1.0 ± 0.0 ms after", 26
    ),
}
FORMS: dict[str, Callable[[Path, Recording], Path]] = {
    "ros1": lambda folder, made: write_ros1(folder / "run.bag", made),
    "mcap": lambda folder, made: write_mcap(folder / "run.mcap", made, as_cdr()),
}


def recording(case: Case) -> Recording:
    draw = np.random.default_rng(1)
    stamps = START_NS + np.arange(FRAMES) * PERIOD
    shots = draw.integers(0, 256, (FRAMES, 24, 32, 3), dtype=np.uint8)
    commands = draw.normal(size=(len(case.command_ns), 2))
    return Recording(
        stamps, shots, stamps, draw.normal(size=(FRAMES, 3)), START_NS + case.command_ns, commands
    )


def in_hdf5(path: Path, made: Recording, case: Case) -> Path:
    """The recording as a loop writes it: each image with its own command, from the first command on."""
    begin = int(np.argmax(case.own >= 0))
    with h5py.File(path, "w") as file:
        demo = file.create_group("data/demo_0")
        demo["actions"] = made.commands[case.own[begin:]].astype(np.float32)
        demo["obs/joint_pos"], demo["obs/image"] = made.joints[begin:], made.pictures[begin:]
    return path


@pytest.mark.parametrize(("name", "form"), [("1 ms after", "ros1"), *((name, "mcap") for name in CASES)])
def test_a_bag_gives_the_actions_of_the_same_recording_in_hdf5(tmp_path: Path, name: str, form: str) -> None:
    case = CASES[name]
    made = recording(case)
    bag, steps = FORMS[form](tmp_path, made), in_hdf5(tmp_path / "run.hdf5", made, case)
    values = inferred(bag)
    assert case.said in values["provenance"]["sync"]
    assert (values["sync"]["actions"], values["sync"].get("tolerance_ms")) == ("hold", case.tolerance_ms)
    clip, truth = first_clip(bag, values), first_clip(steps, inferred(steps))
    assert len(clip) == len(truth)
    shown = [one.frames_at(next(iter(one.episode.streams)), np.arange(len(one))) for one in (clip, truth)]
    np.testing.assert_array_equal(*shown)
    np.testing.assert_array_equal(clip.actions, truth.actions)


def yaml_of(tmp_path: Path, bag: Path, **sync: Any) -> Path:
    values = answered(inferred(bag)) | {"id": "mine"}
    kept = {key: value for key, value in values["sync"].items() if key != "tolerance_ms"}
    (tmp_path / "mine.yaml").write_text(yaml.safe_dump(values | {"sync": kept | sync}))
    return tmp_path / "mine.yaml"


@pytest.mark.parametrize(
    ("name", "sync", "said"),
    [
        ("1 ms after", {}, "100% of frames get the action of the frame before them by actions: hold;"),
        ("1 ms after", {"tolerance_ms": 5}, ""),
        ("1 ms after", {"actions": "nearest"}, ""),
        ("1 ms before", {}, ""),
        ("1 ms before", {"tolerance_ms": 49.5}, "get the action of the frame after them"),
        ("half a period after", {"actions": "nearest"}, "get the action of the frame before them"),
        ("100 Hz", {}, ""),
        ("100 Hz", {"actions": "nearest"}, ""),
        ("around, with jitter", {}, "get the action of the frame before them"),
    ],
)
def test_doctor_says_when_the_yaml_pairs_commands_with_other_pictures(tmp_path, name, sync, said) -> None:
    bag = FORMS["mcap"](tmp_path, recording(CASES[name]))
    found = [one for one in examine(bag, yaml_of(tmp_path, bag, **sync)) if one.check == "offset"]
    assert [one.severity for one in found] == ["warn"] * bool(said)
    assert said in "".join(map(str, found))


def test_infer_doctor_and_inspect_print_the_offset_in_one_line(tmp_path: Path) -> None:
    bag = FORMS["ros1"](tmp_path, recording(CASES["1 ms after"]))
    line = "actions come 1.0 ± 0.0 ms after each image"
    told = hma("registry", "infer", bag, "--id", "mine", "--out", tmp_path / "mine.yaml").stdout
    assert f"\n{line}: actions: hold, tolerance_ms: 26\n" in told
    assert line in hma("doctor", bag).stdout
    report = inspect_recording(bag)
    measured = "the last one 49.0 ± 0.0 ms before each image, the next one 1.0 ± 0.0 ms after it"
    assert report["facts"]["actions /command"] == measured and report["checks"]["offset"] == "info"
    assert measured in hma("inspect", bag, "-e", yaml_of(tmp_path, bag)).stdout
