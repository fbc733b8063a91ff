"""Define what a policy is, and check what one returns.

A policy acts in N scenes at once. `Arena` gives it the newest images, and to those that ask for it a state.

N scenes, A action dims.
"""

import random
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from typing import Any, Protocol

import numpy as np
import torch

from hma_data.arrays import Float32s
from hma_data.errors import HMAError, UsageError
from hma_model.policies.arenas import Arena


class Policy(Protocol):
    """A policy in N scenes."""

    def begin(self, arena: Arena) -> None:
        """Begin episodes in all scenes."""

    def act(self, arena: Arena) -> Float32s:
        """Return the next actions (N, A)."""


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


def begin(name: str, policy: Policy, arena: Arena) -> None:
    """Begin a policy's episodes; an HMAError names the policy if it raises."""
    with _named_errors(name):
        policy.begin(arena)


def checked(name: str, policy: Policy, arena: Arena) -> Float32s:
    """Return the next actions (N, A) of a policy.

    Raises:
        HMAError: it raises, or returns another shape or values that are not finite.
    """
    where = f"policy {name}"
    width = len(arena.scenes.dimensions)
    with _named_errors(name):
        actions = np.asarray(policy.act(arena), np.float32)
    if actions.shape != (len(arena.images), width):
        names = ", ".join(dim.name for dim in arena.scenes.dimensions)
        fault = f"returns actions of the shape {actions.shape[1:]}"
        raise HMAError(where, fault, f"{arena.scenes.name} takes ({width},): {names}")
    if not np.isfinite(actions).all():
        raise HMAError(
            where, "returns NaN or infinite values", "return a number for each value of the action"
        )
    return actions


@contextmanager
def kept_randomness() -> Iterator[None]:
    """Put the global random numbers of Python, numpy and torch back to where they were."""
    python, legacy = random.getstate(), np.random.get_state()  # noqa: NPY002
    devices = range(torch.cuda.device_count() if torch.cuda.is_initialized() else 0)
    with torch.random.fork_rng(devices):
        try:
            yield
        finally:
            random.setstate(python)
            np.random.set_state(legacy)  # noqa: NPY002


def seed_samplers(*key: int) -> None:
    """Seed the global random numbers of Python, numpy and torch, from which policies may draw."""
    (seed,) = np.random.SeedSequence(key).generate_state(1).tolist()
    random.seed(seed)
    np.random.seed(seed)  # noqa: NPY002
    torch.manual_seed(seed)


@contextmanager
def _named_errors(name: str) -> Iterator[None]:
    try:
        yield
    except HMAError:
        raise
    except (Exception, SystemExit) as fault:
        remedy = "fix it; --debug shows the traceback"
        raise HMAError(f"policy {name}", f"raised {type(fault).__name__}: {fault}", remedy) from fault
