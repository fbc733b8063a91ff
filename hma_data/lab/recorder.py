"""Record a third-party simulator: scripted, noised, random episodes, and copies under perturbed commands.

A recipe (recipes/lab/*.py) describes its simulator as a `Simulator` and calls `main`. Each episode is kept in
a file of its own until all are there, so that a recording that was stopped continues at the next episode;
then `hma_data.lab.formats` writes them in the format of the robot's embodiment.

Of ten episodes, six are driven by the simulator's scripted expert, two by the expert with smooth noise on its
commands, and two by smooth random commands. Copy k of an episode begins in the same state; its commands are
the recorded ones with k times the noise, whatever happens to the robot. Copies are a recording of their own,
so that a model can be asked about commands that none of its training episodes had.

An episode depends on its seed and number alone, and so do its pictures, on one machine.

T frames, H×W pixels, A values of a command, S of the robot's state, O of the objects' places.
"""

import argparse
import os
import shutil
import subprocess
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, replace
from functools import partial
from importlib.util import find_spec
from pathlib import Path
from typing import Any, Protocol

import numpy as np
from numpy.typing import NDArray

from hma_data.console import human_bytes, human_seconds, interruptible, progress
from hma_data.errors import HMAError, MissingDependencyError, OutputError, UsageError
from hma_data.lab import whole
from hma_data.lab.formats import WRITERS, Recorded
from hma_data.registry.embodiment import find
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
MEMORY_S = 0.4  # time in which smooth noise forgets its value


class Simulator(Protocol):
    """A third-party simulator with one robot and one camera.

    Attributes:
        robot: id of the embodiment.
        low, high: (A,) limits of a command.
        noise: (A,) standard deviations of the smooth noise on the expert's commands.
        centre, spread: (A,) mean and standard deviations of smooth random commands.
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
        """Return the picture (H, W, 3) RGB, the robot's state (S,) and the objects' places (O,)."""

    def expert(self) -> Floats:
        """Return the scripted expert's next command (A,)."""

    def step(self, command: NDArray[np.float32], /) -> bool:
        """Simulate one control step under a command (A,); return whether the simulator calls it a success."""


def record_episode(simulator: Simulator, seed: int, number: int) -> Recorded:
    """Record an episode; its number decides the style."""
    style = STYLES[number % len(STYLES)]
    wander = _smooth(simulator, (seed, number, 0))

    def command(step: int) -> Floats:
        if style == "random":
            return simulator.centre + simulator.spread * next(wander)
        return simulator.expert() + (simulator.noise * next(wander) if style == "noised" else 0.0)

    return _run(simulator, seed, number, style, command, simulator.least, simulator.steps)


def record_copy(simulator: Simulator, seed: int, original: Recorded, copy: int) -> Recorded:
    """Record a copy of an episode: the same beginning, its commands with `copy` times the smooth noise."""
    wander, given = _smooth(simulator, (seed, original.number, copy)), original.commands

    def command(step: int) -> Floats:
        return given[step] + copy * simulator.noise * next(wander)

    number, style, frames = original.number, original.style, len(original.commands)
    episode = _run(simulator, seed, number, style, command, frames, frames)
    return replace(episode, copy=copy)


def _run(
    simulator: Simulator,
    seed: int,
    number: int,
    style: str,
    command: Callable[[int], Floats],
    least: int,
    stop: int,
) -> Recorded:
    task = simulator.reset(int(np.random.SeedSequence((seed, number)).generate_state(1)[0] >> 1))
    rows: list[tuple[Any, ...]] = []
    done: list[bool] = []
    while len(rows) < stop:
        seen = simulator.observe()
        action = np.clip(command(len(rows)), simulator.low, simulator.high).astype(np.float32)
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
        seed: the same seed gives the same commands and pictures.
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
            with whole(final) as part:
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


# -- the command of a recipe


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
