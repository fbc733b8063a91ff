"""What a training run needs to go on exactly: the folder `training/` of its checkpoints.

    state.json                step, recipe, the shards' digests, where the sampler stands
    optimizer.safetensors     moments by parameter name

There is no state of random numbers: every draw of a step comes from (seed, what, step) by `seed_for`.
"""

import hashlib
from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hma_data.errors import CheckpointError, RecipeError
from hma_model.checkpoint import TRAINING, Checkpoint, inside
from hma_model.files import read_json, read_tensors, to_json, write_tensors
from hma_model.optim import load_optimizer_state, optimizer_state
from hma_model.recipe import differences

if TYPE_CHECKING:
    import torch

    from hma_data.shards.reader import ShardSet
    from hma_model.model import HMA

STATE, OPTIMIZER = "state.json", "optimizer.safetensors"


@dataclass(frozen=True)
class State:
    """Where a run stood when its checkpoint was written.

    Attributes:
        step: steps done.
        recipe: `Recipe.identity` of the run.
        data: embodiment id -> digest of its shards.
        sampler: `MixtureDataset.state_dict`.
        skipped: steps left out for losses that were not numbers.
        seconds: spent in steps so far.
        evaluation: the last one's figures.
    """

    step: int
    recipe: dict[str, Any]
    data: dict[str, str]
    sampler: dict[str, Any]
    skipped: int = 0
    seconds: float = 0.0
    evaluation: dict[str, Any] = field(default_factory=dict)

    def require_same(self, recipe: dict[str, Any], data: dict[str, str], where: object) -> None:
        """Raise RecipeError with the differences unless recipe and shards are those of the run."""
        changed = differences(self.recipe, recipe) + differences(self.data, data, "data")
        if changed:
            raise RecipeError(
                where,
                f"was begun with another recipe or other shards: {'; '.join(changed)}",
                "train into another folder, undo the change, or accept it with --force",
            )


def seed_for(seed: int, what: str, *index: int) -> int:
    """A seed of its own for each purpose and place, below 2**63."""
    content = repr((seed, what, index)).encode()
    return int.from_bytes(hashlib.sha256(content).digest()[:8], "little") >> 1


def data_digests(sets: Mapping[str, "ShardSet"]) -> dict[str, str]:
    """Sixteen hex digits over the shards of each embodiment."""
    return {
        name: hashlib.sha256("".join(s.sha256 for s in shards.manifest.shards).encode()).hexdigest()[:16]
        for name, shards in sets.items()
    }


def write_state(folder: Path, state: State, optimizer: "torch.optim.Optimizer") -> None:
    """Fill a checkpoint's `training/`."""
    write_tensors(folder / OPTIMIZER, optimizer_state(optimizer), {"format": "pt"})
    (folder / STATE).write_bytes(to_json(asdict(state)))


def read_state(checkpoint: Checkpoint) -> State:
    """The state in a checkpoint.

    Raises:
        CheckpointError: it has none, or it is damaged.
    """
    path = inside(checkpoint.folder, f"{TRAINING}/{STATE}")
    try:
        return State(**read_json(path))
    except TypeError as fault:
        raise CheckpointError(path, f"is damaged: {fault}", "delete this checkpoint") from fault


def restore(checkpoint: Checkpoint, model: "HMA", optimizer: "torch.optim.Optimizer") -> None:
    """Bring weights and moments back, onto the devices they are on.

    Raises:
        CheckpointError: parts that do not fit the model.
    """
    from hma_model.checkpoint import HEAD, STEM

    model.load_trunk(read_tensors(checkpoint.trunk()))
    for name in model.embodiments:
        checkpoint.check(name)
        stem, head = (read_tensors(checkpoint.path(name, part)) for part in (STEM, HEAD))
        model.load_embodiment(name, stem, head)
    path = inside(checkpoint.folder, f"{TRAINING}/{OPTIMIZER}")
    load_optimizer_state(optimizer, read_tensors(path), path)
