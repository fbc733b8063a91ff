"""Start a run from a checkpoint of another run or of a hub, or resume it exactly from its own.

A run that starts from a checkpoint keeps its own copy in `.start/`, so it can resume even if the source
changes. Robots that the checkpoint has continue from their stem and head, with the statistics these were
trained with; other robots get fresh ones, or begin with the stem of their like (`hma_model.training.alike`).
From a hub only the trunk, the robots of the data, and a few that may be like them are fetched.
With a frozen trunk, the run's checkpoints keep the same files of the trunk and, if the source is on this
machine, of all other robots. With a tuned trunk they leave out the other robots, which belong to the old one.

The state from which a run resumes is in `training/` of its checkpoints:

    state.json                step, recipe, digests of the shards, state of the sampler
    optimizer.safetensors     moments by parameter name
    weights.safetensors       the weights of training, if the checkpoint's own are averages

There is no state of random numbers: `seed_for` derives the seed of every draw from (seed, what, step). A run
resumes only from the format versions of this release, because the state of an optimizer cannot be converted.
The weights can: a new run starts from such a checkpoint with `start`.
"""

import dataclasses
import hashlib
import json
from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hma_data.errors import CheckpointError, HubError, RecipeError
from hma_data.loading.views import view_count
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from hma_data.storage.files import file_sha256, finite, read_json, to_json
from hma_data.tokenizers.base import TokenizerSpec
from hma_model.checkpoint import io as checkpoints
from hma_model.checkpoint import weights as stored
from hma_model.checkpoint.folder import (
    CONFIG,
    FORMAT_VERSION,
    HEAD,
    README,
    STEM,
    TRAINING,
    Checkpoint,
    inside,
    require_tokenizer,
    resolve,
)
from hma_model.checkpoint.weights import read_tensors, write_tensors
from hma_model.config import HMAConfig
from hma_model.network.model import HMA, check_fit, module_key, waves_of_stem
from hma_model.training.alike import FETCHED, candidates
from hma_model.training.recipe import Recipe, differences
from hma_model.training.runtime import RECIPE, START

if TYPE_CHECKING:
    from torch import Tensor

STATE, OPTIMIZER, WEIGHTS = "state.json", "optimizer.safetensors", "weights.safetensors"
VERSION = 1  # of `training/`; any change in the meaning of its files raises it
# fields that may differ from the checkpoint's network, because no weight's meaning depends on them
TRAINED_BY = {
    *("dropout", "action_loss_weight", "label_smoothing", "corrupt_max", "history_probability"),
    *("history_frames", "mask_ratio_min", "diffusion_repeats", "diffusion_sample_steps"),
    *("training_pass", "whole_share", "position_init", "latent_noise", "drop_commands"),
}
# fields that a run may turn on for a checkpoint's trunk, and their parameters, which change nothing at first
ADDED = {
    "told_noise": "trunk.noise.", "told_first": "trunk.first.",
    "digit_order": "readout.chain.", "copy_previous": "readout.copy.",
}  # fmt: skip
WAVES = "action_waves"


