"""The made-up family: a name decides a robot, its commands decide the motion, and its recordings convert."""

import re
from collections.abc import Iterable
from importlib.util import module_from_spec, spec_from_file_location
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hma_data.conversion.engines import FIRST_ATTEMPT
from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.errors import UsageError
from hma_data.lab import RECORDERS, record
from hma_data.lab.family import HELD_OUT, TRUNK, embodiment, episode
from hma_data.lab.family.bodies import Body
from hma_data.lab.family.look import SIZE
from hma_data.lab.family.mechanisms import MAKERS
from hma_data.lab.family.table import BlockTable, start
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.manifest import MANIFEST
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.sources.base import open_source
from hma_data.storage.paths import shipped
from tests.conftest import BlockTokenizer

SEED = 3


def quick(robots: Iterable[str], *few: str) -> list[Any]:
    return [one if one in few else pytest.param(one, marks=pytest.mark.slow) for one in robots]


def still(world: BlockTable) -> np.ndarray[Any, Any]:
    follows = [axis.target for axis in world.body.commands]
    return np.where(follows, world.pose[: len(follows)], 0.0)


def driven(robot: str, command: str, steps: int) -> tuple[BlockTable, list[np.ndarray[Any, Any]]]:
    world, _ = start(Body.of(robot), SEED, 0)
    pictures = [world.picture()]
    for _ in range(steps):
        low, high = world.body.ranges
        world.advance({"low": low, "high": high}[command] if command != "still" else still(world))
        pictures.append(world.picture())
    return world, pictures


def test_trunk_has_all_kinds_and_no_robot_that_is_held_out() -> None:
    assert len(set(TRUNK)) == 24 and not set(TRUNK) & set(HELD_OUT)
    assert {Body.of(robot).kind for robot in TRUNK} == set(MAKERS)
    rates = {embodiment(robot).effective_hz for robot in (*TRUNK, *HELD_OUT)}
    assert all(5 <= rate <= 10 and rate == int(rate) for rate in rates)


@pytest.mark.parametrize("robot", ["arm2_12", "mover_52", "gantry_04", "rails_09", "crane_01"])
def test_other_commands_make_other_pictures_and_no_command_a_still_one(robot: str) -> None:
    steps = 6 * Body.of(robot).stride
    low, high, rest = (driven(robot, command, steps)[1] for command in ("low", "high", "still"))
    np.testing.assert_array_equal(low[0], high[0])
    changed = np.abs(low[-1].astype(int) - high[-1]).max(axis=-1) > 60
    assert changed.sum() > 150
    np.testing.assert_array_equal(rest[0], rest[-1])


@pytest.mark.parametrize("robot", quick([*TRUNK, *HELD_OUT], "arm3_08", "rails_03", "mover_52"))
def test_commands_fill_their_range_and_blocks_stay_inside_and_out_of_the_parts_that_push(robot: str) -> None:
    body, parts = Body.of(robot), embodiment(robot).action.components
    recorded = episode(body, SEED, 0)
    assert recorded.actions.shape[1] == len(parts) == embodiment(robot).action_dim
    for values, part in zip(recorded.actions.T, parts, strict=True):
        low, high = part.range or (0, 0)
        assert low - 1e-5 <= values.min() and values.max() <= high + 1e-5
        assert np.ptp(values) > 0.25 * (high - low)
    states = recorded.states[:: body.stride]
    radii = np.array([block.radius for block in body.blocks])[:, None]
    for state in states:
        pose, blocks, held = (
            state[: len(body.axes)],
            state[len(body.axes) : -1].reshape(-1, 2),
            int(state[-1]),
        )
        assert (blocks >= radii - 1e-9).all() and (blocks <= SIZE - radii + 1e-9).all()
        for number, place in enumerate(blocks):
            free = number != held and (abs(place - SIZE / 2) < SIZE / 2 - radii[number] - 2).all()
            for part in body.mechanism.shapes(pose):
                if free and part.pushes and len(part.points) == 2 and len(blocks) == 1:
                    share = np.linspace(0, 1, 200)[:, None]
                    line = part.points[0] + share * (part.points[1] - part.points[0])
                    assert np.linalg.norm(line - place, axis=1).min() > part.radius + radii[number] - 0.5


