"""Record a third-party simulator: scripted, noised, random episodes, and copies under perturbed actions.

A recipe (recipes/lab/*.py) describes its simulator as a `Simulator` and calls `main`. Each episode is kept in
a file of its own until all are there, so that a recording that was stopped continues at the next episode;
then they are written in the format of the robot's embodiment, with its keys. Every format also gets the
task in words, what the simulator calls a success, and how the episode was made: its seed, number, style and
copy.

Of ten episodes, six are driven by the simulator's scripted expert, two by the expert with smooth noise on its
actions, and two by smooth random actions. Copy k of an episode begins in the same state; its actions are
the recorded ones with k times the noise, whatever happens to the robot. Copies are a recording of their own,
so that a model can be asked about actions that none of its training episodes had.

An episode depends on its seed and number alone, and so do its frames, on one machine.

T frames, H×W pixels, A values of an action, S of the robot's state, O of the objects' places.
"""

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hma_data.console import human_bytes, human_seconds, interruptible, progress
from hma_data.errors import HMAError, MissingDependencyError, OutputError, UsageError
from hma_data.lab.writers import (
    Demo,
    Message,
    RldsEpisode,
    ros_value,
    write_hdf5,
    write_mcap,
    write_rlds,
)
from hma_data.registry.embodiment import Embodiment, find
from hma_data.sources.lerobot.writer import LeRobotEpisode, write_lerobot
from hma_data.storage.files import atomic_path

Floats = NDArray[np.float64]

STYLES = ("scripted", "scripted", "noised", "scripted", "random") * 2  # of ten episodes
CONTEXT = """
import os, sys, mujoco
try:
    mujoco.GLContext(16, 16).make_current()
except Exception as fault:
    print(" ".join(str(fault).split()), file=sys.stderr, flush=True)
    os._exit(1)
os._exit(0)
"""  # without the exits MuJoCo would add to what it said
EPOCH_NS = 1_700_000_000_000_000_000  # start of the first bag's stamps; episodes are a minute apart
MEMORY_S = 0.4  # time in which smooth noise forgets its value


class Simulator(Protocol):
    """A third-party simulator with one robot and one camera.

    Attributes:
        robot: id of the embodiment.
        low, high: (A,) limits of an action.
        noise: (A,) standard deviations of the smooth noise on the expert's actions.
        centre, spread: (A,) mean and standard deviations of smooth random actions.
        least, steps: fewest and most frames of an episode.
        rest: frames recorded after the first success.
    """

    robot: str
    low: Floats
    high: Floats
    noise: Floats
    centre: Floats
    spread: Floats
    least: int
    steps: int
    rest: int

    def reset(self, seed: int) -> str:
        """Begin the scene of a seed, the same for the same seed, and return its task in words."""

    def observe(self) -> tuple[NDArray[np.uint8], Floats, Floats]:
        """Return the frame (H, W, 3) RGB, the robot's state (S,) and the objects' places (O,)."""

    def expert(self) -> Floats:
        """Return the scripted expert's next action (A,)."""

    def step(self, action: NDArray[np.float32], /) -> bool:
        """Simulate one control step under an action (A,); return whether the simulator calls it a success."""


@dataclass(frozen=True)
class Recorded:
    """One episode of T frames."""

    number: int
    copy: int  # 0 for the original, k for its copy under k times the noise
    seed: int
    style: str  # scripted, noised or random; of a copy, that of the original
    task: str  # in words
    pictures: NDArray[np.uint8]  # (T, H, W, 3) RGB
    states: NDArray[np.float64]  # (T, S), seen with the frame
    objects: NDArray[np.float64]  # (T, O), seen with the frame
    commands: NDArray[np.float32]  # (T, A), in force from the frame to the next
    done: NDArray[np.bool_]  # (T,), whether the simulator calls it a success after the action

    @classmethod
    def load(cls, path: Path) -> "Recorded":
        """Read an episode that was stored with numpy's savez."""
        with np.load(path) as stored:
            return cls(**{key: values if values.ndim else values.item() for key, values in stored.items()})

    @property
    def success(self) -> bool:
        """Return whether the simulator called it a success at some frame."""
        return bool(self.done.any())

    @property
    def facts(self) -> dict[str, str | int]:
        """Return how the episode was made; `copy_of` only for a copy."""
        facts: dict[str, str | int] = {"style": self.style, "seed": self.seed, "episode": self.number}
        return facts | ({"copy_of": self.number, "perturbed": self.copy} if self.copy else {})