@dataclass(frozen=True)
class Start:
    """A checkpoint from which a run starts."""

    checkpoint: Checkpoint  # the run's own copy
    frozen: bool  # the trunk is not trained
    source: str  # where the checkpoint is from, for notes

    @classmethod
    def bring(cls, recipe: Recipe, sets: Mapping[str, ShardSet], out: Path) -> None:
        """Fetch the recipe's checkpoint into the run's folder, unless it is there already.

        Raises:
            HubError, CheckpointError: the checkpoint does not exist, or is damaged.
            CheckpointError: the data is of another tokenizer.
        """
        from hma_model.hub import publish as hub

        assert recipe.start is not None
        frozen, place = recipe.freeze == "trunk", out / START
        if (place / README).is_file():  # written last
            _require_source(recipe.start, out)
            return
        source, revision = hub.addressed(recipe.start)
        local = not hub.is_repository(source) and "://" not in source
        if local:
            found = Checkpoint.open(resolve(Path(source).expanduser()))
            require_tokenizer(found.config, _spec(sets), found.folder)
            found.trunk()
            source = str(found.folder)
        try:
            known = hub.embodiment_ids(hub.open_store(source, revision).files())
            wanted = {name for name in known if name in sets or (frozen and local)}
            likes: set[str] = set()
            fresh = set(sets) - set(known)
            if fresh and recipe.new_stem == "like":
                rows = [row for row in hub.list_embodiments(source, revision) if not row["problems"]]
                cards = {row["embodiment"]: {**row, "effective_hz": row["hz"]} for row in rows}
                for name in fresh:
                    some = [one for one in candidates(cards, sets[name].embodiment) if one in known]
                    likes |= set(some if local else some[:FETCHED])
            try:
                hub.pull(source, sorted(wanted | likes), place, revision)
            except CheckpointError as fault:
                if not likes - wanted:
                    raise
                remedy = f"{fault.remedy}, or with new_stem=fresh go without the robots like yours"
                raise CheckpointError(fault.where, fault.fault, remedy) from fault
        except HubError as fault:
            if local or "://" in source:
                raise
            both = f"is no folder here; as a repository of the hub: {fault.fault}"
            remedy = f"give the path of a checkpoint or run, or: {fault.remedy}"
            raise HubError(recipe.start, both, remedy) from fault

    @classmethod
    def open(cls, recipe: Recipe, sets: Mapping[str, ShardSet], out: Path) -> "Start":
        """Open the copy that `bring` has fetched.

        Raises:
            CheckpointError: the copy is damaged, or the data is of another tokenizer.
        """
        start = cls(Checkpoint.open(out / START), recipe.freeze == "trunk", str(recipe.start))
        require_tokenizer(start.checkpoint.config, _spec(sets), start.source)
        return start

    def network(self, recipe: Recipe) -> HMAConfig:
        """Return the configuration of the checkpoint's network, with the recipe's training options.

        Raises:
            RecipeError: the recipe asks for another network.
        """
        config = self.checkpoint.config
        changes: dict[str, Any] = {"objectives": recipe.objectives}
        for key, value in recipe.model.items():
            if key == WAVES:  # `waves` looks after them: each stem may have its own
                changes.update({} if self.frozen else {key: value})
            elif key in TRAINED_BY or (key in self._off() and not self.frozen):
                changes[key] = value
            elif getattr(config.replace(**{key: value}), key) != getattr(config, key):
                fault = f"is {value!r}, the checkpoint that the run starts from has {getattr(config, key)!r}"
                remedy = "leave it out: the network is the checkpoint's"
                raise RecipeError(f"recipe: model.{key}", fault, remedy)
        spec = TokenizerSpec.from_json(dict(config.tokenizer)) if recipe.digits and config.tokenizer else None
        if spec and config.factored and recipe.factored(spec) != tuple(config.factored):
            fault = f"gives digits of {recipe.factored(spec)}, the checkpoint has {tuple(config.factored)}"
            raise RecipeError("recipe: digits", fault, "leave it out: the network is the checkpoint's")
        if (views := view_count(recipe.cameras)) != config.views:
            fault = f"are {views} in a frame, the checkpoint that the run starts from has {config.views}"
            raise RecipeError("recipe: cameras", fault, "name as many, or train from scratch")
        if config.time_position == "learned" and recipe.frames > config.frames:
            fault = f"{recipe.frames} are more than the checkpoint's {config.frames}"
            raise RecipeError("recipe: frames", fault, "use fewer")
        return config.replace(**changes)

    def stats(self, shards: ShardSet) -> dict[str, Any]:
        """Return a robot's statistics: those of the checkpoint if it has the robot, else those of the shards.

        Raises:
            CheckpointError: the checkpoint has the robot with other actions.
        """
        name = shards.embodiment.id
        if name not in self.checkpoint.embodiments:
            return shards.manifest.stats
        theirs, ours = self.checkpoint.embodiment(name), shards.embodiment
        for key in ("action_dim", "stride", "normalize_mask"):
            a, b = getattr(theirs, key), getattr(ours, key)
            if not np.array_equal(a, b):
                fault = f"has {name} with {key} {a}, the shards have {b}"
                raise CheckpointError(self.source, fault, "give the robot of the shards another id")
        return self.checkpoint.stats(name)

    def waves(self, robot: Embodiment, recipe: Recipe) -> int | None:
        """Return the octaves of waves of a robot's stem; None for those of the network.

        They are the checkpoint's; of a robot that it lacks the recipe's, else the most that a like robot has.
        """
        name, own = robot.id, recipe.model.get(WAVES)
        if name in self.checkpoint.embodiments:
            return self._waves(name) or own
        if own is not None or recipe.new_stem == "fresh":
            return own
        cards = {one: self.checkpoint.card(one) for one in self.checkpoint.embodiments}
        return max(map(self._waves, candidates(cards, robot)), default=0) or None

    def _waves(self, name: str) -> int:
        _, stem, _ = checkpoints.read_embodiment(self.checkpoint, name)
        return waves_of_stem(stem)

    def fill(self, model: HMA) -> None:
        """Load the checkpoint's weights for the model's embodiments; freeze trunk and readout if required."""
        kept = stored.trunk(self.checkpoint)
        added = tuple(self._off().values())
        model.load_trunk({n: t for n, t in model.trunk_state().items() if n.startswith(added)} | kept)
        for name in model.embodiments:
            if name in self.checkpoint.embodiments:
                checkpoints.add_embodiment(model, self.checkpoint, name)
        if self.frozen:
            model.trunk.requires_grad_(False)
            model.readout.requires_grad_(False)

    def _off(self) -> dict[str, str]:
        """Return the fields of ADDED that the checkpoint's network is without, and their parameters."""
        config = self.checkpoint.config
        return {key: begin for key, begin in ADDED.items() if getattr(config, key) == getattr(HMAConfig, key)}

    def remarks(self, names: Iterable[str]) -> list[str]:
        """Return notes on the trunk, and on which robots continue and which get a fresh stem and head."""
        known = [name for name in names if name in self.checkpoint.embodiments]
        fresh = [name for name in names if name not in known]
        notes = [f"from {self.source}: trunk {'frozen' if self.frozen else 'tuned'}"]
        if fresh:
            notes.append(f"new stem and head: {', '.join(fresh)}")
        if known:
            notes.append(f"stem, head and statistics from the checkpoint: {', '.join(known)}")
        return notes