@pytest.mark.parametrize(("robot", "hold", "release"), [("arm2_07", 0.0, 1.0), ("crane_01", 1.0, 0.0)])
def test_what_is_held_moves_with_the_tip_until_it_is_released(robot, hold, release) -> None:
    world, _ = start(Body.of(robot), SEED, 1)
    world.blocks[0] = world.body.mechanism.tip(world.pose)[0]
    begun = world.blocks[0].copy()

    def drive(speed: float, grip: float) -> None:
        for _ in range(world.body.hz):
            world.advance(np.array([speed] * (len(world.pose) - 1) + [grip]))

    drive(0.0, hold)
    assert world.held == 0
    np.testing.assert_allclose(world.blocks[0], begun, atol=2)
    drive(0.4, hold)
    assert np.linalg.norm(world.blocks[0] - begun) > 5
    np.testing.assert_allclose(world.blocks[0], world.body.mechanism.tip(world.pose)[0], atol=2)
    drive(0.0, release)
    assert world.held == -1


@pytest.mark.parametrize("robot", HELD_OUT)
def test_registry_has_what_the_family_says(robot: str) -> None:
    assert Embodiment.load(shipped("registry") / "lab" / f"{robot}.yaml") == embodiment(robot)
    assert robot in RECORDERS


@pytest.mark.parametrize("robot", quick(HELD_OUT, "arm3_55"))
def test_recording_converts(robot: str, block_tokenizer: BlockTokenizer, tmp_path: Path) -> None:
    own, demos = embodiment(robot), [episode(Body.of(robot), SEED, number) for number in range(2)]
    path = record(robot, tmp_path, 2, SEED)
    source = open_source(own.source.format)
    first = source.read(str(path), source.episode_ids(str(path))[0], own)
    stream = first.streams["top"]
    np.testing.assert_array_equal(stream.frames(np.arange(9)), demos[0].observations["image"][:9])
    convert(own, path, block_tokenizer, tmp_path / "shards")
    assert verify(tmp_path / "shards") == []
    shards = ShardSet(tmp_path / "shards")
    kept = {
        shards.episode_rows(row["episode_index"])["action"].tobytes() for row in shards.episodes.to_pylist()
    }
    assert kept == {demo.actions.tobytes() for demo in demos}
    assert shards.manifest.quarantined == 0


def test_name_that_is_no_kind_is_refused(tmp_path: Path) -> None:
    with pytest.raises(UsageError, match=re.escape("arm5_01")):
        Body.of("arm5_01")
    with pytest.raises(UsageError, match="is not one of the toolkit's simulated robots"):
        record("arm5_01", tmp_path, 1)


@pytest.mark.parametrize("pushing", [False, True])
def test_recipe_leaves_shards_and_no_recording(tmp_path, block_tokenizer, pushing) -> None:
    spec = spec_from_file_location("record_world", shipped("recipes") / "world" / "record.py")
    assert spec and spec.loader
    recipe = module_from_spec(spec)
    spec.loader.exec_module(recipe)
    settings = Settings(frames="strided")
    work = recipe.make_work(tmp_path, 2, SEED, block_tokenizer, settings, "cpu", pushing, 1)
    line = work("arm1_02", lambda event: None, FIRST_ATTEMPT)
    assert "80 frames" in line and not list((tmp_path / "recordings").iterdir())
    assert (tmp_path / "shards" / "arm1_02" / MANIFEST).is_file()
    assert Embodiment.load(tmp_path / "embodiments" / "arm1_02.yaml") == embodiment("arm1_02")
