"""Make policies from the words of a command: scripted, random, still, a function, one of lerobot, a model."""

import pkgutil
import re
import sys
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.errors import HMAError, UsageError
from hma_data.lab import FAMILY
from hma_model.policies import acting, planning
from hma_model.policies.acting import read_acting
from hma_model.policies.arenas import Scenes
from hma_model.policies.base import Policy, split_options
from hma_model.policies.lerobot import LeRobotPolicy
from hma_model.policies.planning import Planning, read_planning
from hma_model.policies.scripted import Called, Random, Scripted, Still
from hma_model.worlds.world import World

POLICY_FORMS = (
    "give scripted, scripted:noise=0.5, reach, random, still, hma:CHECKPOINT, plan:cem, "
    "lerobot:FOLDER_OR_REPO, or MODULE:NAME of a Python function or class"
)


def read_policy(words: str | tuple[str, Policy], scenes: Scenes, world: World | None = None) -> Policy:
    """Return the policy of words such as `scripted:noise=0.5`, for the robot of scenes.

    Args:
        words: as `hma policy-eval` takes them; of a name and a policy, the policy is returned.
        scenes: in which it is to act.
        world: for policies that plan; networks act on its device.

    Raises:
        HMAError: there is no such policy, or it does not fit the robot.
    """
    if not isinstance(words, str):
        return words[1]
    device = "cpu" if world is None else str(world.model.device)
    kind, _, rest = words.partition(":")
    if kind == "lerobot" and rest:
        return LeRobotPolicy(rest, scenes, device)
    if kind == "hma" and rest:
        return read_acting(rest, scenes, device)
    if kind == "plan" and rest:
        return read_planning(rest, scenes, world)
    if words in ("random", "still"):
        return Random() if words == "random" else Still()
    if kind in ("scripted", "reach"):
        if kind == "reach" and not FAMILY.fullmatch(scenes.name):
            raise UsageError("policy reach", f"{scenes.name} has no driver that reaches", "give scripted")
        return Scripted(_noise(words), kind == "reach")
    if rest:
        return Called(_named(words), f"policy {words}")
    raise UsageError("policy", f"{words!r} is unknown", POLICY_FORMS)


def identity(words: str) -> tuple[Any, ...]:
    """Return a value that is the same for all spellings of one policy.

    Raises:
        UsageError: its options are unknown.
    """
    kind, _, rest = words.partition(":")
    options: dict[str, Any] = {}
    if kind in ("scripted", "reach"):
        share = _noise(words)
        return ("random",) if share == 1 else (kind, share)
    if kind == "hma" and rest:
        rest, given = split_options(kind, rest, acting.OPTIONS)
        options = {"horizon": acting.HORIZON} | given
    if kind == "plan" and rest:
        rest, given = split_options(kind, rest, planning.OPTIONS)
        options = (Planning.__init__.__kwdefaults__ or {}) | given
    if kind in ("hma", "lerobot") and rest and Path(rest).exists():
        rest = str(Path(rest).resolve())
    return (kind, rest, *sorted(options.items())) if rest else (kind,)


def _noise(words: str) -> float:
    """Return the share of random chunks in `scripted:noise=SHARE` or `reach:noise=SHARE`."""
    kind, _, rest = words.partition(":")
    match = re.fullmatch(r"(?:noise=(\d*\.?\d+|\d+\.))?", rest)
    share = float(match.group(1) or 0) if match else np.nan
    if not share <= 1:
        raise UsageError("policy", f"{words!r} is unknown", f"give {kind}:noise=SHARE, from 0 to 1")
    return share


def _named(words: str) -> Any:
    """Return the object that MODULE:NAME names; modules of the working folder are found."""
    module, here = words.partition(":")[0], str(Path.cwd())
    sys.path.insert(0, here)
    try:
        return pkgutil.resolve_name(words)
    except (Exception, SystemExit) as fault:  # a script may exit where it is imported
        remedy = POLICY_FORMS
        if isinstance(fault, ModuleNotFoundError) and fault.name == module.partition(".")[0]:
            remedy = f"run hma in the folder of {fault.name}.py, or install its package"
        raise HMAError(
            f"policy {words}", f"cannot be imported: {type(fault).__name__}: {fault}", remedy
        ) from fault
    finally:
        with suppress(ValueError):  # the module may have put others before it, or removed it
            sys.path.remove(here)