def record_episode(simulator: Simulator, seed: int, number: int) -> Recorded:
    """Record an episode; its number decides the style."""
    style = STYLES[number % len(STYLES)]
    wander = _smooth(simulator, (seed, number, 0))

    def policy(step: int) -> Floats:
        if style == "random":
            return simulator.centre + simulator.spread * next(wander)
        return simulator.expert() + (simulator.noise * next(wander) if style == "noised" else 0.0)

    return _run(simulator, seed, number, style, policy, simulator.least, simulator.steps)


def record_copy(simulator: Simulator, seed: int, original: Recorded, copy: int) -> Recorded:
    """Record a copy of an episode: the same beginning, its actions with `copy` times the smooth noise."""
    wander, given = _smooth(simulator, (seed, original.number, copy)), original.commands

    def policy(step: int) -> Floats:
        return given[step] + copy * simulator.noise * next(wander)

    number, style, frames = original.number, original.style, len(original.commands)
    episode = _run(simulator, seed, number, style, policy, frames, frames)
    return replace(episode, copy=copy)


def _run(
    simulator: Simulator,
    seed: int,
    number: int,
    style: str,
    policy: Callable[[int], Floats],
    least: int,
    stop: int,
) -> Recorded:
    task = simulator.reset(int(np.random.SeedSequence((seed, number)).generate_state(1)[0] >> 1))
    rows: list[tuple[Any, ...]] = []
    done: list[bool] = []
    while len(rows) < stop:
        seen = simulator.observe()
        action = np.clip(policy(len(rows)), simulator.low, simulator.high).astype(np.float32)
        rows.append((*seen, action))
        done.append(simulator.step(action))
        if done[-1] and not any(done[:-1]):
            stop = min(stop, max(least, len(rows) + simulator.rest))
    pictures, states, objects, commands = map(np.stack, zip(*rows, strict=True))
    return Recorded(number, 0, seed, style, task, pictures, states, objects, commands, np.array(done))


def _smooth(simulator: Simulator, seed: Sequence[int]) -> Iterator[Floats]:
    """Yield values (A,) of standard deviation 1 that forget themselves in MEMORY_S; they begin near zero."""
    rng, value = np.random.default_rng(seed), np.zeros(len(simulator.low))
    keep = float(np.exp(-1 / (find(simulator.robot).rate_hz * MEMORY_S)))
    while True:
        value = keep * value + np.sqrt(1 - keep**2) * rng.normal(size=len(value))
        yield value


# -- a recording


def record_simulator(
    simulator: Simulator, out: Path, episodes: int, seed: int = 0, perturb: int = 0
) -> list[Path]:
    """Record a simulator, with progress on standard error; the same call continues after a stop.

    Args:
        simulator: what to record.
        out: folder to put the recordings in; made if it does not exist.
        episodes: number of episodes, at least one.
        seed: the same seed gives the same actions and frames.
        perturb: number of perturbed copies of each episode.

    Returns:
        The recordings, which `hma convert --source` takes: that of the episodes, then that of their copies.

    Raises:
        UsageError: fewer than one episode was requested.
        OutputError: the recordings are already there, or cannot be written.
        Interrupted: the user pressed Ctrl-C.
    """
    if episodes < 1:
        raise UsageError("episodes", f"{episodes} asked for", "ask for at least one")
    if out.is_file():
        raise OutputError(out, "is a file, not a folder", "name another folder")
    embodiment = find(simulator.robot)
    write, ending = WRITERS[embodiment.source.format]
    finals = [out / f"{embodiment.id}{ending}"]
    if perturb:
        finals.append(out / f"{embodiment.id}_perturbed{ending}")
    if all(final.exists() for final in finals):
        raise OutputError(finals[-1], "exists already", "remove it or record into another folder")
    kept = out / f".{embodiment.id}-{seed}.episodes"
    files = list(_record_all(simulator, kept, episodes, seed, perturb))
    for final, own in zip(finals, ([f for f, k in files if not k], [f for f, k in files if k]), strict=False):
        if not final.exists():
            with atomic_path(final) as part:
                write(part, embodiment, map(Recorded.load, own))
    shutil.rmtree(kept)
    return finals


def _record_all(
    simulator: Simulator, kept: Path, episodes: int, seed: int, perturb: int
) -> Iterator[tuple[Path, int]]:
    """Record what is missing in the folder `kept`; yield the file of each episode and which copy it is."""
    total, done = episodes * (1 + perturb), len(list(kept.glob("*.npz")))

    def words() -> str:
        there = len(list(kept.glob("*.npz")))
        return f"{there} of {total} episodes are kept; the same command continues"

    successes = 0
    with interruptible(words), progress(simulator.robot, total, "episodes") as update:
        update(done)
        for number in range(episodes):
            original = _kept(kept / f"{number:05d}-0.npz", partial(record_episode, simulator, seed, number))
            successes += original.success
            yield kept / f"{number:05d}-0.npz", 0
            for copy in range(1, perturb + 1):
                file = kept / f"{number:05d}-{copy}.npz"
                if not file.exists():
                    _kept(file, partial(record_copy, simulator, seed, original, copy))
                yield file, copy
            done = max(done, (number + 1) * (1 + perturb))
            update(min(done, total), f"{successes} of {number + 1} succeeded")


