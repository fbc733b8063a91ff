"""Make policies from the words of a command: scripted, random, still, a function, one of lerobot, a model.

A policy acts in N scenes at once. `Arena` gives it the newest pictures, and to those that ask for it a state.

N scenes, S pixels a side, A action dims, S' values of a state.
"""

import copy
import importlib
import sys
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, runtime_checkable

import numpy as np

from hma_data.errors import HMAError, UsageError
from hma_data.lab import FAMILY
from hma_data.lab.scripted import driver, reacher, steerable
from hma_model.simulate.arenas import Arena, Floats, Scenes

if TYPE_CHECKING:
    from hma_model.evaluation.judge import StateJudge
    from hma_model.simulate.world import World

WAYS = (
    "give scripted, scripted:noise=0.5, reach, random, still, hma:CHECKPOINT, plan:cem, "
    "lerobot:FOLDER_OR_REPO, or MODULE:NAME of a Python function or class"
)


class Policy(Protocol):
    """A policy in N scenes."""

    def begin(self, arena: Arena) -> None:
        """Begin episodes in all scenes."""

    def act(self, arena: Arena) -> Floats:
        """Return the next commands (N, A)."""


@runtime_checkable
class Judged(Protocol):
    """A policy that needs the judge of its success, and gets it before it begins."""

    def judged(self, judge: "StateJudge") -> None:
        """Take the judge."""


def read_policy(words: str, scenes: Scenes, world: "World | None" = None) -> Policy:
    """Return the policy of words such as `scripted:noise=0.5`, for the robot of scenes.

    Args:
        words: as `hma policy-eval` takes them.
        scenes: in which it is to act.
        world: for policies that plan; networks act on its device.

    Raises:
        HMAError: there is no such policy, or it does not fit the robot.
    """
    device = "cpu" if world is None else str(world.model.device)
    kind, _, rest = words.partition(":")
    if kind == "lerobot" and rest:
        from hma_model.simulate.lerobot_policy import LeRobotPolicy

        return LeRobotPolicy(rest, scenes, device)
    if kind == "hma" and rest:
        from hma_model.simulate.acting import read_acting

        return read_acting(rest, scenes, device)
    if kind == "plan" and rest:
        from hma_model.simulate.planning import read_planning

        return read_planning(rest, scenes, world)
    if words in ("random", "still"):
        return Random() if words == "random" else Still()
    if kind in ("scripted", "reach"):
        if kind == "reach" and not FAMILY.fullmatch(scenes.name):
            raise UsageError("policy reach", f"{scenes.name} has no driver that reaches", "give scripted")
        return Scripted(_noise(words, kind, rest), kind == "reach")
    if rest:
        return Called(_named(words), f"policy {words}")
    raise UsageError("policy", f"{words!r} is unknown", WAYS)


def split_options(kind: str, words: str, known: Mapping[str, type]) -> tuple[str, dict[str, Any]]:
    """Return what comes before the options in `WHAT,horizon=2,…`, and the options that are given.

    Raises:
        UsageError: an option is unknown, or its value is not of the type that `known` tells.
    """
    what, *parts = words.split(",")
    while parts and "=" not in parts[0]:
        what = f"{what},{parts.pop(0)}"  # a comma of a path
    options = {}
    for part in parts:
        name, _, value = part.partition("=")
        try:
            options[name] = known[name](value)
        except (KeyError, ValueError):
            allowed = ", ".join(
                f"{key}={'N' if type is int else type.__name__}" for key, type in known.items()
            )
            raise UsageError(
                f"policy {kind}:{words}", f"{part!r} is unknown", f"allowed: {allowed}"
            ) from None
    return what, options


def _noise(words: str, kind: str, rest: str) -> float:
    name, _, value = rest.partition("=")
    try:
        share = float(value) if rest else 0.0
    except ValueError:
        share = np.nan
    if (rest and name != "noise") or not 0 <= share <= 1:
        raise UsageError("policy", f"{words!r} is unknown", f"give {kind}:noise=SHARE, from 0 to 1")
    return share


def _named(words: str) -> Any:
    """Return the object that MODULE:NAME names; modules of the working folder are found."""
    module, _, name = words.partition(":")
    sys.path.insert(0, str(Path.cwd()))
    try:
        found: Any = importlib.import_module(module)
        for part in name.split("."):
            found = getattr(found, part)
    except Exception as fault:
        remedy = WAYS
        if isinstance(fault, ModuleNotFoundError) and fault.name == module.partition(".")[0]:
            remedy = f"run hma in the folder of {fault.name}.py, or install its package"
        raise HMAError(
            f"policy {words}", f"cannot be imported: {type(fault).__name__}: {fault}", remedy
        ) from fault
    finally:
        sys.path.pop(0)
    return found