def _require_source(source: str, out: Path) -> None:
    """Raise if a resumed run names a checkpoint with another trunk; it may have moved, or be gone."""
    from hma_model.hub import publish as hub
    from hma_model.hub.listing import survey

    before = read_json(out / RECIPE).get("start") if (out / RECIPE).is_file() else None
    if before in (None, source):
        return
    address, revision = hub.addressed(source)
    path = Path(address).expanduser()
    if hub.is_repository(address) or "://" in address:
        trunk = survey(address, revision)[0]["trunk_sha256"]
    else:
        trunk = Checkpoint.open(resolve(path)).trunk_sha256 if path.exists() else None
    if trunk not in (None, Checkpoint.open(out / START).trunk_sha256):
        fault = f"was started from {before}, not from {source}"
        raise RecipeError(out, fault, "train into another folder, or name the first")


def _spec(sets: Mapping[str, ShardSet]) -> Any:
    return next(iter(sets.values())).spec


# -- resuming


class OtherVersionError(CheckpointError):
    """A checkpoint of another format version: it is intact, so an older one must not replace it."""


@dataclass(frozen=True)
class State:
    """The state of a run when its checkpoint was written."""

    step: int  # number of finished steps
    recipe: dict[str, Any]  # `Recipe.identity` of the run
    data: dict[str, str]  # embodiment id -> digest of its shards
    sampler: dict[str, Any]  # `TrainData.state`
    skipped: int = 0  # number of steps skipped because of a bad loss or gradient
    seconds: float = 0.0  # time spent in steps so far
    cpu_seconds: float = 0.0  # and CPU time, the mean over the ranks
    evaluation: dict[str, Any] = field(default_factory=dict)  # the figures of the last evaluation
    norms: list[float] = field(default_factory=list)  # running mean of the gradients' norms, and their number

    def require_same(self, recipe: dict[str, Any], data: dict[str, str], where: object) -> None:
        """Raise RecipeError with the differences unless recipe and shards are those of the run."""
        before = {**Recipe().identity(), **self.recipe}  # keys added by later releases had their defaults
        changed = differences(before, recipe) + differences(self.data, data, "data")
        if changed:
            fault = f"was started with another recipe or other shards: {'; '.join(changed)}"
            remedy = "train into another folder, undo the change, or accept it with --force"
            raise RecipeError(where, fault, remedy)