def _kept(file: Path, make: Callable[[], Recorded]) -> Recorded:
    """Return the episode of a file, which is made first if it is not there."""
    if file.exists():
        return Recorded.load(file)
    episode = make()
    with atomic_path(file) as part, part.open("wb") as target:
        np.savez(target, **asdict(episode))
    return episode


# -- formats


def as_hdf5(path: Path, embodiment: Embodiment, episodes: Iterable[Recorded]) -> None:
    """Write one file in robomimic's layout; the objects' places are `obs/objects`."""
    assert embodiment.state
    image, state = (
        key.removeprefix("obs/") for key in (embodiment.cameras[0].key, embodiment.state.components[0].key)
    )

    def demos() -> Iterator[Demo]:
        for episode in episodes:
            yield Demo(
                actions=episode.commands,
                observations={image: episode.pictures, state: episode.states, "objects": episode.objects},
                states=np.concatenate([episode.states, episode.objects], axis=1),
                rewards=episode.done.astype(np.float64),
                success=episode.success,
                facts=episode.facts | {"language_instruction": episode.task},
            )

    kwargs = {"control_freq": embodiment.rate_hz}
    write_hdf5(path, demos(), {"env_name": embodiment.id, "type": 2, "env_kwargs": kwargs})


def as_rlds(path: Path, embodiment: Embodiment, episodes: Iterable[Recorded]) -> None:
    """Write a TFDS folder with PNG frames; success and facts are `episode_metadata`."""
    camera = embodiment.cameras[0]
    assert camera.size and embodiment.state
    action, state = embodiment.action.components[0].key, embodiment.state.components[0].key

    def steps() -> Iterator[RldsEpisode]:
        for episode in episodes:
            vectors = {
                action: episode.commands,
                state: episode.states.astype(np.float32),
                "observation/objects": episode.objects.astype(np.float32),
            }
            facts = {"success": episode.success, **episode.facts}
            yield RldsEpisode({camera.key: list(map(_png, episode.pictures))}, vectors, episode.task, facts)

    write_rlds(path, embodiment.id, {camera.key: camera.size}, "png", steps())


def as_lerobot(path: Path, embodiment: Embodiment, episodes: Iterable[Recorded]) -> None:
    """Write a LeRobotDataset; its metadata has no place for how an episode was made."""
    key = embodiment.cameras[0].key
    rows = (
        LeRobotEpisode(
            {key: episode.pictures},
            episode.commands,
            episode.states.astype(np.float32),
            episode.task,
            {
                "observation.environment_state": episode.objects.astype(np.float32),
                "next.success": episode.done[:, None],
            },
        )
        for episode in episodes
    )
    write_lerobot(path, embodiment, rows)


def as_bags(path: Path, embodiment: Embodiment, episodes: Iterable[Recorded]) -> None:
    """Write a folder of MCAP files, one an episode, for an arm that is moved by steps of its hand.

    The camera's topic is the embodiment's. /servo/command has the steps x, y, z, /gripper/command the last
    value, /joint_states the state and /objects the places. An action is stamped 2 to 8 ms after its frame,
    when a controller would have computed it.
    """
    path.mkdir()
    for episode in episodes:
        rng = np.random.default_rng((episode.seed, episode.number, episode.copy))
        start, period = EPOCH_NS + episode.number * 60_000_000_000, round(1e9 / embodiment.rate_hz)
        messages = [
            message
            for row in range(len(episode.commands))
            for message in _messages(embodiment, episode, row, start + row * period, rng)
        ]
        facts = {key: str(value) for key, value in episode.facts.items()}
        facts |= {
            "robot": embodiment.id,
            "success": str(episode.success).lower(),
            "instruction": episode.task,
        }
        name = f"episode_{episode.number:04d}" + (f"_copy_{episode.copy}" if episode.copy else "")
        write_mcap(path / f"{name}.mcap", messages, facts)


