"""The laboratory's recordings hold what really happened in the environment, in the layouts they claim."""

import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import h5py
import numpy as np
import pytest
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
from rosbags.highlevel import AnyReader

from hma_data.errors import OutputError, UsageError
from hma_data.lab import RECORDERS, record
from hma_data.lab.pusher import LENGTHS, predicted_costs, rotation
from hma_data.lab.pusht import SLOW_LOOK, STEPS_HELD, PushArena
from hma_data.lab.tee_table import TeeTable
from hma_data.lab.writers import _held_out
from hma_data.registry.embodiment import find
from hma_data.sources.base import open_source
from hma_data.storage.paths import shipped
from tests.conftest import contents

sys.path.insert(0, str(shipped("recipes") / "lab"))
from pushes import PLAY_STARTS, record_noisy, record_play  # type: ignore[import-not-found]

EPISODES = 3


@pytest.fixture(scope="module")
def fast(tmp_path_factory: pytest.TempPathFactory) -> Iterator[h5py.File]:
    with h5py.File(record("pusht_fast", tmp_path_factory.mktemp("fast"), EPISODES, seed=3)) as file:
        yield file


@pytest.fixture(scope="module")
def slow(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    return sorted(record("pusht_slow", tmp_path_factory.mktemp("slow"), EPISODES, seed=3).iterdir())


def bag(path: Path) -> dict[str, list[tuple[int, int, Any]]]:
    """topic -> (header stamp, receive time, message) of every message, read by rosbags."""
    topics: dict[str, list[tuple[int, int, Any]]] = {}
    with AnyReader([path]) as reader:
        for connection, received, raw in reader.messages():
            message: Any = reader.deserialize(raw, connection.msgtype)
            stamp = message.header.stamp.sec * 1_000_000_000 + message.header.stamp.nanosec
            topics.setdefault(connection.topic, []).append((stamp, received, message))
    return topics


def arena(start: str = "near", seed: int = 0) -> PushArena:
    return PushArena(SLOW_LOOK, start, np.random.default_rng(seed))


def test_masks_hold_out_five_demos_of_a_small_recording() -> None:
    assert [len(_held_out(count)) for count in (1, 2, 8, 16, 32, 49)] == [0, 1, 2, 4, 5, 5]
    assert _held_out(60) == {9, 19, 29, 39, 49, 59} and max(_held_out(32)) == 31


def test_hdf5_has_robomimic_layout(fast: h5py.File) -> None:
    total = 0
    for i in range(EPISODES):
        demo = fast[f"data/demo_{i}"]
        length = demo.attrs["num_samples"]
        total += length
        assert demo["actions"].shape == (length, 2) and demo["actions"].dtype == np.float32
        assert demo["obs/image"].shape == (length, 128, 128, 3) and demo["obs/image"].chunks[0] == 1
        assert {len(demo[key]) for key in ("obs/agent_pos", "states", "rewards", "dones")} == {length}
        assert demo["dones"][:].tolist() == [0] * (length - 1) + [1]
    assert fast["data"].attrs["total"] == total
    assert {bool(demo.attrs["success"]) for demo in fast["data"].values()} == {True, False}
    masks = [{name.decode() for name in fast[f"mask/{mask}"][:]} for mask in ("train", "valid")]
    assert masks[0] | masks[1] == set(fast["data"]) and not masks[0] & masks[1] and masks[1]


def test_env_args_make_the_environment(fast: h5py.File) -> None:
    import gym_pusht  # noqa: F401
    import gymnasium

    args = json.loads(fast["data"].attrs["env_args"])
    env = gymnasium.make(args["env_name"], obs_type="pixels", **args["env_kwargs"])
    assert env.observation_space.shape == fast["data/demo_0/obs/image"].shape[1:]


@pytest.mark.parametrize("demo", range(EPISODES))
def test_environment_replays_the_recorded_actions(fast: h5py.File, demo: int) -> None:
    from gym_pusht.envs.pusht import PushTEnv

    states, actions = fast[f"data/demo_{demo}/states"][:], fast[f"data/demo_{demo}/actions"][:]
    env = PushTEnv(obs_type="state")
    env.reset(seed=0)
    env.agent.position = states[0, :2].tolist()
    env.block.angle = float(states[0, 4])
    env.block.position = states[0, 2:4].tolist()
    replayed, coverage = [env.get_obs()], [0.0]
    for action in actions.astype(np.float64):
        observation, _, _, _, info = env.step(action)
        replayed.append(observation)
        coverage.append(info["coverage"])
    np.testing.assert_allclose(np.stack(replayed[:-1]), states, atol=1e-3)
    assert (max(coverage) > env.success_threshold) == fast[f"data/demo_{demo}"].attrs["success"]


def test_noisy_episodes_hold_random_targets_in_their_share(tmp_path: Path) -> None:
    record_noisy(tmp_path / "noisy.hdf5", (0, 20), seed=3)  # episodes of shares 0.1 and 1
    with h5py.File(tmp_path / "noisy.hdf5") as file:
        calm, wild = (np.diff(file[f"data/demo_{n}/actions"][:], axis=0).any(axis=1) for n in range(2))
        assert [file[f"data/demo_{n}"].attrs["noise"] for n in range(2)] == [0.1, 1.0]
    assert not wild[
        np.arange(len(wild)) % STEPS_HELD != STEPS_HELD - 1
    ].any() and wild.mean() == pytest.approx(1 / STEPS_HELD, abs=0.02)
    assert calm.mean() > 0.5  # planned motion changes its target each step


def test_play_is_recorded_at_the_size_of_gym_pusht(tmp_path: Path) -> None:
    record_play(tmp_path / "play.hdf5", range(2), seed=3)
    with h5py.File(tmp_path / "play.hdf5") as file:
        demos = [file[f"data/demo_{number}"] for number in range(2)]
        assert [demo["obs/image"].shape[1:] for demo in demos] == [(96, 96, 3)] * 2
        assert [demo.attrs["start"] for demo in demos] == [*PLAY_STARTS[:2]]
        assert '"observation_width": 96' in file["data"].attrs["env_args"]


def test_the_table_is_that_of_gym_pusht() -> None:
    from gym_pusht.envs.pusht import PushTEnv

    rng = np.random.default_rng(0)
    env = PushTEnv(obs_type="pixels", observation_width=96, observation_height=96)
    for _ in range(4):
        state = np.array([*rng.uniform(60, 450, 2), *rng.uniform(200, 320, 2), rng.uniform(-np.pi, np.pi)])
        env.reset(options={"reset_to_state": state})
        table, touched = TeeTable(state), False
        for _ in range(12):
            picture, _, _, _, info = env.step(target := rng.uniform(100, 400, 2))
            table.advance(target, 10)
            np.testing.assert_array_equal(table.picture(96), picture)
            pose = [*table.agent.position, *table.block.position, table.block.angle]
            np.testing.assert_array_equal(pose, [*info["pos_agent"], *info["block_pose"]])
            assert table.coverage() == pytest.approx(info["coverage"], abs=1e-9)
            touched = touched or info["coverage"] > 0
        assert touched


@pytest.mark.slow
def test_any_mcap_reader_decodes_the_bags_by_their_own_schemas(slow: list[Path]) -> None:
    topics = bag(slow[0])
    with slow[0].open("rb") as file:
        reader = make_reader(file, decoder_factories=[DecoderFactory()])
        assert reader.get_header().profile == "ros2"
        decoded = [(channel.topic, item) for _, channel, _, item in reader.iter_decoded_messages()]
    commands = [item.twist.linear for topic, item in decoded if topic == "/command"]
    expected = [message.twist.linear for _, _, message in topics["/command"]]
    assert [(v.x, v.y, v.z) for v in commands] == [(v.x, v.y, v.z) for v in expected]
    assert len(decoded) == sum(map(len, topics.values()))


@pytest.mark.slow
def test_topics_tick_at_their_own_rates_with_jitter(slow: list[Path]) -> None:
    topics = bag(slow[1])
    for topic, hz in (("/camera/image/compressed", 12.5), ("/command", 5.0), ("/joint_states", 20.0)):
        stamps = np.array([stamp for stamp, _, _ in topics[topic]]) / 1e9
        assert np.median(np.diff(stamps)) == pytest.approx(1 / hz, abs=0.011)
        assert (len(stamps) - 1) / (stamps[-1] - stamps[0]) == pytest.approx(hz, rel=0.01)
        assert (np.std(np.diff(stamps)) > 1e-3) == (topic != "/joint_states")
        assert all(stamp < received for stamp, received, _ in topics[topic])


def test_raised_pusher_passes_over_the_tee_and_lowered_one_pushes_it() -> None:
    moved = {}
    for up in (True, False):
        world = arena()
        before, start = world.pose, world.agent
        world.lift(up)
        for share in np.linspace(0, 1, 40):
            world.advance(start + (before[:2] - start) * share * 1.2, 5)
        moved[up] = float(np.abs(world.pose - before).max())
    assert moved[True] < 1e-6 and moved[False] > 5


def test_pusher_does_not_come_down_onto_the_tee() -> None:
    world = arena()
    world.lift(True)
    world.advance(world.pose[:2], 300)
    world.lift(False)
    assert world.raised


@pytest.mark.parametrize("contact", [0, 9, 20, 33])
def test_planner_predicts_what_the_physics_do(contact: int) -> None:
    world = arena(seed=contact)
    pose, column = world.pose, 8
    turn = rotation(pose[2])
    start = world.tee.standoffs[contact] @ turn.T + pose[:2]
    inward = world.tee.contacts[1][contact] @ turn.T
    world.lift(True)
    world.advance(start, 300)
    world.lift(False)
    assert not world.raised
    for length in np.linspace(0, 11 + LENGTHS[column], 60):
        world.advance(start + inward * length, 10)
    world.advance(start + inward * length, 100)
    before, after = (world.tee.placed(p) for p in (pose, world.pose))
    home = world.tee.placed(world.goal)
    predicted = predicted_costs(world.tee, pose, world.goal)[contact, column]
    assert np.linalg.norm(after - before, axis=1).mean() > 5
    assert np.linalg.norm(after - home, axis=1).mean() == pytest.approx(predicted, abs=2.0)


@pytest.mark.slow
@pytest.mark.parametrize("robot", RECORDERS)
def test_same_seed_gives_same_bytes(tmp_path: Path, robot: str) -> None:
    for name, seed in (("a", 1), ("b", 1), ("c", 2)):
        if name < "c" or robot != "planar_arm_lerobot":  # AV1 takes long, and it is the arm of planar_arm
            record(robot, tmp_path / name, 1, seed)
    assert contents(tmp_path / "a") == contents(tmp_path / "b") != contents(tmp_path / "c")


def test_progress_counts_episodes(tmp_path: Path) -> None:
    seen: list[tuple[int, int]] = []
    record("planar_arm", tmp_path, 2, on_progress=lambda done, total: seen.append((done, total)))
    assert seen == [(1, 2), (2, 2)]


@pytest.mark.parametrize(
    "robot",
    [pytest.param(robot, marks=pytest.mark.slow if "lerobot" in robot else ()) for robot in RECORDERS],
)
def test_failing_midway_leaves_nothing(tmp_path: Path, robot: str) -> None:
    def stop(done: int, total: int) -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        record(robot, tmp_path, 2, on_progress=stop)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(
    ("robot", "folder", "episodes", "fault", "said"),
    [
        ("pusht_slow", "taken", 1, OutputError, "exists already"),
        ("pusht_fast", "file/inside", 1, OutputError, "cannot be written"),
        ("pusht_medium", "free", 1, UsageError, "pusht_fast, pusht_slow"),
        ("pusht_fast", "free", 0, UsageError, "0 asked for"),
    ],
)
def test_what_cannot_be_recorded_is_refused(tmp_path, robot, folder, episodes, fault, said) -> None:
    (tmp_path / "taken/pusht_slow").mkdir(parents=True)
    (tmp_path / "file").write_text("")
    with pytest.raises(fault, match=said):
        record(robot, tmp_path / folder, episodes)


@pytest.mark.slow
def test_bags_tell_how_their_episodes_end(slow: list[Path]) -> None:
    folder, robot, source = str(slow[0].parent), find("pusht_slow"), open_source("rosbag")
    told = [source.read(folder, name, robot).success for name in source.episode_ids(folder)]
    written = []
    for path in slow:
        with path.open("rb") as file:
            notes = {record.name: record.metadata for record in make_reader(file).iter_metadata()}
        written.append(notes["episode"]["success"] == "true")
    assert told == written and set(told) == {True, False}
