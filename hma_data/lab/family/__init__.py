"""Record a family of made-up robots that differ in axes, rate, meaning of the action and look.

A name, such as `arm3_04`, decides everything about a robot: `hma_data.lab.family.bodies` draws it. All are
recorded to HDF5, but the last of HELD_OUT to MCAP. The robots are seen from above and push one to three loose
blocks (`hma_data.lab.family.table`). The action of a frame is applied between that frame and the next; the
motion obeys the limits.

The reward is the distance that the blocks moved, in px. An episode is a success if some block ends MOVED px
or more from its first place. T frames, A actions, Q axes, B blocks.
"""

import itertools
from collections.abc import Callable, Iterable, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.arrays import Float32s
from hma_data.lab.family.bodies import Body
from hma_data.lab.family.driver import CHANCES, Driver, Reacher
from hma_data.lab.family.look import SIZE
from hma_data.lab.family.mechanisms import MAKERS, Axis
from hma_data.lab.family.table import BlockTable, start
from hma_data.lab.writers import BagEpisode, Demo, block_demo, write_hdf5, write_mcap
from hma_data.registry.embodiment import Embodiment

SECONDS = 8.0  # of an episode
MOVED = 5.0  # px that a block moves in a success
TRUNK: tuple[str, ...] = (
    "arm1_02", "arm1_03", "arm2_02", "arm2_07", "arm2_12", "arm2_50", "arm3_01", "arm3_04",
    "arm3_08", "arm3_11", "arm4_01", "arm4_04", "mover_02", "mover_04", "mover_06", "mover_10",
    "mover_59", "gantry_04", "gantry_05", "rails_03", "rails_09", "crane_01", "crane_04", "crane_08",
)  # fmt: skip
HELD_OUT = ("arm3_55", "mover_52")  # not for pre-training: the demo's new robots
FIRST_FURTHER = 60  # number of the first robots beside these
PROVENANCE = {
    "recording": "made by hma_data.lab.family; everything about the robot is drawn from its name",
    "frequency_hz": "the simulator's control rate",
    "action": "commands as given; the motion obeys the limits",
    "success": f"some block ended {MOVED:g} px or more of the {SIZE} by {SIZE} px picture from where it lay",
}
NOTES = "Random manoeuvres: going to a pose or a block, holding a velocity, weaving, resting."


def record(part: Path, robot: str, episodes: Iterable[int], seed: int) -> None:
    """Record a robot as a file of robomimic's layout, or as a folder of MCAP files; see `hma_data.lab`."""
    body = Body.of(robot)
    if not _in_bags(robot):
        write_file(part, body, (episode(body, seed, number) for number in episodes))
        return
    part.mkdir()
    for number in episodes:
        _write_bag(part / f"episode_{number:04d}.mcap", body, seed, number)


def further(count: int) -> list[str]:
    """Return the names of `count` robots, of all kinds in turn, that are neither in TRUNK nor in HELD_OUT."""
    names = (f"{kind}_{number}" for number in itertools.count(FIRST_FURTHER) for kind in MAKERS)
    return list(itertools.islice(names, count))


def embodiment(robot: str) -> Embodiment:
    """Return the embodiment of a robot of the family.

    Raises:
        UsageError: the name is none of the family's.
    """
    body = Body.of(robot)
    bags = _in_bags(robot)
    components = [_component(body, number, bags) for number in range(len(body.commands))]
    spaces = {_space(body, axis) for axis in body.commands}
    units = {axis.unit for axis in body.axes}
    key = "/joint_states.position" if bags else "obs/joint_pos"
    pose = {"key": key, "dims": len(body.axes), "names": [axis.name for axis in body.axes]}
    if len(units) == 1:
        pose["unit"] = units.pop()
    image = "/camera/image/compressed" if bags else "obs/image"
    values = {
        "id": robot,
        "description": f"A made-up {body.description}, at {body.hz} Hz",
        "robot": body.description.partition(",")[0],
        "kind": "simulation",
        "frequency_hz": body.hz,
        "target_hz": body.hz / body.stride,
        "action": {"space": spaces.pop() if len(spaces) == 1 else "mixed", "components": components},
        "state": {"components": [pose]},
        "cameras": [{"name": "top", "key": image, "size": [SIZE, SIZE]}],
        "source": {"format": "rosbag" if bags else "hdf5"},
        "license": "Apache-2.0",
        "provenance": PROVENANCE,
        "notes": NOTES,
    }
    if bags:
        values["sync"] = {"primary": "top", "max_skew_ms": 1500 / body.hz}
    return Embodiment.from_values(values, f"embodiment {robot}")


