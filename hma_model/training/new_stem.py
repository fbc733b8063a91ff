"""Begin the stem of a new robot as a copy of the stem of a robot that takes its commands alike.

A freshly initialised stem passes nothing of the commands on, and the first minutes of training go into that
alone. If the checkpoint knows a robot of the same kind (the same arm at another desk, the same simulator in
other colours), the new robot can begin with the stem of that one. Each robot of the checkpoint with as many
action dims is tried on a few training windows. The stem with the lowest loss is taken, if a fresh one's loss
is higher.

A action dims, D width.
"""

import copy
import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor

from hma_data.loading.views import Cameras
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from hma_model.checkpoint import io as checkpoints
from hma_model.checkpoint.folder import Checkpoint
from hma_model.evaluation.losses import validation_losses, windows
from hma_model.network.model import HMA

FETCHED = 4  # robots of a hub that are fetched for a new one; of a folder all are tried
WINDOWS, FRAMES = 8, 4  # on which they are tried
STATISTICS = "normalizer."  # the statistics, which stay those of the new robot
INPUT, WAVES = "input.weight", "waves.weight"

type State = Mapping[str, Tensor]


@dataclass(frozen=True)
class ChosenStem:
    """The stem with which a new robot begins."""

    like: str  # the robot of the checkpoint whose stem it is
    loss: float  # of the new robot's windows with this stem, before training
    fresh_loss: float  # of the same windows with a fresh stem


def candidates(cards: Mapping[str, Mapping[str, Any]], robot: Embodiment) -> list[str]:
    """Return the ids of the robots with as many action dims, those of the nearest rate first.

    Args:
        cards: id -> at least `action_dim` and `effective_hz`; those of a hub may be damaged.
        robot: the new robot.
    """

    def apart(name: str) -> float:
        hz = cards[name].get("effective_hz")
        return abs(math.log(hz / robot.effective_hz)) if isinstance(hz, int | float) and hz > 0 else math.inf

    return sorted((name for name in cards if cards[name].get("action_dim") == robot.action_dim), key=apart)


@torch.no_grad()
def choose(
    model: HMA, name: str, checkpoint: Checkpoint, shards: ShardSet, cameras: Cameras, objective: str
) -> ChosenStem | None:
    """Find the robot whose stem gives a new robot's training windows the lowest loss; None: a fresh one does.

    Args:
        model: has the checkpoint's trunk, and the new robot; it stays as it is.
        name: the new robot's id.
        checkpoint: where the other stems are.
        shards: those of the new robot.
        cameras: as `WindowDataset` takes them.
        objective: whose loss counts.

    Raises:
        CheckpointError: a stem of the checkpoint is damaged.
    """
    length = min(FRAMES, model.config.frames)
    batches = list(windows(shards, "train", length, WINDOWS, batch_size=WINDOWS, cameras=cameras))
    cards = {one: checkpoint.card(one) for one in checkpoint.embodiments}
    own = _states(model, name)

    def loss() -> float:
        mean = validation_losses(model, batches, objective=objective)[0].mean()
        return mean if math.isfinite(mean) else math.inf

    fresh = lowest = loss()
    chosen = ""
    for like in candidates(cards, shards.embodiment):
        copy_stem(model, name, checkpoint, like)
        tried = loss()
        if tried < lowest:
            chosen, lowest = like, tried
        _load(model, name, *own)
    return ChosenStem(chosen, lowest, fresh) if chosen else None


def copy_stem(model: HMA, name: str, checkpoint: Checkpoint, like: str) -> None:
    """Give a robot of the model another one's stem, and its head if it fits; the statistics stay."""
    own_stem, own_head = _states(model, name)
    space, stem, head = checkpoints.read_embodiment(checkpoint, like)
    stem = _fitted(stem, own_stem, space.stride, model.embodiments[name].stride)
    fits = all(head[key].shape == value.shape for key, value in own_head.items())
    _load(model, name, stem, head if fits else own_head)


def _fitted(stem: State, own: State, steps: int, own_steps: int) -> dict[str, Tensor]:
    """Return a stem's tensors for chunks of another number of steps, with the statistics of `own`."""
    kept = {key: value for key, value in own.items() if key.startswith(STATISTICS)}
    fitted = {**stem, **kept, INPUT: _resampled(stem[INPUT].unsqueeze(-1), steps, own_steps).flatten(1)}
    if WAVES in own:  # they begin at zero, and those of the slow octaves come first
        chunk = stem[INPUT].shape[1]
        waves = own[WAVES].new_zeros(own[WAVES].shape).unflatten(1, (own[INPUT].shape[1], 2, -1))
        if WAVES in stem:
            theirs = _resampled(stem[WAVES].unflatten(1, (chunk, -1)), steps, own_steps)
            theirs = theirs.unflatten(2, (2, -1))[..., : waves.shape[-1]]
            waves[..., : theirs.shape[-1]] = theirs
        fitted[WAVES] = waves.flatten(1)
    return {key: fitted[key] for key in own}


def _resampled(weight: Tensor, steps: int, own_steps: int) -> Tensor:
    """Return weights (D, steps · A, V) for chunks of `own_steps`.

    Each command of the old chunk becomes the new chunk's command of the nearest time.
    """
    by_step = weight.unflatten(1, (steps, -1))
    nearest = (torch.arange(steps) * 2 + 1) * own_steps // (2 * steps)
    resampled = by_step.new_zeros(len(weight), own_steps, *by_step.shape[2:])
    return resampled.index_add(1, nearest.to(weight.device), by_step).flatten(1, 2)


def _states(model: HMA, name: str) -> tuple[dict[str, Tensor], dict[str, Tensor]]:
    return copy.deepcopy((model.stem_state(name), model.head_state(name)))


def _load(model: HMA, name: str, stem: State, head: State) -> None:
    model.stem(name).load_state_dict(stem)
    model.head(name).load_state_dict(head)
