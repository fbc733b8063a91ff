"""The simulator to drive by hand: recorded commands give the recorded pictures and states."""

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from hma_data.episodes.align import to_clip
from hma_data.episodes.episode import Clip
from hma_data.episodes.images import prepare
from hma_data.errors import UsageError
from hma_data.lab import record
from hma_data.lab.simulator import SIZE, LabSimulator, simulated
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import open_source

SEED, EPISODE = 5, 1


def recorded(robot: Embodiment, folder: Path) -> tuple[Clip, NDArray[np.uint8]]:
    path = str(record(robot.id, folder, 2, SEED))
    source, camera = open_source(robot.source.format), robot.cameras[0]
    clip = to_clip(source.read(path, source.episode_ids(path)[EPISODE], robot), robot)
    return clip, prepare(clip.frames_at(camera.name, np.arange(len(clip))), camera, SIZE)


@pytest.mark.parametrize(
    "robot", [pytest.param("pusht_fast", marks=pytest.mark.slow), "pendulum", "planar_arm", "arm2_12"]
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
