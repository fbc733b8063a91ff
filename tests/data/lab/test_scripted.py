"""Drivers from a state: the recorder's own commands from the true one, and states found off places."""

import numpy as np
import pytest

from hma_data.lab import family, planar_arm, truth
from hma_data.lab.family.mechanisms import wrapped
from hma_data.lab.scripted import SeenState, driver, state_of, steerable
from hma_data.lab.simulator import LabSimulator

ROBOTS = ("rails_03", "arm2_07", "mover_10", "planar_arm")


@pytest.mark.parametrize("robot", ROBOTS)
def test_from_the_true_state_the_commands_are_the_recorders(robot: str) -> None:
    simulator = LabSimulator(robot)
    simulator.reset(0, 3)
    begun = planar_arm.start(0, 3) if robot == "planar_arm" else family.start(family.Body.of(robot), 0, 3)
    drive = driver(robot, state_of(simulator.simulation).pose, begun[1])
    for _ in range(40):
        wanted = simulator.recorded()
        np.testing.assert_allclose(drive(state_of(simulator.simulation)), wanted, atol=1e-4)
        simulator.advance(wanted)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_pose_is_found_off_places_and_followed(robot: str) -> None:
    simulator = LabSimulator(robot)
    simulator.reset(1, 0)
    driven, places = truth.parts_of(simulator.simulation)
    seen = SeenState(robot, np.arange(driven), places)
    stride = simulator.embodiment.stride
    for step in range(6 * stride):
        command = simulator.recorded()
        simulator.advance(command)
        seen.move(command)
        if (step + 1) % stride == 0:
            seen.see(truth.parts_of(simulator.simulation)[1])
    true = state_of(simulator.simulation)
    shown = 2 if robot == "arm2_07" else len(true.pose)  # its gripper holds a block more or less open
    np.testing.assert_allclose(wrapped(seen.state.pose - true.pose)[:shown], 0, atol=0.02)
    np.testing.assert_allclose(seen.state.blocks, true.blocks, atol=1e-9)
    assert steerable(robot) and not steerable("pusht_fast")