def require_network(before: HMAConfig, now: HMAConfig, where: object) -> None:
    """Raise RecipeError if a run would resume with another network or tokenizer; --force does not help."""
    free = TRAINED_BY | {"objectives"} | ({"frames"} if before.time_position == "rotary" else set())
    for item in dataclasses.fields(HMAConfig):
        old, new = getattr(before, item.name), getattr(now, item.name)
        if item.name in free or old == new:
            continue
        fault = f"was started with another network: {item.name} is {new!r}, it was {old!r}"
        if item.name == "tokenizer":
            names = f"{old.get('name')!r}, now {new.get('name')!r}"
            fault = f"was started with another tokenizer: {names} or other weights of it"
        raise RecipeError(where, fault, "train into another folder; --force cannot accept this")


def seed_for(seed: int, what: str, *index: int) -> int:
    """Return a seed below 2**63 that differs for each purpose and index."""
    content = repr((seed, what, index)).encode()
    return int.from_bytes(hashlib.sha256(content).digest()[:8], "little") >> 1


def data_digests(sets: Mapping[str, ShardSet]) -> dict[str, str]:
    """Return sixteen hex digits of a SHA-256 over the shards of each embodiment."""
    return {
        name: hashlib.sha256("".join(s.sha256 for s in shards.manifest.shards).encode()).hexdigest()[:16]
        for name, shards in sets.items()
    }


def write_state(
    folder: Path, state: State, moments: Mapping[str, "Tensor"], weights: Mapping[str, "Tensor"]
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
    return hashlib.sha256(content.encode()).hexdigest()


def require_version(path: Path) -> None:
    """Raise OtherVersionError unless this release can resume a run from the checkpoint in a folder."""
    state = path / TRAINING / STATE
    for file, key, own in ((path / CONFIG, "format_version", FORMAT_VERSION), (state, "version", VERSION)):
        found = read_json(file).get(key, own)  # older releases wrote none
        if found != own:
            fault = f"is of {key} {found}, this release resumes from {own}"
            remedy = "update hma-toolkit, or start" if found > own else "start"
            raise OtherVersionError(file, fault, f"{remedy} a new run from its weights with start={path}")


@dataclass(frozen=True)
class TrainingState:
    """The content of a checkpoint for a run, read completely before the model changes."""

    state: State
    shown: dict[str, tuple[dict[str, "Tensor"], ...]]  # published tensors: trunk (""), each stem and head
    weights: dict[str, "Tensor"]  # the weights of training, if they differ from the published ones
    moments: dict[str, "Tensor"]  # of the optimizer
    averages: dict[str, "Tensor"] = field(default_factory=dict)  # parameters by name; `fill` collects them

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
        self.averages.update({n: p.detach().cpu().clone() for n, p in model.named_parameters()})
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
    stated = values.pop("sha256", None)  # an older release wrote neither this nor the files' hashes
    if stated is not None and stated != _digest(values):
        raise CheckpointError(path, "has changed since it was written", "delete this checkpoint")
    files = values.pop("files", None)
    if files is None:
        files = {name: "" for name in (OPTIMIZER, WEIGHTS) if (path.parent / name).is_file()}
    values.pop("version", None)
    try:
        state = State(**values)
    except TypeError as fault:
        raise CheckpointError(path, f"is damaged: {fault}", "delete this checkpoint") from fault
    shown: dict[str, tuple[dict[str, Tensor], ...]] = {"": (read_tensors(checkpoint.trunk()),)}
    for name in set(embodiments) & set(checkpoint.embodiments):
        checkpoint.check(name)
        shown[name] = tuple(read_tensors(checkpoint.path(name, part)) for part in (STEM, HEAD))
    weights = _own_file(checkpoint, WEIGHTS, files) if WEIGHTS in files else {}
    return TrainingState(state, shown, weights, _own_file(checkpoint, OPTIMIZER, files))


def _own_file(checkpoint: Checkpoint, name: str, hashes: Mapping[str, str]) -> "dict[str, Tensor]":
    path = inside(checkpoint.folder, f"{TRAINING}/{name}")
    if hashes.get(name) and hashes[name] != file_sha256(path):
        raise CheckpointError(path, f"is not the file that {STATE} names", "delete this checkpoint")
    return read_tensors(path)
