"""Start a run from a checkpoint, of another run or from a hub.

The run keeps its own copy in `.start/`, so it can resume even if the source changes or is deleted. Robots of
the data that the checkpoint has continue from their stem and head, with the statistics these were trained
with; other robots get fresh ones. From a hub only the trunk and the robots of the data are fetched. With a
frozen trunk, the run's checkpoints keep the same files of the trunk and, if the source is on this machine, of
all other robots. With a tuned trunk they do not keep the other robots, because these belong to the old trunk.
"""

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from hma_data.errors import CheckpointError, HubError, RecipeError
from hma_data.loading.views import view_count
from hma_data.shards.reader import ShardSet
from hma_data.storage.files import read_json
from hma_model.checkpoint import io as checkpoints
from hma_model.checkpoint import weights
from hma_model.checkpoint.io import Checkpoint, require_tokenizer
from hma_model.config import HMAConfig
from hma_model.training.runtime import RECIPE, START

if TYPE_CHECKING:
    from hma_model.network.model import HMA
    from hma_model.training.recipe import Recipe

# fields that may differ from the checkpoint's network, because no weight's meaning depends on them
TRAINED_BY = {
    *("dropout", "action_loss_weight", "label_smoothing", "corrupt_max", "history_probability"),
    *("history_frames", "mask_ratio_min", "diffusion_repeats", "diffusion_sample_steps"),
}


@dataclass(frozen=True)
class Start:
    """A checkpoint from which a run starts."""

    checkpoint: Checkpoint  # the run's own copy
    frozen: bool  # the trunk is not trained
    source: str  # where the checkpoint is from, for notes

    @classmethod
    def bring(cls, recipe: "Recipe", sets: Mapping[str, ShardSet], out: Path) -> None:
        """Fetch the recipe's checkpoint into the run's folder, unless it is there already.

        Raises:
            HubError, CheckpointError: the checkpoint does not exist, or is damaged.
            CheckpointError: the data is of another tokenizer.
        """
        from hma_model.hub import publish as hub

        assert recipe.start is not None
        frozen, place = recipe.freeze == "trunk", out / START
        if (place / checkpoints.README).is_file():  # written last
            _require_source(recipe.start, out)
            return
        source, revision = hub.addressed(recipe.start)
        local = not hub.is_repository(source) and "://" not in source
        if local:
            found = Checkpoint.open(checkpoints.resolve(Path(source).expanduser()))
            require_tokenizer(found.config, _spec(sets), found.folder)
            found.trunk()
            source = str(found.folder)
        try:
            known = hub.embodiment_ids(hub.open_store(source, revision).files())
            wanted = [name for name in known if name in sets or (frozen and local)]
            hub.pull(source, wanted, place, revision)
        except HubError as fault:
            if local or "://" in source:
                raise
            both = f"is no folder here; as a repository of the hub: {fault.fault}"
            remedy = f"give the path of a checkpoint or run, or: {fault.remedy}"
            raise HubError(recipe.start, both, remedy) from fault

    @classmethod
    def open(cls, recipe: "Recipe", sets: Mapping[str, ShardSet], out: Path) -> "Start":
        """Open the copy that `bring` has fetched.

        Raises:
            CheckpointError: the copy is damaged, or the data is of another tokenizer.
        """
        start = cls(Checkpoint.open(out / START), recipe.freeze == "trunk", str(recipe.start))
        require_tokenizer(start.checkpoint.config, _spec(sets), start.source)
        return start

    def network(self, recipe: "Recipe") -> HMAConfig:
        """Return the configuration of the checkpoint's network, with the recipe's training options.

        Raises:
            RecipeError: the recipe asks for another network.
        """
        config = self.checkpoint.config
        changes: dict[str, Any] = {"objectives": recipe.objectives}
        for key, value in recipe.model.items():
            if key in TRAINED_BY:
                changes[key] = value
            elif getattr(config.replace(**{key: value}), key) != getattr(config, key):
                fault = f"is {value!r}, the checkpoint that the run starts from has {getattr(config, key)!r}"
                remedy = "leave it out: the network is the checkpoint's"
                raise RecipeError(f"recipe: model.{key}", fault, remedy)
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

    def fill(self, model: "HMA") -> None:
        """Load the checkpoint's weights for the model's embodiments; freeze trunk and readout if required."""
        model.load_trunk(weights.trunk(self.checkpoint))
        for name in model.embodiments:
            if name in self.checkpoint.embodiments:
                checkpoints.add_embodiment(model, self.checkpoint, name)
        if self.frozen:
            for part in (model.trunk, model.readout):
                part.requires_grad_(False)

    def remarks(self, names: Mapping[str, Any]) -> list[str]:
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
    """Raise if a resumed run names another checkpoint than the one it was started from.

    The checkpoint is the same if its trunk is, so it may have moved, and it may be gone.
    """
    from hma_model.hub import publish as hub

    before = read_json(out / RECIPE).get("start") if (out / RECIPE).is_file() else None
    if before in (None, source):
        return
    address, revision = hub.addressed(source)
    path = Path(address).expanduser()
    if hub.is_repository(address) or "://" in address:
        trunk = hub.describe(address, revision)["trunk_sha256"]
    else:
        trunk = Checkpoint.open(checkpoints.resolve(path)).trunk_sha256 if path.exists() else None
    if trunk not in (None, Checkpoint.open(out / START).trunk_sha256):
        fault = f"was started from {before}, not from {source}"
        raise RecipeError(out, fault, "train into another folder, or name the first")


def _spec(sets: Mapping[str, ShardSet]) -> Any:
    return next(iter(sets.values())).spec
