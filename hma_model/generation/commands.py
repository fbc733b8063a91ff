"""Describe the commands that an embodiment takes: names, bounds, and the range seen in training.

A action dims, K = stride · A values of a chunk.
"""

import math
import warnings
from collections.abc import Sequence
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import ArrayLike
from torch import Tensor

from hma_data.arrays import Bools, Float32s
from hma_data.errors import CheckpointError, HMAError
from hma_data.registry.embodiment import Embodiment, find
from hma_model.checkpoint.folder import Checkpoint
from hma_model.network.network import Network


@dataclass(frozen=True)
class Commands:
    """The commands of one embodiment of a model.

    Attributes:
        embodiment: its id.
        names: A names.
        stride: commands in a chunk.
        rate_hz: of the commands; None if nobody states it.
        low, high: (A,) the bounds: the range that the YAML states, else that seen in training, else infinite.
        seen: (2, A) the least and the largest value seen in training; None if the checkpoint has none.
    """

    embodiment: str
    names: tuple[str, ...]
    stride: int
    rate_hz: float | None
    low: Float32s
    high: Float32s
    seen: Float32s | None

    @classmethod
    def of(cls, model: Network, embodiment: str) -> "Commands":
        """Return the commands of an embodiment of a model.

        Raises:
            HMAError: the model lacks it.
        """
        robot = described(model, embodiment)
        space = model.embodiments[embodiment]
        seen = _seen(model, embodiment)
        low, high = np.full((space.action_dim, 2), (-np.inf, np.inf), np.float32).T if seen is None else seen
        names = [f"action_{i}" for i in range(space.action_dim)]
        if robot is not None:
            names = robot.action.names()
            low, high = low.copy(), high.copy()
            for part, span in robot.action.spans():
                if part.range:
                    low[span], high[span] = part.range
        rate = robot.rate_hz if robot is not None and robot.states_rate else None
        return cls(embodiment, tuple(names), space.stride, rate, low, high, seen)

    def read(self, commands: ArrayLike) -> tuple[Float32s, bool]:
        """Return commands as a chunk (K,), and whether it is known.

        Args:
            commands: (K,) or (stride, A) raw. A command of NaN is unknown, and then the whole chunk is.

        Raises:
            HMAError: the shape is another one, or values are infinite or partly NaN.
        """
        values = np.asarray(commands, np.float32)
        shape = (self.stride, len(self.names))
        if values.shape not in (shape, (shape[0] * shape[1],)):
            fault = f"of {self.embodiment} have the shape {values.shape}"
            raise HMAError("commands", fault, f"give ({shape[0] * shape[1]},) or {shape}")
        rows = values.reshape(shape)
        if self.unknown(rows).any():
            return np.zeros(values.size, np.float32), False
        return rows.reshape(-1), True

    def one(self, command: ArrayLike) -> Float32s:
        """Return one command (A,), checked; of NaN if it is unknown.

        Raises:
            HMAError: the shape is another one, or values are infinite or partly NaN.
        """
        values = np.asarray(command, np.float32)
        if values.shape != (len(self.names),):
            fault = f"of {self.embodiment} has the shape {values.shape}"
            raise HMAError("command", fault, f"give ({len(self.names)},): {', '.join(self.names)}")
        self.unknown(values[None])
        return values

    def unknown(self, rows: Float32s) -> Bools:
        """Return which commands (n, A) are unknown; raise HMAError for values that mean nothing."""
        unknown = np.asarray(np.isnan(rows).all(axis=1))
        if not np.isfinite(rows[~unknown]).all():
            fault = f"of {self.embodiment} hold values that are not finite"
            raise HMAError("commands", fault, "give numbers; a command of NaN alone is unknown")
        return unknown

    def outside(self, commands: Float32s) -> str:
        """Say which of the commands (..., A) leave the range seen in training, and the range; "" for none."""
        if self.seen is None:
            return ""
        low, high = self.seen
        slack = 1e-4 * (high - low) + 1e-6
        with np.errstate(invalid="ignore"):
            beyond = ((commands < low - slack) | (commands > high + slack)).reshape(-1, len(low)).any(axis=0)
        said = [f"{self.names[i]} {low[i]:g} to {high[i]:g}" for i in np.flatnonzero(beyond)]
        about = f"an action is outside the range seen in training ({', '.join(said)})"
        return f"{self.embodiment}: {about}" if said else ""

    def clip(self, commands: Float32s) -> Float32s:
        """Return commands (..., A) inside the range seen in training; NaN stays."""
        return commands if self.seen is None else np.clip(commands, *self.seen)


class OutsideRangeWarning(UserWarning):
    """Commands lie outside the range seen in training."""


def warn_outside(
    model: Network, actions: Tensor, embodiments: str | Sequence[str], known: Tensor | None = None
) -> None:
    """Warn of known actions outside the range seen in training; once of each embodiment of a model.

    Args:
        model: any.
        actions: (B, T, K) raw.
        embodiments: one id for all, or one a sample.
        known: (B, T) bool; by default all are.
    """
    if model.source is None:  # only a checkpoint has the range
        return
    if known is not None:
        actions = actions.masked_fill(~known[..., None], math.nan)
    watched = vars(model).setdefault("watched_commands", {})
    names = [embodiments] * len(actions) if isinstance(embodiments, str) else list(embodiments)
    for name in sorted(set(names)):
        own = watched.get(name)
        if name not in watched:
            with suppress(CheckpointError):  # the checkpoint that tells them may no longer be there
                own = Commands.of(model, name)
        if own is not None:
            mine = [row for row, one in enumerate(names) if one == name]
            rows = actions[mine, :, : own.stride * len(own.names)].numpy(force=True)
            said = own.outside(rows.reshape(-1, len(own.names)))
            watched[name] = None if said else own
            if said:
                warnings.warn(f"{said}. Shown only once", OutsideRangeWarning, stacklevel=4)


def described(model: Network, embodiment: str) -> Embodiment | None:
    """Return the YAML of an embodiment of a model: its checkpoint's, else the registry's; None without one.

    Raises:
        HMAError: the model lacks the embodiment.
    """
    model.stem(embodiment)  # raises without one
    kept = checkpoint_of(model, embodiment)
    if kept is not None:
        return kept.embodiment(embodiment)
    try:
        return find(embodiment)
    except HMAError:
        return None


def yaml_of(model: Network, embodiment: str) -> Embodiment:
    """Return the YAML of an embodiment of a model; raise HMAError if there is none."""
    robot = described(model, embodiment)
    if robot is None:
        raise HMAError(embodiment, "has no YAML that describes its actions", "load a checkpoint")
    return robot


def card(model: Network, embodiment: str) -> dict[str, Any]:
    """Return the card of an embodiment of a model; empty if the model is not from a checkpoint."""
    kept = checkpoint_of(model, embodiment)
    return {} if kept is None else kept.card(embodiment)


def checkpoint_of(model: Network, embodiment: str) -> Checkpoint | None:
    """Return the checkpoint that a model was loaded from if it has an embodiment."""
    kept = model.source
    return kept if kept and embodiment in kept.embodiments else None


def _seen(model: Network, embodiment: str) -> Float32s | None:
    kept = checkpoint_of(model, embodiment)
    action = {} if kept is None else kept.stats(embodiment)["action"]
    if "min" not in action or "max" not in action:
        return None
    return np.array([action["min"], action["max"]], np.float32)