def _in_bags(robot: str) -> bool:
    return robot == HELD_OUT[-1]


def _space(body: Body, axis: Axis) -> str:
    if body.grip == axis.name:
        return "mixed"
    if body.kind == "mover":
        return "eef_pose" if axis.target else "base_velocity"
    return "joint_position" if axis.target else "joint_velocity"


def _component(body: Body, number: int, bags: bool) -> dict[str, Any]:
    axis = body.commands[number]
    part: dict[str, Any] = {"key": "actions", "dims": 1, "names": [axis.name], "range": list(axis.range)}
    if bags:
        part["key"] = f"/command.twist.linear.{'xyz'[number]}"
    elif len(body.commands) > 1:
        part["slice"] = [number, number + 1]
    if axis.command_unit:
        part["unit"] = axis.command_unit
    if axis.name == body.grip:
        part["normalize"] = False
    if axis.name == "gripper":
        part["gripper"] = "open_is_high"
    return part


def _write_bag(path: Path, body: Body, seed: int, number: int) -> None:
    """Write frames, poses and actions at the control rate."""
    demo = episode(body, seed, number)
    bag = BagEpisode(number, "table", np.random.default_rng((seed, 7, number)))
    for row, action in enumerate(demo.actions):
        at = round(row * 1e9 / body.hz)
        bag.image(at, demo.observations["image"][row])
        bag.joints(at, [axis.name for axis in body.axes], demo.observations["joint_pos"][row], np.empty(0))
        bag.command(at, action.astype(np.float64))
    facts = {"success": str(demo.success).lower(), "seed": str(seed)}
    write_mcap(path, bag.messages, {"robot": body.name, **facts})


def write_file(part: Path, body: Body, demos: Iterable[Demo]) -> None:
    """Write episodes as a file of robomimic's layout."""
    env_args = {"env_name": body.name, "type": 2, "env_kwargs": {"control_freq": body.hz}}
    write_hdf5(part, demos, env_args)


def episode(
    body: Body,
    seed: int,
    number: int,
    reach: Reacher | None = None,
    seconds: float = SECONDS,
    chances: Sequence[float] = CHANCES,
) -> Demo:
    """Simulate an episode; the same arguments give the same bytes.

    Args:
        reach: the commander; by default one of random manoeuvres, drawn by `chances` (see `MANOEUVRES`).
    """
    world, rng = start(body, seed, number)
    drive = driver(world, rng, reach or Driver(body, world.pose, rng, chances))
    return block_demo(world, drive, round(seconds * body.hz), MOVED, seed)


def begin(robot: str, seed: int, number: int) -> tuple[BlockTable, Callable[[], Float32s]]:
    """Return the simulation of an episode at its start, and the recorder's driver."""
    world, rng = start(Body.of(robot), seed, number)
    return world, driver(world, rng)


def driver(
    world: BlockTable, rng: np.random.Generator, drive: Driver | Reacher | None = None
) -> Callable[[], Float32s]:
    """Return the recorder's driver, which returns the next action (A,)."""
    drive = drive or Driver(world.body, world.pose, rng)
    return lambda: drive(world.pose, world.blocks, world.held >= 0).astype(np.float32)
