"""Drivers from a state: the recorder's own commands from the true one, and states found off places."""

import sys

import h5py
import numpy as np
import pytest

from hma_data.lab import family, planar_arm, pusht, truth
from hma_data.lab.family.look import wrapped
from hma_data.lab.scripted import driver, reacher, seen_state, state_of, steerable
from hma_data.lab.simulator import LabSimulator
from hma_data.storage.paths import shipped

sys.path.insert(0, str(shipped("recipes") / "lab"))
from reaching import record_reaching  # type: ignore[import-not-found]

ROBOTS = ("rails_03", "arm2_07", "mover_10", "planar_arm")


@pytest.mark.parametrize("robot", [*ROBOTS, "pusht_fast"])  # it starts from afar: no goal before the end
def test_from_the_true_state_the_commands_are_the_recorders(robot: str) -> None:
    simulator = LabSimulator(robot)
    simulator.reset(0, 3)
    if robot == "pusht_fast":
        rng = pusht.FastPusher(0, 3).rng
    elif robot == "planar_arm":
        _, rng = planar_arm.start(0, 3)
    else:
        _, rng = family.start(family.Body.of(robot), 0, 3)
    drive = driver(robot, state_of(simulator.simulation).pose, rng)
    for _ in range(40):
        wanted = simulator.recorded()
        np.testing.assert_allclose(drive(state_of(simulator.simulation)), wanted, atol=1e-3)
        simulator.advance(wanted)


@pytest.mark.parametrize("robot", ROBOTS)
def test_a_pose_is_found_off_places_and_followed(robot: str) -> None:
    simulator = LabSimulator(robot)
    simulator.reset(1, 0)
    driven, places = truth.parts_of(simulator.simulation)
    seen = seen_state(robot, np.arange(driven), places)
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
    assert steerable(robot) and not steerable("pusht_slow")


def test_a_pusher_is_seen_and_followed_between_pictures() -> None:
    simulator = LabSimulator("pusht_fast")
    simulator.reset(0, 0)
    seen = seen_state("pusht_fast", np.arange(1), truth.parts_of(simulator.simulation)[1])
    for step in range(24):
        command = simulator.recorded()
        simulator.advance(command)
        seen.move(command)
        true = state_of(simulator.simulation)
        assert np.linalg.norm(seen.state.pose - true.pose) < 25  # px of 512, of up to 120 on the way
        if step % 4 == 3:
            seen.see(truth.parts_of(simulator.simulation)[1])
            np.testing.assert_allclose(seen.state.pose, true.pose, atol=1e-9)
            np.testing.assert_allclose(seen.state.blocks, true.blocks, atol=1e-9)


@pytest.mark.parametrize("robot", ["mover_04", "mover_06", "mover_10", "gantry_05", "crane_01", "arm4_04"])
def test_a_reach_ends_at_the_block_that_lay_nearest(robot: str) -> None:
    body, ends = family.Body.of(robot), []
    for number in range(6):
        world, _ = family.start(body, 0, number)
        tip, lay = body.mechanism.tip(world.pose)[0], world.blocks.copy()
        nearest = lay[np.linalg.norm(lay - tip, axis=1).argmin()]
        drive = reacher(robot)
        for _ in range(3 * body.hz):
            command = drive(state_of(world))
            assert (command >= body.ranges[0] - 1e-4).all() and (command <= body.ranges[1] + 1e-4).all()
            world.advance(command)
        ends.append(np.linalg.norm(body.mechanism.tip(world.pose)[0] - nearest))
    assert np.median(ends) < 2.0  # arms cannot reach every place


def test_recorded_reaches_are_those_of_the_driver(tmp_path) -> None:
    record_reaching(tmp_path / "a.hdf5", "mover_04", range(2), 5)
    with h5py.File(tmp_path / "a.hdf5") as file:
        actions = file["data/demo_1/actions"][:]
    world, drive = family.start(family.Body.of("mover_04"), 5, 1)[0], reacher("mover_04")
    for action in actions:
        np.testing.assert_allclose(drive(state_of(world)), action, atol=1e-5)
        world.advance(action)
    assert len(actions) == 20
