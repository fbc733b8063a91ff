"""The recorder of third-party simulators, on a small one of its own: a disc that commands move."""

import hashlib
import runpy
import sys
import tomllib
from pathlib import Path

import gymnasium
import h5py
import numpy as np
import pytest

from hma_data.conversion.job import convert
from hma_data.errors import Interrupted, OutputError
from hma_data.registry.embodiment import find
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.sources.base import open_source
from hma_data.storage.paths import shipped
from tests.conftest import BlockTokenizer

sys.path.insert(0, str(shipped("recipes") / "lab"))
from recorder import (  # type: ignore[import-not-found]
    STYLES,
    Recorded,
    main,
    record_copy,
    record_episode,
    record_simulator,
)

RECIPES = {"fetch": "Fetch", "panda": "Panda", "sawyer": "Sawyer", "aloha_sim": "Aloha"}
EPISODES, SEED = 5, 3


class Disc(gymnasium.Env):
    """A disc in a square of 128 px; commands move it by up to 8 px, and it succeeds in the right half."""

    def reset(self, *, seed=None, options=None):
        super().reset(seed=seed)
        self.place = self.np_random.uniform(20, 40, 2)
        return self.place.copy(), {}

    def step(self, action):
        self.place = np.clip(self.place + 8 * np.asarray(action[:2]), 8, 119)
        return self.place.copy(), 0.0, False, False, {"is_success": self.place[0] > 64}

    def render(self):
        y, x = np.mgrid[:128, :128]
        inside = (x - self.place[0]) ** 2 + (y - self.place[1]) ** 2 < 64
        return np.where(inside[..., None], (230, 40, 40), (x + y)[..., None] // 2).astype(np.uint8)


class DiscSimulator:
    """The disc in the place of a recipe's robot, with commands and states of that robot's width."""

    least, steps, rest = 10, 24, 3

    def __init__(self, robot: str) -> None:
        embodiment = find(robot)
        assert embodiment.state
        self.robot, self.env, self.taken = robot, Disc(), 0
        self.actions, self.states = embodiment.action.dims, embodiment.state.dims
        self.low, self.high = -np.ones(self.actions), np.ones(self.actions)
        self.noise, self.centre, self.spread = np.full((3, self.actions), [[0.3], [0.0], [0.5]])

    def reset(self, seed):
        self.env.reset(seed=seed)
        return "go to the right"

    def observe(self):
        return self.env.render(), np.resize(self.env.place, self.states), np.append(self.env.place, 1.0)

    def expert(self):
        return np.resize([0.4, 0.05, 0.0], self.actions)

    def step(self, command):
        self.taken += 1
        *_, facts = self.env.step(command)
        return bool(facts["is_success"])


def digest(episode: Recorded) -> str:
    return hashlib.sha256(episode.pictures.tobytes() + episode.commands.tobytes()).hexdigest()


def test_an_episode_depends_on_its_seed_and_number_alone() -> None:
    first, second = DiscSimulator("fetch"), DiscSimulator("fetch")
    in_order = [digest(record_episode(first, SEED, number)) for number in range(EPISODES)]
    assert [digest(record_episode(second, SEED, number)) for number in (4, 2)] == [in_order[4], in_order[2]]
    assert len({*in_order, digest(record_episode(first, SEED + 1, 0))}) == EPISODES + 1


def test_episodes_end_soon_after_success_and_random_ones_do_not_follow_the_expert() -> None:
    simulator = DiscSimulator("fetch")
    episodes = {STYLES[number]: record_episode(simulator, SEED, number) for number in (0, 2, 4)}
    scripted, noised, wild = episodes["scripted"], episodes["noised"], episodes["random"]
    assert scripted.success and np.flatnonzero(scripted.done)[0] + 1 + simulator.rest == len(
        scripted.commands
    )
    assert np.ptp(scripted.commands, axis=0).max() == 0 < np.ptp(noised.commands, axis=0).min()
    assert len(wild.commands) <= simulator.steps and abs(wild.commands).max() <= 1


def test_a_copy_begins_alike_and_strays_with_its_number() -> None:
    simulator = DiscSimulator("fetch")
    original = record_episode(simulator, SEED, 1)
    copies = [record_copy(simulator, SEED, original, copy) for copy in (1, 2)]
    for copy in copies:
        np.testing.assert_array_equal(copy.pictures[0], original.pictures[0])
        assert copy.commands.shape == original.commands.shape
        assert copy.facts["copy_of"] == 1 and "copy_of" not in original.facts
    strays = [abs(copy.commands - original.commands).mean() for copy in copies]
    assert 0 < strays[0] < strays[1]


@pytest.mark.parametrize("robot", ["fetch", "panda", "sawyer"])
def test_what_is_recorded_is_converted(robot: str, tmp_path: Path, block_tokenizer: BlockTokenizer) -> None:
    simulator = DiscSimulator(robot)
    truth = [record_episode(simulator, SEED, number) for number in range(EPISODES)]
    recording, copies = record_simulator(simulator, tmp_path, EPISODES, SEED, perturb=1)
    assert len(open_source(find(robot).source.format).episode_ids(str(copies))) == EPISODES
    convert(find(robot), recording, block_tokenizer, tmp_path / "shards")
    shards = ShardSet(tmp_path / "shards")
    assert verify(tmp_path / "shards") == [] and shards.manifest.quarantined == 0
    for row, episode in zip(shards.episodes.to_pylist(), truth, strict=True):
        np.testing.assert_array_equal(shards.episode_rows(row["episode_index"])["action"], episode.commands)
        assert (row["success"], row["instruction"]) == (episode.success, episode.task)


@pytest.mark.slow
def test_a_lerobot_dataset_keeps_success_and_task(tmp_path: Path) -> None:
    simulator = DiscSimulator("aloha_sim")
    robot = find("aloha_sim")
    truth = [record_episode(simulator, SEED, number) for number in range(EPISODES)]
    (recording,) = record_simulator(simulator, tmp_path, EPISODES, SEED)
    source = open_source("lerobot")
    for name, episode in zip(source.episode_ids(str(recording)), truth, strict=True):
        read = source.read(str(recording), name, robot)
        np.testing.assert_array_equal(read.actions[0].values, episode.commands)
        assert (read.success, read.instruction) == (episode.success, episode.task)


def test_a_stopped_recording_continues_at_the_next_episode(tmp_path: Path) -> None:
    whole, stopped = DiscSimulator("fetch"), DiscSimulator("fetch")
    (expected,) = record_simulator(whole, tmp_path / "whole", EPISODES, SEED)
    taken, step = [], stopped.step

    def interrupted(command):
        taken.append(1)
        if len(taken) == 30:
            raise KeyboardInterrupt
        return step(command)

    stopped.step = interrupted  # type: ignore[method-assign]
    with pytest.raises(Interrupted, match="2 of 5 episodes are kept; the same command continues"):
        record_simulator(stopped, tmp_path / "parts", EPISODES, SEED)
    (recording,) = record_simulator(stopped, tmp_path / "parts", EPISODES, SEED)
    assert len(taken) < whole.taken + 30  # the episodes that were kept were not simulated again
    with h5py.File(expected) as one, h5py.File(recording) as other:
        for name in one["data"]:
            for key in ("actions", "obs/image", "states"):
                np.testing.assert_array_equal(one[f"data/{name}/{key}"], other[f"data/{name}/{key}"])
    assert [path.name for path in (tmp_path / "parts").iterdir()] == ["fetch.hdf5"]
    with pytest.raises(OutputError, match="exists already"):
        record_simulator(stopped, tmp_path / "parts", EPISODES, SEED)
    with pytest.raises(OutputError, match="is a file, not a folder"):
        record_simulator(stopped, tmp_path / "parts" / "fetch.hdf5", EPISODES, SEED)


@pytest.mark.parametrize(
    ("way", "fault"),
    [("egl", "ImportError('Cannot initialize')"), ("osmesa", "AttributeError('glGetError')")],
)
def test_a_machine_that_cannot_draw_is_told_what_to_install(tmp_path, monkeypatch, capsys, way, fault):
    (tmp_path / "mujoco.py").write_text(f"def GLContext(width, height):\n    raise {fault}\n")
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("PYTHONPATH", str(tmp_path))
    monkeypatch.setenv("MUJOCO_GL", way)
    monkeypatch.setattr(sys, "platform", "linux")
    monkeypatch.setattr(sys, "argv", ["fetch.py", str(tmp_path / "out")])
    with pytest.raises(SystemExit):
        main(lambda: DiscSimulator("fetch"), None)
    said = capsys.readouterr().err
    assert f"MUJOCO_GL={way}: cannot draw: " in said and said.count("\n") == 1
    assert "apt-get install libegl1 libgl1-mesa-dri" in said and "libosmesa6" in said


@pytest.mark.parametrize("robot", RECIPES)
def test_recipe_fits_its_embodiment_and_names_its_packages(robot: str) -> None:
    script = shipped("recipes") / "lab" / f"{robot}.py"
    simulator = runpy.run_path(str(script))[RECIPES[robot]]  # the simulator's packages are imported on use
    embodiment = find(robot)
    assert simulator.robot == embodiment.id and embodiment.cameras[0].size == (128, 128)
    vectors = (simulator.low, simulator.high, simulator.noise, simulator.centre, simulator.spread)
    assert {len(vector) for vector in vectors} == {embodiment.action.dims}
    assert (
        1 + 11 * embodiment.stride <= simulator.least <= simulator.steps
    )  # the shortest holds a window of 12
    lines = script.read_text().split("# ///\n")[0].splitlines()[1:]
    header = tomllib.loads("\n".join(line.removeprefix("#").removeprefix(" ") for line in lines))
    assert "hma-toolkit" in header["dependencies"] and all("://" not in line for line in lines)
    assert header["tool"]["uv"]["sources"]["hma-toolkit"] == {"path": "../..", "editable": True}
