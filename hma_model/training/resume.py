"""Save the state of a run in its checkpoints, and resume the run exactly from it.

The state is in `training/` of a checkpoint:

    state.json                step, recipe, digests of the shards, state of the sampler
    optimizer.safetensors     moments by parameter name
    weights.safetensors       the weights of training, if the checkpoint's own are averages

There is no state of random numbers: `seed_for` derives the seed of every draw from (seed, what, step). A run
resumes only from the format versions of this release, because the state of an optimizer cannot be converted.
The weights can: a new run starts from such a checkpoint with `start` (`hma_model.training.start`).
"""

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
from torch import Tensor

from hma_data.errors import CheckpointError, RecipeError
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from hma_data.storage.files import file_sha256, finite, read_json, short_sha256, to_json
from hma_model.checkpoint.folder import CONFIG, FORMAT_VERSION, HEAD, STEM, TRAINING, Checkpoint, inside
from hma_model.checkpoint.weights import read_tensors, write_tensors
from hma_model.config import HMAConfig
from hma_model.network.model import HMA
from hma_model.network.states import check_fit, module_key
from hma_model.training.recipe import differences

STATE, OPTIMIZER, WEIGHTS = "state.json", "optimizer.safetensors", "weights.safetensors"
VERSION = 1  # of `training/`; any change in the meaning of its files raises it
# fields that may differ from the checkpoint's network, because no weight's meaning depends on them
TRAINED_BY = {
    *("label_smoothing", "corrupt_max", "history_probability", "diffusion_sample_steps"),
    *("training_pass", "whole_share", "position_init", "latent_noise", "crop"),
}


class OtherVersionError(CheckpointError):
    """A checkpoint of another format version: it is intact, so an older one must not replace it."""


@dataclass(frozen=True)
class RunState:
    """The state of a run when its checkpoint was written."""

    step: int  # number of finished steps
    recipe: dict[str, Any]  # `Recipe.identity` of the run
    data: dict[str, str]  # embodiment id -> digest of its shards
    sampler: dict[str, Any]  # `TrainData.state`
    skipped: int = 0  # number of steps skipped because a loss or gradient was not finite
    seconds: float = 0.0  # time spent in steps so far
    cpu_seconds: float = 0.0  # and CPU time
    evaluation: dict[str, Any] = field(default_factory=dict)  # the figures of the last evaluation

    def require_same(self, recipe: dict[str, Any], data: dict[str, str], where: object) -> None:
        """Raise RecipeError with the differences unless recipe and shards are those of the run."""
        changed = differences(self.recipe, recipe) + differences(self.data, data, "data")
        if changed:
            fault = f"was started with another recipe or other shards: {'; '.join(changed)}"
            remedy = "train into another folder, undo the change, or accept it with --force"
            raise RecipeError(where, fault, remedy)


def require_network(before: HMAConfig, now: HMAConfig, where: object) -> None:
    """Raise RecipeError if a run would resume with another network or tokenizer; --force does not help."""
    free = TRAINED_BY | {"objectives"} | (set() if before.released else {"frames"})
    for item in dataclasses.fields(HMAConfig):
        old, new = getattr(before, item.name), getattr(now, item.name)
        if item.name in free or old == new:
            continue
        fault = f"was started with another network: {item.name} is {new!r}, it was {old!r}"
        if item.name == "tokenizer":
            names = f"{old.get('name')!r}, now {new.get('name')!r}"
            fault = f"was started with another tokenizer: {names} or other weights of it"
        raise RecipeError(where, fault, "train into another folder; --force cannot accept this")


def other_actions(known: Embodiment, now: Embodiment) -> str:
    """Return how a robot's actions differ from those that its stem was trained with; empty if not."""
    for key in ("action_dim", "stride", "normalize_mask", "action.space"):
        old, new = map(attrgetter(key), (known, now))
        if not np.array_equal(old, new):
            return f"{now.id} with {key} {old}, the shards have {new}"
    return ""


def seed_for(seed: int, what: str, *index: int) -> int:
    """Return a seed below 2**63 that differs for each purpose and index."""
    content = repr((seed, what, index)).encode()
    return int.from_bytes(hashlib.sha256(content).digest()[:8], "little") >> 1


def data_digests(sets: Mapping[str, ShardSet]) -> dict[str, str]:
    """Return sixteen hex digits of a SHA-256 over the shards of each embodiment."""
    return {
        name: short_sha256("".join(s.sha256 for s in shards.manifest.shards)) for name, shards in sets.items()
    }