class Still:
    """The commands that leave the robot as it is: no velocity, or the last target."""

    def begin(self, arena: Arena) -> None:
        pass

    def act(self, arena: Arena) -> Floats:
        return arena.held


class Random:
    """A uniform command in the range of training, another one for each chunk."""

    def begin(self, arena: Arena) -> None:
        self._rng = arena.scenes.rng(1)
        self._low, self._high = (
            np.array([getattr(dim, end) for dim in arena.scenes.dimensions]) for end in ("low", "high")
        )

    def act(self, arena: Arena) -> Floats:
        if arena.fresh:
            drawn = [rng.uniform(self._low, self._high) for rng in self._rng]
            self._command = np.stack(drawn).astype(np.float32)
        return self._command


class Scripted:
    """The manoeuvres of the recorder, or a reach for the nearest block; a share of the chunks is random.

    They go by the robot's state: in the simulator by the true one, in the model by what a probe reads off its
    pictures. Robots of which no state can be read so are driven by the simulator's own driver, and in the
    model its commands are replayed.

    Args:
        noise: the share of chunks with random commands.
        reach: go to the nearest block, rather than by random manoeuvres.
    """

    def __init__(self, noise: float = 0.0, reach: bool = False) -> None:
        self.noise, self.reach, self._random = noise, reach, Random()

    def begin(self, arena: Arena) -> None:
        self._random.begin(arena)
        self._coins = arena.scenes.rng(2)
        self._drivers: list[Callable[..., Floats]] = []
        if self.reach:
            self._drivers = [reacher(arena.scenes.name) for _ in arena.pictures]
        elif steerable(arena.scenes.name):
            begun = zip(arena.states(), arena.scenes.rng(3), strict=True)
            self._drivers = [driver(arena.scenes.name, state.pose, rng) for state, rng in begun]

    def act(self, arena: Arena) -> Floats:
        noisy = self._random.act(arena)
        if arena.fresh:
            self._thrown = np.array([coin.random() < self.noise for coin in self._coins])[:, None]
        if self._drivers:
            pairs = zip(self._drivers, arena.states(), strict=True)
            commands = np.stack([drive(state) for drive, state in pairs])
        else:
            commands = arena.recorded()
        return np.where(self._thrown, noisy, commands).astype(np.float32)


class Called:
    """A Python function from a picture (S, S, 3) to a command (A,), or a class or object of such.

    Each scene has its own: an instance of a class, or a copy of an object, so that what it remembers belongs
    to one episode. Its `reset()`, if there is one, is called when an episode begins.
    """

    def __init__(self, given: Any, where: str = "policy") -> None:
        if not callable(given):
            raise UsageError(where, f"is {given!r}, which cannot be called", "name a function or class")
        self._given = given

    def begin(self, arena: Arena) -> None:
        made = (
            self._given() if isinstance(self._given, type) else copy.deepcopy(self._given)
            for _ in arena.pictures
        )
        self._functions = list(made)
        for function in self._functions:
            if hasattr(function, "reset"):
                function.reset()

    def act(self, arena: Arena) -> Floats:
        pairs = zip(self._functions, arena.pictures, strict=True)
        commands = [np.asarray(function(picture.copy())) for function, picture in pairs]
        shapes = {command.shape for command in commands}
        if len(shapes) > 1:
            raise ValueError(f"it returned commands of the shapes {shapes}")
        return np.stack(commands)


def begin(name: str, policy: Policy, arena: Arena) -> None:
    """Begin a policy's episodes; an HMAError names the policy if it raises."""
    with _named_errors(name):
        policy.begin(arena)


def checked(name: str, policy: Policy, arena: Arena) -> Floats:
    """Return the next commands (N, A) of a policy.

    Raises:
        HMAError: it raises, or returns another shape or values that are not finite.
    """
    where, width = f"policy {name}", len(arena.scenes.dimensions)
    with _named_errors(name):
        commands = np.asarray(policy.act(arena), np.float32)
    if commands.shape != (len(arena.pictures), width):
        names = ", ".join(dim.name for dim in arena.scenes.dimensions)
        fault = f"returns commands of the shape {commands.shape[1:]}"
        raise HMAError(where, fault, f"{arena.scenes.name} takes ({width},): {names}")
    if not np.isfinite(commands).all():
        raise HMAError(
            where, "returns NaN or infinite values", "return a number for each value of the command"
        )
    return commands


@contextmanager
def _named_errors(name: str) -> Iterator[None]:
    try:
        yield
    except HMAError:
        raise
    except Exception as fault:
        remedy = "mend it; --debug shows where it happened"
        raise HMAError(f"policy {name}", f"raised {type(fault).__name__}: {fault}", remedy) from fault
