"""The simulators to drive by hand and as truth beside a model: they give the recorded pictures and states."""

from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from hma_data.episodes.align import to_clip
from hma_data.episodes.episode import Clip
from hma_data.episodes.images import prepare
from hma_data.errors import UsageError
from hma_data.lab import planar_arm, record, simulator, truth
from hma_data.lab.family.look import SIZE as LAB_SIZE
from hma_data.lab.simulator import SIZE, LabSimulator, simulated
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import open_source

SEED, EPISODE = 5, 1


def recorded(robot: Embodiment, folder: Path) -> tuple[Clip, NDArray[np.uint8]]:
    path = str(record(robot.id, folder, 2, SEED))
    source, camera = open_source(robot.source.format), robot.cameras[0]
    clip = to_clip(source.read(path, source.episode_ids(path)[EPISODE], robot), robot)
    return clip, prepare(clip.frames_at(camera.name, np.arange(len(clip))), camera, SIZE)


SLOW = ("pusht_fast", "arm4_04", "gantry_04", "rails_09")


@pytest.mark.parametrize(
    "robot",
    [
        *("pendulum", "planar_arm", "arm2_12", "mover_52", "crane_01"),
        *(pytest.param(robot, marks=pytest.mark.slow) for robot in SLOW),
    ],
)
def test_recorded_commands_give_the_recorded_pictures_and_states(robot: str, tmp_path: Path) -> None:
    simulator = LabSimulator(robot)
    clip, pictures = recorded(simulator.embodiment, tmp_path)
    seen: list[Any] = [simulator.reset(SEED, EPISODE)]
    states = [simulator.state]
    for command in clip.actions[:-1]:
        np.testing.assert_array_equal(simulator.recorded(), command)  # the recorder's driver
        seen.append(simulator.step(command))
        states.append(simulator.state)
    np.testing.assert_array_equal(np.stack(seen), pictures)
    np.testing.assert_allclose(np.stack(states), clip.states, atol=1e-6)


# Means of 31 pictures, of 30 commands (absolute), and of the last state.
KNOWN = {
    "pusht_fast": (250.180, 302.6623, 326.1109),
    "pusht_slow": (249.875, 65.4171, 201.4131),
    "pendulum": (246.463, 1.8371, 1.5072),
    "planar_arm": (216.125, 0.8864, 0.8545),
    "arm3_55": (61.154, 0.9771, 0.3277),
    "mover_52": (174.152, 14.4302, 76.2550),
    "gantry_04": (69.392, 9.8523, 36.4594),
    "rails_09": (172.073, 70.3632, 56.5088),
    "crane_01": (207.385, 6.3960, 8.1588),
}


@pytest.mark.parametrize("robot", KNOWN)
def test_a_robot_looks_and_moves_as_when_bundled_models_were_trained(robot: str) -> None:
    simulator, commands = LabSimulator(robot), []
    pictures = [simulator.reset(0, 0)]
    for _ in range(30):
        commands.append(simulator.recorded())
        pictures.append(simulator.step(commands[-1]))
    found = np.mean(pictures), np.abs(commands).mean(), np.mean(simulator.state)
    assert found == pytest.approx(KNOWN[robot], rel=1e-3)


@pytest.mark.slow
def test_pusht_slow_follows_its_recording_up_to_the_jitter(tmp_path: Path) -> None:
    simulator = LabSimulator("pusht_slow")
    clip, pictures = recorded(simulator.embodiment, tmp_path)
    simulator.reset(SEED, EPISODE)
    seen, states = [], []
    for command in clip.actions[:30]:
        seen.append(simulator.step(command))
        states.append(simulator.state)
    assert clip.states is not None and np.ptp(clip.states[:30, :2], axis=0).max() > 50
    assert np.abs(np.stack(states)[:, :2] - clip.states[1:31, :2]).max() < 30  # px of 512; 300 px/s
    assert np.abs(np.stack(seen)[-1].astype(float) - pictures[30]).mean() < 8


@pytest.mark.parametrize("robot", ["pusht_slow", "planar_arm", "arm2_12"])
def test_a_copy_goes_on_alone_as_the_original_does(robot: str) -> None:
    simulator = LabSimulator(robot, SEED)
    for _ in range(25):
        simulator.advance(simulator.recorded())
    copy, commands = simulator.copy(), [simulator.recorded() for _ in range(8)]
    before = copy.picture()
    ahead = [simulator.step(command) for command in commands]
    np.testing.assert_array_equal(copy.picture(), before)
    np.testing.assert_array_equal([copy.step(command) for command in commands], ahead)


def test_a_robot_without_simulator_is_refused() -> None:
    assert simulated("rails_09") and not simulated("bridge") and not simulated("rails")
    with pytest.raises(UsageError, match=r"bridge: has no simulator.*arm1_02"):
        LabSimulator("bridge")


STRIDE = 3


@pytest.mark.parametrize("robot", ["arm2_07", "planar_arm", "pusht_fast"])
def test_an_episode_is_the_one_that_the_recorder_writes(robot: str, tmp_path: Path) -> None:
    number = 1 if robot == "pusht_fast" else 0  # its first episode that wanders
    with h5py.File(record(robot, tmp_path, number + 1, seed=4)) as file:
        recorded = file[f"data/demo_{number}"]
        pictures, actions = recorded["obs/image"][:30:STRIDE], recorded["actions"][:30]
    found = truth.episode(robot, 10, STRIDE, seed=4, number=0)
    np.testing.assert_array_equal(found.pictures, pictures)
    np.testing.assert_array_equal(found.chunks.reshape(actions.shape), actions)


ROBOTS = ("pendulum", "planar_arm", *truth.PUSHERS, "mover_10", "gantry_04", "crane_01", "rails_09")


@pytest.mark.parametrize("robot", ROBOTS)
def test_episodes_are_repeatable_and_of_any_length(robot: str) -> None:
    own = simulator.embodiment(robot)
    short, long = (truth.episode(robot, frames, own.stride, 2, 3) for frames in (4, 30))
    np.testing.assert_array_equal(short.pictures, long.pictures[:4])
    np.testing.assert_array_equal(short.parts, long.parts[:4])
    some = truth.episode(robot, 4, own.stride, 2, 3, drawn={1, 3})
    np.testing.assert_array_equal(some.pictures, short.pictures[[1, 3]])
    assert long.chunks.shape == (30, own.chunk_dim) and long.chunks.dtype == np.float32
    assert long.pictures.shape[:2] == (30, long.pictures.shape[2]) and 1 <= long.driven <= long.parts.shape[1]
    moved = np.ptp(long.parts[:, : long.driven], axis=0).max()
    assert 4 < moved < LAB_SIZE


def test_parts_are_where_their_colours_are() -> None:
    found = truth.episode("planar_arm", 40, STRIDE, 1, 0)
    rows, (_, fore) = np.arange(40), found.parts[:, :2].transpose(1, 0, 2).round().astype(int)
    assert (np.abs(found.pictures[rows, fore[:, 1], fore[:, 0]] - np.array(planar_arm.FORE_COLOR)) < 8).all()
    tee = truth.episode("pusht_slow", 40, 5, 1, 2)
    x, y = (tee.parts[:, 2] * tee.pictures.shape[2] / LAB_SIZE).round().astype(int).T
    assert (np.abs(tee.pictures[rows, y, x].astype(int) - (246, 160, 76)).max(axis=-1) < 30).mean() > 0.8