def write_state(
    folder: Path, state: RunState, moments: Mapping[str, Tensor], weights: Mapping[str, Tensor]
) -> None:
    """Write the files of `training/`; without `weights` the checkpoint's weights are those of training."""
    write_tensors(folder / OPTIMIZER, moments, {"format": "pt"})
    if weights:
        write_tensors(folder / WEIGHTS, weights, {"format": "pt"})
    files = {path.name: file_sha256(path) for path in sorted(folder.iterdir())}
    values = finite({"version": VERSION, **asdict(state), "files": files})
    (folder / STATE).write_bytes(to_json({**values, "sha256": _digest(values)}))


def _digest(values: Mapping[str, Any]) -> str:
    content = json.dumps({key: value for key, value in values.items() if key != "sha256"}, sort_keys=True)
    return short_sha256(content, 64)


def require_version(path: Path) -> None:
    """Raise OtherVersionError unless this release can resume a run from the checkpoint in a folder."""
    state = path / TRAINING / STATE
    for file, key, own in ((path / CONFIG, "format_version", FORMAT_VERSION), (state, "version", VERSION)):
        found = read_json(file).get(key)
        if found != own:
            fault = f"is of {key} {found}, this release resumes from {own}"
            remedy = f"update hma-toolkit, or start a new run from its weights with start={path}"
            raise OtherVersionError(file, fault, remedy)


@dataclass(frozen=True)
class TrainingState:
    """The content of a checkpoint for a run, read completely before the model changes."""

    state: RunState
    shown: dict[str, tuple[dict[str, Tensor], ...]]  # published tensors: trunk (""), each stem and head
    weights: dict[str, Tensor]  # the weights of training, if they differ from the published ones
    moments: dict[str, Tensor]  # of the optimizer
    averages: dict[str, Tensor] = field(default_factory=dict)  # parameters by name; `fill` collects them

    def fill(self, model: HMA) -> None:
        """Load the weights of training into an unsharded model.

        Raises:
            CheckpointError: parts do not fit the model.
        """
        model.load_trunk(self.shown[""][0])
        for name in self.shown.keys() - {""}:
            model.load_embodiment(name, *self.shown[name])
        if not self.weights:
            return
        self.averages.update({name: value.cpu().clone() for name, value in model.state_dict().items()})
        new = model.embodiments.keys() - self.shown.keys()
        fresh = tuple(f"{part}.{module_key(name)}." for name in new for part in ("stems", "heads"))
        own = {name: tensor for name, tensor in model.state_dict().items() if not name.startswith(fresh)}
        weights = {name: self.weights[name] for name in self.weights.keys() & own.keys()}
        check_fit(f"{TRAINING}/{WEIGHTS}", weights, own)
        model.load_state_dict(weights, strict=False)


def read_training_state(checkpoint: Checkpoint, embodiments: Iterable[str]) -> TrainingState:
    """Read the content of a checkpoint for a run; embodiments that the checkpoint lacks are left out.

    Raises:
        CheckpointError: parts are missing, damaged, or do not belong together.
    """
    path = inside(checkpoint.folder, f"{TRAINING}/{STATE}")
    values = read_json(path)
    if values.pop("sha256", None) != _digest(values):
        raise CheckpointError(path, "has changed since it was written", "delete this checkpoint")
    files = values.pop("files")
    del values["version"]
    try:
        state = RunState(**values)
    except TypeError as fault:
        raise CheckpointError(path, f"is damaged: {fault}", "delete this checkpoint") from fault
    shown: dict[str, tuple[dict[str, Tensor], ...]] = {"": (read_tensors(checkpoint.trunk()),)}
    for name in set(embodiments) & set(checkpoint.embodiments):
        checkpoint.check(name)
        shown[name] = tuple(read_tensors(checkpoint.path(name, part)) for part in (STEM, HEAD))
    weights = _own_file(checkpoint, WEIGHTS, files) if WEIGHTS in files else {}
    return TrainingState(state, shown, weights, _own_file(checkpoint, OPTIMIZER, files))


def _own_file(checkpoint: Checkpoint, name: str, hashes: Mapping[str, str]) -> dict[str, Tensor]:
    path = inside(checkpoint.folder, f"{TRAINING}/{name}")
    if hashes.get(name) != file_sha256(path):
        raise CheckpointError(path, f"is not the file that {STATE} names", "delete this checkpoint")
    return read_tensors(path)