def _messages(
    embodiment: Embodiment, episode: Recorded, row: int, stamp: int, rng: np.random.Generator
) -> Iterator[Message]:
    """Yield the messages of one row; each is received up to 2 ms after its stamp, frames 12 to 20 ms."""
    action, computed = episode.commands[row].tolist(), stamp + int(rng.integers(2_000_000, 8_000_000))
    vector = "geometry_msgs/msg/Vector3"
    linear, turn = ros_value(vector, *action[:3]), ros_value(vector, 0.0, 0.0, 0.0)
    picture = {"format": "png", "data": np.frombuffer(_png(episode.pictures[row]), np.uint8)}
    image, twist = "sensor_msgs/msg/CompressedImage", "geometry_msgs/msg/TwistStamped"
    moved = {"twist": ros_value("geometry_msgs/msg/Twist", linear=linear, angular=turn)}
    assert embodiment.state
    names = list(embodiment.state.names())
    places = [f"object_{axis}" for axis in range(episode.objects.shape[1])]

    def joints(topic: str, at: int, names: list[str], values: Any) -> Message:
        fields = {"name": names, "position": np.asarray(values, np.float64)}
        fields |= {"velocity": np.empty(0), "effort": np.empty(0)}
        received = at + int(rng.integers(500_000, 2_000_000))
        return Message(topic, at, received, "sensor_msgs/msg/JointState", "base", fields)

    shown = stamp + int(rng.integers(12_000_000, 20_000_000))
    yield Message(embodiment.cameras[0].key, stamp, shown, image, "camera", picture)
    yield joints("/joint_states", stamp, names, episode.states[row])
    yield joints("/objects", stamp, places, episode.objects[row])
    received = computed + int(rng.integers(500_000, 2_000_000))
    yield Message("/servo/command", computed, received, twist, "base", moved)
    yield joints("/gripper/command", computed, ["gripper"], action[3:])


def _png(picture: NDArray[np.uint8]) -> bytes:
    import cv2

    _, data = cv2.imencode(".png", picture[..., ::-1])
    return bytes(data)


WRITERS = {
    "hdf5": (as_hdf5, ".hdf5"),
    "rlds": (as_rlds, ""),
    "lerobot": (as_lerobot, ""),
    "rosbag": (as_bags, ""),
}


# -- the command line of a recipe


def main(start: Callable[[], Simulator], description: str | None) -> None:
    """Record a simulator as the command line asks, print the recordings, and exit.

    Args:
        start: makes the simulator; its packages are imported there.
        description: the recipe's docstring.
    """
    parser = argparse.ArgumentParser(
        description=description, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("out", type=Path, help="folder of the recordings")
    parser.add_argument("--episodes", type=int, default=40)
    parser.add_argument("--seed", type=int, default=0, help="the same seed gives the same episodes")
    parser.add_argument(
        "--perturb", type=int, default=0, metavar="K", help="perturbed copies of each episode"
    )
    given = parser.parse_args()
    begun = time.monotonic()
    try:
        with _drawing():
            simulator = start()
        for final in record_simulator(simulator, given.out, given.episodes, given.seed, given.perturb):
            print(f"{final}: {human_bytes(_size(final))}, after {human_seconds(time.monotonic() - begun)}")
    except HMAError as fault:
        print(f"error: {fault}", file=sys.stderr)
        sys.exit(fault.exit_code)


@contextmanager
def _drawing() -> Iterator[None]:
    """Let MuJoCo draw without a display, by EGL unless $MUJOCO_GL names another way.

    Raises:
        MissingDependencyError: a package or a library of OpenGL is missing.
    """
    if sys.platform == "linux":
        os.environ.setdefault("MUJOCO_GL", "egl")
        if find_spec("mujoco"):
            _require_opengl()
    try:
        yield
    except ImportError as fault:
        remedy = "start the recipe by `uv run`, which installs what its first lines name"
        raise MissingDependencyError(
            fault.name or "a package", f"cannot be imported: {fault}", remedy
        ) from fault


def _require_opengl() -> None:
    """Make a context of OpenGL as MuJoCo does; where that fails, each simulator fails in its own way later.

    It is made in a process of its own, because a context that is made twice, or half, complains at the exit.

    Raises:
        MissingDependencyError: the library that $MUJOCO_GL names is missing, or finds no driver.
    """
    tried = subprocess.run([sys.executable, "-c", CONTEXT], capture_output=True, text=True)
    if tried.returncode:
        reason = tried.stderr.strip().splitlines()[-1] if tried.stderr.strip() else "it was killed"
        remedy = (
            "on Debian and Ubuntu: apt-get install libegl1 libgl1-mesa-dri, and leave MUJOCO_GL unset; or "
            "apt-get install libosmesa6, and set MUJOCO_GL=osmesa"
        )
        raise MissingDependencyError(f"MUJOCO_GL={os.environ['MUJOCO_GL']}", f"cannot draw: {reason}", remedy)


def _size(path: Path) -> int:
    files = path.rglob("*") if path.is_dir() else [path]
    return sum(file.stat().st_size for file in files if file.is_file())
