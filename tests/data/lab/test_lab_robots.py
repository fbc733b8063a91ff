"""The laboratory's pendulum and planar arm: what is recorded happened, and the actions made it happen."""

import sys
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from numpy.typing import NDArray

from hma_data.conversion.job import convert
from hma_data.episodes.episode import Episode
from hma_data.errors import MissingDependencyError
from hma_data.lab import pendulum, planar_arm, record
from hma_data.registry.embodiment import Embodiment, find
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.sources.base import open_source

EPISODES, SEED = 3, 3
ROBOTS = ("pendulum", "planar_arm")


@dataclass(frozen=True)
class Recorded:
    robot: Embodiment
    path: Path
    episodes: list[Episode]

    def pictures(self, episode: int) -> NDArray[np.uint8]:
        stream = self.episodes[episode].streams[self.robot.cameras[0].name]
        return stream.frames(np.arange(len(stream.timestamps)))

    def actions(self, episode: int) -> NDArray[np.float32]:
        return np.asarray(self.episodes[episode].actions[0].values, dtype=np.float32)

    def states(self, episode: int) -> NDArray[np.float64]:
        return np.concatenate([signal.values for signal in self.episodes[episode].states], axis=1)


@pytest.fixture(scope="module")
def recordings(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Recorded]:
    made = {}
    for name in ROBOTS:
        robot = find(name)
        path = record(name, tmp_path_factory.mktemp(name), EPISODES, SEED)
        source = open_source(robot.source.format)
        episodes = [source.read(str(path), one, robot) for one in source.episode_ids(str(path))]
        made[name] = Recorded(robot, path, episodes)
    return made


@pytest.mark.parametrize(("robot", "stride"), [("pendulum", 2), ("planar_arm", 3)])
def test_recording_reads_as_the_registry_describes_and_converts(
    robot, stride, recordings, block_tokenizer, tmp_path
) -> None:
    recorded = recordings[robot]
    assert recorded.robot.stride == stride and len(recorded.episodes) == EPISODES
    low, high = recorded.robot.action.components[0].range or (0, 0)
    for i in range(EPISODES):
        actions, pictures = recorded.actions(i), recorded.pictures(i)
        assert low <= actions.min() and actions.max() <= high
        assert pictures.shape == (len(actions), *(recorded.robot.cameras[0].size or ()), 3)
    convert(recorded.robot, str(recorded.path), block_tokenizer, tmp_path / "shards")
    assert verify(tmp_path / "shards") == []
    shards = ShardSet(tmp_path / "shards")
    rows = [shards.episode_rows(row["episode_index"]) for row in shards.episodes.to_pylist()]
    kept = sorted(values["action"].tobytes() for values in rows)
    assert kept == sorted(recorded.actions(i).tobytes() for i in range(EPISODES))


@pytest.mark.parametrize(
    ("robot", "module", "said"),
    [
        ("pendulum", "gymnasium.envs.classic_control.pendulum", "uv sync"),
        ("planar_arm", "pymunk", "uv sync"),
        ("pusht_fast", "pymunk", "pymunk and pygame.*uv sync"),
        ("planar_arm_lerobot", "lerobot.datasets.lerobot_dataset", "lerobot: .*uv sync"),
    ],
)
def test_a_missing_simulator_says_how_to_install_it(robot, module, said, tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, module, None)
    with pytest.raises(MissingDependencyError, match=said) as found:
        record(robot, tmp_path, 1)
    assert "\n" not in str(found.value) and list(tmp_path.iterdir()) == []


def test_gymnasium_replays_the_pendulum(recordings: dict[str, Recorded]) -> None:
    import gymnasium

    for i in range(EPISODES):
        begun, _ = pendulum.begin("pendulum", SEED, i)
        env: Any = gymnasium.make("Pendulum-v1")
        env.reset(seed=0)
        env.unwrapped.state = np.array([begun.angle, begun.speed])
        observations = [env.unwrapped._get_obs()]
        observations += [env.step(action)[0] for action in recordings["pendulum"].actions(i)[:-1]]
        np.testing.assert_allclose(np.stack(observations), recordings["pendulum"].states(i), atol=1e-4)


def test_pictures_show_the_rod_at_its_recorded_angle(recordings: dict[str, Recorded]) -> None:
    recorded, errors = recordings["pendulum"], []
    for picture, state in zip(recorded.pictures(0), recorded.states(0), strict=True):
        red, green, _ = np.moveaxis(picture.astype(int), -1, 0)
        rows, columns = np.nonzero(red - green > 80)
        right, up = columns.mean() - 63.5, 63.5 - rows.mean()
        errors.append(np.hypot(up / np.hypot(right, up) - state[0], -right / np.hypot(right, up) - state[1]))
    assert max(errors) < 0.1


def test_pendulum_needs_no_display(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    import pygame

    pygame.display.quit()
    monkeypatch.setenv("SDL_VIDEODRIVER", "x11")
    monkeypatch.setenv("DISPLAY", ":987")
    record("pendulum", tmp_path, 1)
    assert not pygame.display.get_init()


def test_joints_move_as_commanded(recordings: dict[str, Recorded]) -> None:
    recorded = recordings["planar_arm"]
    for i in range(EPISODES):
        moving = recorded.states(i)[1:, 2:]
        assert np.median(np.abs(moving - recorded.actions(i)[:-1])) < 0.01


def test_tip_goes_to_the_point_asked_for() -> None:
    rng = np.random.default_rng(0)
    for bend in (-1, 1):
        for _ in range(50):
            angle, far = rng.uniform(-np.pi, np.pi), rng.uniform(140, 220)
            point = planar_arm.BASE + far * np.array([np.cos(angle), np.sin(angle)])
            joints = planar_arm.joints_at(point, bend)
            np.testing.assert_allclose(planar_arm.elbow_and_tip(joints)[1], point, atol=1e-6)
            assert joints[1] * bend >= 0


def test_nothing_moves_until_commanded() -> None:
    for episode in range(5):
        arm, _ = planar_arm.start(SEED, episode)
        before = arm.state
        for _ in range(10):
            arm.advance(np.zeros(2, dtype=np.float32))
        np.testing.assert_allclose(arm.state, before, atol=1e-6)


def test_reward_is_the_blocks_way_and_they_stay_within_the_walls(recordings: dict[str, Recorded]) -> None:
    with h5py.File(recordings["planar_arm"].path) as file:
        for demo in file["data"].values():
            places = demo["states"][:, 4:].reshape(-1, 3, 3)[..., :2]
            moved = np.linalg.norm(np.diff(places, axis=0), axis=-1).sum(axis=-1)
            np.testing.assert_allclose(demo["rewards"][:-1], moved, atol=1e-9)
            assert places.min() > 20 and places.max() < planar_arm.ARENA - 20
            assert (demo["rewards"][:] > 0.5).any() or not demo.attrs["success"]


def test_elbow_holds_at_its_stop() -> None:
    arm, _ = planar_arm.start(SEED, 0)
    for _ in range(90):
        arm.advance(np.array([0.0, 2.6], dtype=np.float32))
    assert arm.angles[1] == pytest.approx(planar_arm.ELBOW_STOP, abs=0.05)
