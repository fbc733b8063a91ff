"""The registry that comes along: complete, sourced, and right about the features its datasets list."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from hma_data.episodes.align import to_clip
from hma_data.registry.catalog import entries
from hma_data.registry.embodiment import Embodiment, find, schema
from hma_data.registry.folders import registry_files
from hma_data.sources.base import open_source
from hma_data.storage.paths import shipped
from tests.data import rlds_files

ROOT = shipped("registry")
FILES = {path.stem: path for path in registry_files([ROOT])}
LISTED: dict[str, Any] = {}
for facts_file in sorted((Path(__file__).parents[1] / "rlds_features").glob("*.yaml")):
    LISTED |= yaml.safe_load(facts_file.read_text())

# Public control rate in Hz (None: contested, so unknown), useful action dims, stride to 2 Hz.
PAPER: dict[str, tuple[float | None, int, int | None]] = {
    "bridge_data_v2": (5, 7, 3),
    "fractal20220817_data": (3, 7, 2),
    "language_table": (10, 2, 5),
    "ucsd_pick_and_place_dataset_converted_externally_to_rlds": (3, 4, 2),
    "kaist_nonprehensile_converted_externally_to_rlds": (10, 20, 5),
    "ucsd_kitchen_dataset_converted_externally_to_rlds": (2, 7, 1),
    "utokyo_xarm_bimanual_converted_externally_to_rlds": (10, 14, 5),
    "stanford_hydra_dataset_converted_externally_to_rlds": (10, 7, 5),
    "austin_sirius_dataset_converted_externally_to_rlds": (20, 7, 10),
    "berkeley_fanuc_manipulation": (10, 6, 5),
    "berkeley_mvp_converted_externally_to_rlds": (5, 8, 3),
    "berkeley_rpt_converted_externally_to_rlds": (30, 8, 15),
    "cmu_play_fusion": (5, 8, 3),
    "iamlab_cmu_pickup_insert_converted_externally_to_rlds": (20, 8, 10),
    "qut_dexterous_manpulation": (30, 8, 15),
    "robo_net": (1, 5, 1),
    "furniture_bench_dataset_converted_externally_to_rlds": (10, 8, 5),
    "dlr_sara_grid_clamp_converted_externally_to_rlds": (10, 7, 5),
    "cmu_stretch": (10, 7, 5),
    "spoc": (10, 9, 5),
    "columbia_cairlab_pusht_real": (10, 7, 5),
    "droid": (15, 7, 8),
    "toto": (30, 7, 15),
    "io_ai_tech": (30, 7, 15),
    "conq_hose_manipulation": (30, 7, 15),
    "dobbe": (30, 7, 15),
    "berkeley_gnm_cory_hall": (5, 2, 3),
    "plex_robosuite": (20, 7, 10),
    "usc_cloth_sim_converted_externally_to_rlds": (10, 4, 5),
    "berkeley_cable_routing": (10, 6, 5),
    "imperial_wrist_dataset": (10, 7, 5),
    "bc_z": (10, 7, 5),
    "kuka": (10, 7, 5),
    "roboturk": (10, 7, 5),
    "metaworld": (80, 4, 40),
    "robomimic": (20, 7, 10),
    "epic_kitchen": (None, 4, None),
    "ego4d": (30, 4, 15),
    "nyu_door_opening_surprising_effectiveness": (3, 7, 2),
    "exoego4d": (30, 4, 15),
}
FURTHER: dict[str, tuple[float | None, int, int | None]] = {
    "bridge": (5, 7, 3),
    "taco_play": (15, 7, 8),
    "jaco_play": (10, 4, 5),
    "viola": (20, 7, 10),
    "berkeley_autolab_ur5": (5, 7, 3),
    "utaustin_mutex": (20, 7, 10),
    "aloha": (50, 14, 25),
    "pusht": (10, 2, 5),
    "so100": (30, 6, 15),
    "so101": (30, 6, 15),
    "libero": (20, 7, 10),
    "koch": (30, 6, 15),
    "epic_kitchens": (None, 4, None),
    "egoexo4d": (30, 4, 15),
}


@pytest.mark.parametrize("name", [*PAPER, *FURTHER])
def test_rate_dims_and_stride_are_the_public_ones(name: str) -> None:
    robot = find(name)
    rate, dims, stride = (PAPER | FURTHER)[name]
    assert robot.action_dim == dims
    if rate is None:
        assert robot.frequency_hz in ("unknown", None)
    else:
        assert (robot.frequency_hz, robot.stride) == (rate, stride)


def test_the_whole_registry_is_valid_and_named_by_its_files() -> None:
    found = entries()
    assert not [problem for entry in found for problem in entry.problems]
    assert len({entry.name for entry in found}) >= 57
    assert set(PAPER) <= set(FILES) and len(PAPER) == 40


@pytest.mark.parametrize("name", sorted(FILES))
def test_every_number_says_where_it_is_from(name: str) -> None:
    robot = Embodiment.load(FILES[name])
    needed = {"frequency_hz", "action"}
    if robot.source.episodes and robot.source.uri:
        needed.add("episodes")
    said = set(robot.provenance)
    assert needed <= said | ({"action"} if said & {"dims", "unit", "names"} else set())
    assert robot.description and robot.robot


def test_editors_find_the_schema_from_every_yaml() -> None:
    stated = set()
    for path in FILES.values():
        first = re.match(r"# yaml-language-server: \$schema=(\S+)\n", path.read_text())
        assert first, path
        stated.add((path.parent / first.group(1)).resolve())
    (file,) = stated
    assert json.loads(file.read_text()) == schema(), (
        "hma registry schema --out registry/embodiment.schema.json"
    )


# -- what a YAML reads, of a recording with exactly the features the dataset lists


def feature(kind: str) -> Any:
    if kind == "text":
        return rlds_files.TEXT
    if kind == "bool":
        return rlds_files.tensor((), "bool")
    dtype, shape = re.fullmatch(r"(\w+)\[(.*)\]", kind).groups()  # type: ignore[union-attr]
    sides = tuple(None if side in ("None", "-1") else int(side) for side in shape.split(",") if side)
    if dtype == "image":
        small = (
            sides
            if any(side is None for side in sides)
            else (*(min(side, 24) for side in sides[:2]), sides[2])
        )
        return rlds_files.image(small)
    return rlds_files.tensor(sides, dtype)


def tree(steps: dict[str, str]) -> dict[str, Any]:
    nested: dict[str, Any] = {}
    for path, kind in steps.items():
        *parents, last = path.split("/")
        place = nested
        for parent in parents:
            place = place.setdefault(parent, {})
        place[last] = feature(kind)
    return {name: wrap(item) for name, item in nested.items()}


def wrap(item: dict[str, Any]) -> dict[str, Any]:
    if "pythonClassName" in item:
        return item
    return rlds_files.features_dict({name: wrap(inner) for name, inner in item.items()})


def values(path: str, kind: str, count: int) -> Any:
    stated = feature(kind)
    if kind == "text":
        return [b"push it"] * count
    if "image" in stated:
        sides = [int(side) if int(side) > 0 else 16 for side in stated["image"]["shape"]["dimensions"]]
        dtype = np.uint8 if sides[2] != 1 else np.uint16
        return [rlds_files.png(np.full(sides, 20 + step, dtype)) for step in range(count)]
    sides = [int(side) for side in stated["tensor"]["shape"].get("dimensions", [])]
    seed = int.from_bytes(path.encode()[-4:], "big")
    numbers = np.random.default_rng(seed).normal(size=(count, *sides))
    if stated["tensor"]["dtype"] in ("float32", "float64"):
        return numbers.astype(stated["tensor"]["dtype"]).ravel()
    if stated["tensor"]["dtype"] == "string":
        return [b"x"] * numbers.size
    return (numbers > 0).astype(int).ravel().tolist()


@pytest.mark.parametrize("name", sorted(LISTED))
def test_the_yaml_reads_a_recording_of_the_features_its_dataset_lists(name: str, tmp_path: Path) -> None:
    steps, count = LISTED[name]["steps"], 4
    written = {path: values(path, kind, count) for path, kind in steps.items()}
    record = {f"steps/{path}": value for path, value in written.items()} | {
        "episode_metadata/file_path": [b"f"]
    }
    folder = rlds_files.write(
        tmp_path / "1.0.0", {"toy-train.tfrecord-00000-of-00001": [record]}, tree(steps)
    )
    robot = find(name)
    source = open_source("rlds")
    episode = source.read(str(folder), source.episode_ids(str(folder))[0], robot)
    clip = to_clip(episode, robot)
    expected = []
    for part in robot.action.components:
        whole = np.asarray(written[part.key], np.float64).reshape(count, -1)
        piece = whole[:, slice(*part.slice)] if part.slice else whole
        expected.append(piece * np.asarray(part.sign) + np.asarray(part.offset))
    assert np.array_equal(clip.actions, np.concatenate(expected, axis=1).astype(np.float32))
    for camera in robot.cameras:
        pictures = clip.frames_at(camera.name, np.arange(count))
        assert pictures.shape[0] == count and pictures[..., 0].flat[0] == 20
        stated = re.fullmatch(r"image\[(.*),(.*),3\]", steps[camera.key])
        assert stated, f"{camera.key} is {steps[camera.key]}"
        if camera.size and "None" not in steps[camera.key]:
            assert tuple(map(int, stated.groups())) == camera.size
    if robot.source.instruction and steps.get(robot.source.instruction) == "text":
        assert episode.instruction == "push it"
    if robot.state:
        assert clip.states is not None and clip.states.shape == (count, robot.state.dims)


def test_every_rlds_yaml_has_its_features_listed() -> None:
    rlds = {name for name, path in FILES.items() if Embodiment.load(path).source.format == "rlds"}
    elsewhere = {
        "bridge_data_v2",
        "pendulum",
        "panda",
    }  # read from recordings in test_real.py and tests/data/lab
    assert rlds - set(LISTED) <= elsewhere
