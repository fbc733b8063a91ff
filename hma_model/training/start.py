"""Start a run from a checkpoint of another run or of a hub.

The run keeps its own copy of the checkpoint in `.start/`, so it can resume even if the source changes. Robots
that the checkpoint has continue from their stem and head, with the statistics these were trained with. Other
robots get fresh ones, or begin with the stem of a robot like them (`hma_model.training.new_stem`). From a hub
only the trunk, the robots of the data, and a few that may be like them are fetched.

With a frozen trunk, the run's checkpoints keep the same files of the trunk and, if the source is on this
machine, of all other robots. With a tuned trunk they leave out the other robots, which belong to the old one.
"""

import shutil
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hma_data.errors import CheckpointError, RecipeError
from hma_data.loading.views import view_count
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from hma_data.storage.files import read_json
from hma_data.storage.paths import addressed, is_repository
from hma_model.checkpoint import io as checkpoints
from hma_model.checkpoint import weights as stored
from hma_model.checkpoint.folder import README, Checkpoint, require_tokenizer, resolve, training_checkpoints
from hma_model.config import HMAConfig
from hma_model.network.model import HMA
from hma_model.network.stem import waves_of_stem
from hma_model.training.colors import carried, recolored
from hma_model.training.new_stem import FETCHED, candidates
from hma_model.training.recipe import Recipe
from hma_model.training.resume import TRAINED_BY, other_actions
from hma_model.training.runtime import RECIPE, START

# fields that a run may turn on for a checkpoint's trunk, and their parameters, which change nothing at first
ADDED = {
    "told_noise": "trunk.noise.", "digit_order": "readout.chain.", "copy_previous": "readout.copy.",
}  # fmt: skip
WAVES = "action_waves"
OF_THE_TRUNK = {WAVES, "copy_previous"}  # what recipes turn on; a frozen trunk stays as it is


@dataclass(frozen=True)
class Start:
    """A checkpoint from which a run starts."""

    checkpoint: Checkpoint  # the run's own copy
    config: HMAConfig  # the checkpoint's, for the colours of the data
    frozen: bool  # the trunk is not trained
    source: str  # where the checkpoint is from, for notes

    @classmethod
    def bring(cls, recipe: Recipe, sets: Mapping[str, ShardSet], out: Path) -> None:
        """Fetch the recipe's checkpoint into the run's folder, unless the run has begun from it.

        Raises:
            HubError, CheckpointError: the checkpoint does not exist, or is damaged.
            CheckpointError: the data is of another tokenizer.
        """
        from hma_model.hub import publish as hub

        assert recipe.start is not None
        place = out / START
        if training_checkpoints(out) and (place / README).is_file():  # written last
            _require_source(recipe.start, out)
            return
        shutil.rmtree(place, ignore_errors=True)  # nothing is trained yet: it may be of another source
        source, revision = addressed(recipe.start)
        local = not is_repository(source) and "://" not in source
        if local:
            tokenizer = next(iter(sets.values())).spec.name
            found = Checkpoint.open(resolve(Path(source).expanduser(), tokenizer=tokenizer))
            _config_for(found, recipe, sets, found.name)
            found.trunk()
            source = str(found.folder)
        wanted, likes = _robots(recipe, sets, source, revision, local)
        try:
            hub.pull(source, sorted(wanted | likes), place, revision)
        except CheckpointError as fault:
            if not likes - wanted:
                raise
            remedy = f"{fault.remedy}, or set new_stem=fresh to do without similar robots"
            raise CheckpointError(fault.where, fault.fault, remedy) from fault

    @classmethod
    def open(cls, recipe: Recipe, sets: Mapping[str, ShardSet], out: Path) -> "Start":
        """Open the copy that `bring` has fetched.

        Raises:
            CheckpointError: the copy is damaged, or the data is of another tokenizer.
        """
        checkpoint = Checkpoint.open(out / START)
        config = _config_for(checkpoint, recipe, sets, recipe.start)
        return cls(checkpoint, config, recipe.freeze == "trunk", str(recipe.start))

    def network(self, recipe: Recipe) -> HMAConfig:
        """Return the configuration of the checkpoint's network, with the recipe's training options.

        Raises:
            RecipeError: the recipe asks for another network.
        """
        config = self.config
        changes = {"objectives": recipe.objectives}
        for key, value in recipe.model.items():
            if key in OF_THE_TRUNK and self.frozen:
                continue  # for waves, `waves` looks after them: each stem may have its own
            if key == "copy_previous" and not config.discrete:
                continue  # latents are copied from the first step on, which a trained readout does not expect
            if key == WAVES or key in TRAINED_BY or (key in self._off() and not self.frozen):
                changes[key] = value
            elif getattr(config.replace(**{key: value}), key) != getattr(config, key):
                fault = f"is {value!r}, the checkpoint that the run starts from has {getattr(config, key)!r}"
                remedy = "leave it out: the network is the checkpoint's"
                raise RecipeError(f"recipe: model.{key}", fault, remedy)
        digits = recipe.factored(config.spec) if recipe.digits and config.tokenizer else ()
        if digits and config.factored and digits != config.factored:
            fault = f"gives digits of {digits}, the checkpoint has {config.factored}"
            raise RecipeError("recipe: digits", fault, "leave it out: the network is the checkpoint's")
        if (views := view_count(recipe.cameras)) != config.views:
            fault = f"are {views} in a frame, the checkpoint that the run starts from has {config.views}"
            raise RecipeError("recipe: cameras", fault, "name as many, or train from scratch")
        if config.released and recipe.frames > config.frames:
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
        if other := other_actions(self.checkpoint.embodiment(name), shards.embodiment):
            raise CheckpointError(self.source, f"has {other}", "give the robot of the shards another id")
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
        kept = carried(stored.trunk(self.checkpoint), self.checkpoint.config, self.config)
        added = tuple(self._off().values())
        model.load_trunk({n: t for n, t in model.trunk_state().items() if n.startswith(added)} | kept)
        for name in model.embodiments:
            if name in self.checkpoint.embodiments:
                checkpoints.add_embodiment(model, self.checkpoint, name)
        if self.frozen:
            model.get_submodule("trunk").requires_grad_(False)
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
        if self.config.tokenizer != self.checkpoint.config.tokenizer:
            notes.append("other colours than the checkpoint's: each begins as the nearest one")
        if fresh:
            notes.append(f"new stem and head: {', '.join(fresh)}")
        if known:
            notes.append(f"stem, head and statistics from the checkpoint: {', '.join(known)}")
        return notes


