"""Record simulators as if they were robots, for the demo, tests and experiments.

A recorder is a module with `record(part, robot, episodes, seed)`, which writes the episodes of those numbers
to the path `part`; it is imported on use. Every robot of RECORDERS has its embodiment in the registry under
the same id. The made-up robots of `hma_data.lab.family` are without number; `family.embodiment` describes
those that are not in the registry.
"""

import os
import re
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from importlib import import_module
from pathlib import Path

from hma_data.errors import MissingDependencyError, OutputError, UsageError, install_command
from hma_data.storage.files import atomic_path
from hma_data.storage.paths import StrPath, as_path

Progress = Callable[[int, int], None]

RECORDERS = {  # robot -> its module, and the name of its recording
    "pusht_fast": ("hma_data.lab.pusht", "pusht_fast.hdf5"),
    "pusht_slow": ("hma_data.lab.pusht", "pusht_slow"),
    "pendulum": ("hma_data.lab.pendulum", "pendulum"),
    "planar_arm": ("hma_data.lab.planar_arm", "planar_arm.hdf5"),
    "planar_arm_lerobot": ("hma_data.lab.planar_arm", "planar_arm_lerobot"),
    "arm3_55": ("hma_data.lab.family", "arm3_55.hdf5"),
    "mover_52": ("hma_data.lab.family", "mover_52"),
}
FAMILY = re.compile(r"(arm[1-4]|mover|gantry|rails|crane)_\d+")


def record(
    robot: str, out: StrPath, episodes: int, seed: int = 0, on_progress: Progress | None = None
) -> Path:
    """Record a laboratory robot.

    Args:
        robot: a key of RECORDERS, or a name of the family, such as arm2_07.
        out: str or path of the folder to put the recording in; made if it does not exist.
        episodes: number of episodes, at least one.
        seed: the same seed gives the same bytes.
        on_progress: called after each episode with (episodes done, episodes in all).

    Returns:
        The path of the recording, which `hma convert --source` takes.

    Raises:
        UsageError: there is no such robot, or fewer than one episode was requested.
        OutputError: the recording is already there, or cannot be written.
        MissingDependencyError: the simulator, or the writer of the format, is not installed.
    """
    if robot not in RECORDERS and not FAMILY.fullmatch(robot):
        raise UsageError(
            robot, "is not one of the toolkit's simulated robots", f"known: {', '.join(RECORDERS)}"
        )
    if episodes < 1:
        raise UsageError("episodes", f"{episodes} asked for", "ask for at least one")
    module, name = RECORDERS.get(robot, ("hma_data.lab.family", f"{robot}.hdf5"))
    final = as_path(out) / name
    if final.exists():
        raise OutputError(final, "exists already", "remove it or record into another folder")
    with atomic_path(final) as part:
        import_module(module).record(part, robot, _counted(episodes, on_progress), seed)
    return final


def _counted(episodes: int, on_progress: Progress | None) -> Iterator[int]:
    """Yield the number of each episode, and report it when the next one is asked for."""
    for episode in range(episodes):
        yield episode
        if on_progress:
            on_progress(episode + 1, episodes)


@contextmanager
def imported(package: str) -> Iterator[None]:
    """Import a third-party package, without pygame's greeting and the warnings that imports make.

    Raises:
        MissingDependencyError: it cannot be imported.
    """
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)
            yield
    except ImportError as fault:
        raise MissingDependencyError(package, f"cannot be imported: {fault}", install_command()) from fault
