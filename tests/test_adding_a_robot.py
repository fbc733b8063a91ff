"""docs/adding-a-robot.md, walked: three robots of three formats, by a YAML alone, from recording to hub."""

import json
from pathlib import Path

import h5py
import numpy as np
import pytest
import yaml

from tests.command import fails, hma
from tests.data.bag_files import make_recording, write_ros2
from tests.data.videos import make_v3

TINY = ["frames=3", "batch_size=2", "steps=2", "warmup=1", "workers=0"]
TINY += ["model.layers=1", "model.width=32", "model.heads=2"]


def hdf5_arm(folder: Path) -> Path:
    draw = np.random.default_rng(0)
    with h5py.File(folder / "friday.hdf5", "w") as file:
        for i in range(3):
            demo = file.create_group(f"data/demo_{i}")
            demo["actions"] = draw.normal(size=(20, 7)).astype(np.float32)
            demo["obs/joint_pos"] = draw.normal(size=(20, 7))
            demo["obs/front_image"] = draw.integers(0, 256, (20, 48, 64, 3), np.uint8)
    return folder / "friday.hdf5"


def ros2_bags(folder: Path) -> Path:
    for i in range(3):
        write_ros2(folder / "bags" / f"run_{i}", make_recording(frames=40, seed=i), "MCAP")
    return folder / "bags"


def lerobot_dataset(folder: Path) -> Path:
    return make_v3(folder, (40, 36, 44))


@pytest.mark.parametrize(
    "make", [hdf5_arm, *(pytest.param(make, marks=pytest.mark.slow) for make in (ros2_bags, lerobot_dataset))]
)
def test_a_robot_goes_from_a_recording_to_the_hub_by_its_yaml_alone(make, tmp_path) -> None:
    def run(*words: str | Path) -> str:
        done = hma(*map(str, words), cwd=tmp_path)
        assert done.returncode == 0, f"hma {' '.join(map(str, words))}\n{done.stdout}{done.stderr}"
        return done.stdout

    data = make(tmp_path)
    hma("inspect", str(data), cwd=tmp_path)  # its exit code says whether there are problems
    path = Path("registry/friday.yaml")
    assert "answer kind" in run("registry", "infer", data, "--id", "friday", "--out", path)
    asked = hma("registry", "validate", str(path), cwd=tmp_path)
    assert asked.returncode == 1 and "still TODO" in asked.stdout
    answer(tmp_path / path)
    fails(hma("registry", "infer", data, "--id", "friday", "--out", path, cwd=tmp_path), 1, "exists")
    run("registry", "validate", path)
    assert "friday" in run("registry", "list", "friday")
    hma("inspect", str(data), "-e", "friday", cwd=tmp_path)
    run("convert", "-e", "friday", "--tokenizer", "fsq-8", "--workers", "0", "--out", "shards")
    run("shards", "verify", "shards")
    run("shards", "preview", "shards", "--out", "seen")
    assert all((tmp_path / "seen" / name).stat().st_size > 1000 for name in ("sheet.png", "preview.mp4"))
    facts = json.loads(run("shards", "info", "shards", "--json"))
    assert facts["totals"]["episodes"] == 3 and facts["totals"]["quarantined"] == 0
    run("train", "discrete_tiny", "data=[shards]", *TINY, "--out", "run")
    run("hub", "push", "run", "my-hub/team/model", "-e", "friday")
    (row,) = json.loads(run("hub", "list", "my-hub/team/model", "--json"))["embodiments"]
    assert "friday" in row.values()
    run("hub", "pull", "my-hub/team/model", "-e", "friday", "--out", "pulled")
    assert (tmp_path / "pulled/embodiments/friday/embodiment.yaml").is_file()


def answer(path: Path) -> None:
    """Write what the person knows about the robot in place of every question."""
    known = {"kind": "simulation", "robot": "test arm", "frequency_hz": 10, "target_hz": 2}
    values = yaml.safe_load(path.read_text())
    for key, value in known.items():
        if key == "target_hz" or str(values.get(key, "")).startswith("TODO"):
            values[key] = value
    if values["action"]["space"].startswith("TODO"):
        values["action"]["space"] = "mixed"
    values["provenance"] = dict.fromkeys(values.get("provenance", {}), "the person who recorded it")
    for section in ("action", "state"):
        for part in values.get(section, {}).get("components", []):
            for key in [key for key in part if str(part[key]).startswith("TODO")]:
                del part[key]
    path.write_text(yaml.safe_dump(values, sort_keys=False))