def _robots(
    recipe: Recipe, sets: Mapping[str, ShardSet], source: str, revision: str | None, local: bool
) -> tuple[set[str], set[str]]:
    """Return the robots of a checkpoint that the run takes, and those with whose stem a new one may begin."""
    from hma_model.hub.listing import list_embodiments
    from hma_model.hub.stores import embodiment_ids, open_published

    known = embodiment_ids(open_published(source, revision)[1])
    wanted = {name for name in known if name in sets or (recipe.freeze == "trunk" and local)}
    fresh, likes = set(sets) - set(known), set[str]()
    if fresh and recipe.new_stem == "like":
        rows = [row for row in list_embodiments(source, revision) if not row["problems"]]
        cards = {row["embodiment"]: {**row, "effective_hz": row["hz"]} for row in rows}
        for name in fresh:
            some = [one for one in candidates(cards, sets[name].embodiment) if one in known]
            likes |= set(some if local else some[:FETCHED])
    return wanted, likes


def _require_source(source: str, out: Path) -> None:
    """Raise if a resumed run names a checkpoint with another trunk; it may have moved, or be gone."""
    from hma_model.hub.listing import survey

    before = read_json(out / RECIPE).get("start") if (out / RECIPE).is_file() else None
    if before in (None, source):
        return
    address, revision = addressed(source)
    path = Path(address).expanduser()
    if is_repository(address) or "://" in address:
        trunk = survey(address, revision)[0]["trunk_sha256"]
    else:
        trunk = Checkpoint.open(resolve(path)).trunk_sha256 if path.exists() else None
    if trunk not in (None, Checkpoint.open(out / START).trunk_sha256):
        fault = f"was started from {before}, not from {source}"
        raise RecipeError(out, fault, "train into another folder, or name the first")


def _config_for(
    checkpoint: Checkpoint, recipe: Recipe, sets: Mapping[str, ShardSet], where: object
) -> HMAConfig:
    """Return the checkpoint's configuration; that of a tuned trunk has the data's colours.

    Raises:
        CheckpointError: the data is of another tokenizer.
    """
    spec = next(iter(sets.values())).spec
    config = recolored(checkpoint.config, spec)
    try:
        require_tokenizer(checkpoint.config if recipe.freeze == "trunk" else config, spec, where)
    except CheckpointError as fault:
        if config is checkpoint.config:
            raise
        raise CheckpointError(where, fault.fault, f"{fault.remedy}, or tune the trunk too") from fault
    return config
