"""Open and check a checkpoint's folder without reading weights.

    config.json                  format version, architecture, tokenizer spec
    trunk.safetensors            tensors that all embodiments share
    embodiments/<id>/            stem.safetensors, head.safetensors, embodiment.yaml, stats.json, card.json
    README.md                    the model card, made from the card.json files
    training/                    optimizer and sampler state; never published

Every card and every stem holds the SHA-256 of the trunk, and the digests of the tokenizer and of the
statistics that the stem was trained on. Parts that do not belong together are therefore refused.
Files of another `FORMAT_VERSION` are refused.
"""

import json
from collections.abc import Iterable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hma_data.errors import CheckpointError, HMAError
from hma_data.registry.embodiment import FIRST_CAMERA, ID_PATTERN, Embodiment
from hma_data.storage.files import file_sha256, opened_weights, read_json, short_sha256
from hma_data.storage.kinds import misplaced, unreadable
from hma_data.storage.paths import StrPath, as_path
from hma_model.config import HMAConfig

if TYPE_CHECKING:
    from hma_data.loading.views import Cameras
    from hma_data.shards.reader import ShardSet
    from hma_data.tokenizers.base import TokenizerSpec

LIBRARY, FORMAT_VERSION = "hma-toolkit", 1
CONFIG, TRUNK, README, TRAINING = "config.json", "trunk.safetensors", "README.md", "training"
STEM, HEAD, YAML, STATS, CARD = (
    "stem.safetensors", "head.safetensors", "embodiment.yaml", "stats.json", "card.json",
)  # fmt: skip
PARTS = (STEM, HEAD, YAML, STATS, CARD)  # the card is last: its presence means that the others are there
SAMPLE, FILM = "sample.png", "sample.gif"
PICTURES = (SAMPLE, FILM)  # optional, shown in the model card
EMBEDDED_NAME = "embedded"
BUNDLED = {  # the later, the better with a robot that several have
    f"embedded-{part}": Path(__file__).parents[1] / f"embedded-{part}"
    for part in ("fsq", "lab", "lab2", "lab3", "fetch", "pusht")
}
_OTHER_TRUNK = "pull the embodiment and its trunk together, or finetune it on this trunk"
_CUT_SHORT = "a push or pull was interrupted: run it again"
_OTHER_YAML = "restore the one that it was trained with; change descriptions in the card instead"


@dataclass(frozen=True)
class ActionStats:
    """Mean and standard deviation (A,) of the raw actions, as `stats.json` states them.

    `zero_variance` is "divide" in an imported released model; see `ActionSpace`.
    """

    mean: list[float]
    std: list[float]
    zero_variance: str = "zero"


@dataclass(frozen=True)
class Checkpoint:
    """A checkpoint's folder, checked as far as possible without reading weights.

    It is opened once and passed on: each file is hashed once for each object. What is missing, damaged or
    does not belong together raises a CheckpointError with the file and the reason.

    Attributes:
        config: of the network; the tokenizer's spec is in it.
        embodiments: ids present, sorted.
        trunk_sha256: of the trunk, as config.json states it.
        tokenizer: digest of its spec.
    """

    folder: Path
    config: HMAConfig
    embodiments: tuple[str, ...]
    trunk_sha256: str
    tokenizer: str
    _hashes: dict[Path, str] = field(default_factory=dict, repr=False, compare=False)

    @classmethod
    def open(
        cls, checkpoint: "StrPath | Checkpoint", embodiments: Iterable[str] | None = None
    ) -> "Checkpoint":
        """Open the checkpoint in a folder, or the newest one in the folder of a training run.

        Args:
            checkpoint: str or path of it; an open one is returned as it is.
            embodiments: as of `resolve`.
        """
        if isinstance(checkpoint, Checkpoint):
            return checkpoint
        folder = resolve(checkpoint, embodiments)
        values = read_json(inside(folder, CONFIG))
        config = parse_config(values, folder / CONFIG)
        tokenizer = digest(values["tokenizer"])
        return cls(folder, config, embodiments_in(folder), str(values.get("trunk_sha256")), tokenizer)

    @property
    def name(self) -> str:
        """Return its folder, or the name of a bundled one, as an error names it."""
        return self.folder.name if self.bundled else str(self.folder)

    @property
    def bundled(self) -> bool:
        """Return whether it is part of the installed package."""
        return self.folder in BUNDLED.values()

    def _sha256(self, path: Path) -> str:
        if path not in self._hashes:
            self._hashes[path] = file_sha256(path)
        return self._hashes[path]

    def trunk(self) -> Path:
        """Return the path of trunk.safetensors, after checking its SHA-256."""
        path = inside(self.folder, TRUNK)
        if self._sha256(path) != self.trunk_sha256:
            remedy = "pull the checkpoint again, into a new folder"
            raise CheckpointError(path, *unreadable(path, f"is another trunk than {CONFIG} names", remedy))
        return path

    def chosen(self, embodiments: Iterable[str] | None) -> list[str]:
        """Return the requested embodiments, each once; None requests all."""
        wanted = list(dict.fromkeys(self.embodiments if embodiments is None else embodiments))
        for name in wanted:
            check_id(name, self.name)
            if name not in self.embodiments:
                parts = BUNDLED.values() if self.folder == BUNDLED["embedded-fsq"] else ()
                there = sorted({*self.embodiments}.union(*map(embodiments_in, parts)) - {name})
                known = f"it has: {', '.join(there) or 'none'}"
                raise CheckpointError(self.name, f"has no embodiment {name!r}", known)
        return wanted

    def path(self, embodiment: str, part: str) -> Path:
        """Return the path of a file of an embodiment."""
        self.chosen([embodiment])
        return inside(self.folder, f"embodiments/{embodiment}/{part}")

    def card(self, embodiment: str) -> dict[str, Any]:
        """Return card.json of an embodiment."""
        path = self.path(embodiment, CARD)
        values = read_json(path)
        _require_version(values, path)
        return values

    def cards(self, embodiments: Iterable[str] | None = None) -> dict[str, dict[str, Any]]:
        """Return the cards of embodiments by id; None means all."""
        return {name: self.card(name) for name in self.chosen(embodiments)}

    def cameras(self, embodiment: str) -> "Cameras":
        """Return the cameras that a stem was trained on, as its card names them; by default the first one."""
        stated = value_of(self.card(embodiment).get("data"), "cameras")
        names = [stated] if isinstance(stated, str) else stated
        if not (isinstance(names, list) and names and all(isinstance(name, str) for name in names)):
            return FIRST_CAMERA
        if len(names) != self.config.views:
            fault = f"names {len(names)} cameras, but a frame of the model has {self.config.views}"
            raise CheckpointError(self.path(embodiment, CARD), fault, "pull or save the checkpoint again")
        return stated

    def pictures(self, embodiment: str) -> list[str]:
        """Return the names of the sample picture and film that an embodiment has."""
        home = self.folder / "embodiments" / embodiment
        return [name for name in PICTURES if (home / name).is_file()]

    def files(self, embodiment: str) -> dict[str, Path]:
        """Return the files of an embodiment by name, the pictures first and the card last."""
        parts = (*self.pictures(embodiment), *PARTS)
        return {f"embodiments/{embodiment}/{part}": self.path(embodiment, part) for part in parts}

    def embodiment(self, embodiment: str) -> Embodiment:
        """Return the embodiment as it was at training."""
        return Embodiment.load(self.path(embodiment, YAML))

    def stats(self, embodiment: str) -> dict[str, Any]:
        """Return stats.json of an embodiment: at least {"action": {"mean": [...], "std": [...]}}."""
        path = self.path(embodiment, STATS)
        values = read_json(path)
        action_stats(values, path)
        return values

    def shards(self) -> "list[ShardSet]":
        """Open the shard sets of the run that wrote this checkpoint, as far as they are still here."""
        from hma_data.shards.reader import ShardSet  # imports pyarrow

        recipe = self.folder.parent.parent / "recipe.json"
        if self.folder.parent.name != "checkpoints" or not recipe.is_file():
            return []
        sets = []
        for folder in read_json(recipe).get("data", ()):
            with suppress(HMAError):  # it was moved or removed
                sets.append(ShardSet(folder))
        return [one for one in sets if one.embodiment.id in self.embodiments]

    def check(self, embodiment: str) -> None:
        """Check that an embodiment's parts belong to this trunk, tokenizer and statistics."""
        path, card = self.path(embodiment, STEM), self.card(embodiment)
        stem = read_metadata(path)
        stats = self._sha256(self.path(embodiment, STATS))
        _require_same(path, stem, "embodiment", embodiment, "was saved for another embodiment")
        for where, facts in ((path, stem), (self.path(embodiment, CARD), card)):
            _require_same(where, facts, "trunk_sha256", self.trunk_sha256, "belongs to another trunk")
            _require_same(where, facts, "tokenizer", self.tokenizer, "was trained on another tokenizer")
            other = f"was trained with other statistics than {STATS}"
            _require_same(where, facts, "stats_sha256", stats, other, _CUT_SHORT)
        files = card.get("files")
        for part, remedy in ((STEM, _CUT_SHORT), (HEAD, _CUT_SHORT), (YAML, _OTHER_YAML)):
            path = self.path(embodiment, part)
            if not isinstance(files, dict) or files.get(part) != self._sha256(path):
                raise CheckpointError(path, f"is not the file that {CARD} names", remedy)


def parse_config(values: dict[str, Any], where: object) -> HMAConfig:
    """Return the network's config, read from the values of config.json."""
    if values.get("library") != LIBRARY:
        remedy = "give a checkpoint of hma train; hma hub import converts one of the paper's release"
        raise CheckpointError(where, f"is not of {LIBRARY}: library is {values.get('library')!r}", remedy)
    _require_version(values, where)
    model, tokenizer = values.get("model"), values.get("tokenizer")
    if not isinstance(model, dict) or not isinstance(tokenizer, dict):
        raise CheckpointError(where, "lacks its 'model' or 'tokenizer'", "pull or save the checkpoint again")
    try:
        return HMAConfig.from_json({**model, "tokenizer": tokenizer}, str(where))
    except (HMAError, TypeError, ValueError) as fault:
        raise CheckpointError(where, f"does not describe a model: {fault}", "update or save again") from fault


def _require_version(values: Mapping[str, Any], where: object) -> None:
    found = values.get("format_version")
    if found != FORMAT_VERSION:
        fault = f"has format_version {found!r}, this release reads {FORMAT_VERSION}"
        raise CheckpointError(where, fault, "update hma-toolkit, or save the checkpoint again")


def resolve(folder: StrPath, embodiments: Iterable[str] | None = None, tokenizer: str | None = None) -> Path:
    """Return the folder of a checkpoint: the path itself, or the newest of a run's `checkpoints/`.

    Args:
        folder: str or path of it, or the name of a checkpoint bundled with the package. The name `embedded`
            stands for the best of these that has the embodiments, and is of the tokenizer if one is.
        embodiments: ids of the robots that are wanted.
        tokenizer: name of that of the data.
    """
    folder = as_path(folder)
    if (folder / CONFIG).is_file():
        return folder
    if str(folder) in BUNDLED and not folder.exists():
        return BUNDLED[str(folder)]
    if str(folder) == EMBEDDED_NAME and not folder.exists():
        return _best(list(embodiments or ()), tokenizer)
    steps = training_checkpoints(folder)
    if steps:
        return steps[-1]
    if found := misplaced(folder, "a checkpoint"):
        raise CheckpointError(folder, *found)
    fault = f"has no {CONFIG} and no checkpoints/" if folder.is_dir() else "no such folder"
    raise CheckpointError(folder, fault, "give a checkpoint, or the folder of a training run")


def _best(embodiments: list[str], tokenizer: str | None) -> Path:
    """Return the bundled checkpoint that the name `embedded` stands for."""
    homes = {one: [f for f in BUNDLED.values() if one in embodiments_in(f)] for one in embodiments}
    shared = [folder for folder in BUNDLED.values() if all(folder in found for found in homes.values())]
    if not shared and all(homes.values()):
        where = " and ".join(f"{one} is in {found[-1].name}" for one, found in homes.items())
        fault = f"{where}: no network has all of them"
        raise CheckpointError(EMBEDDED_NAME, fault, "name robots of one network")
    if tokenizer is not None:
        of = {f: Checkpoint.open(f).config.tokenizer["name"] for f in shared}
        shared = [folder for folder in shared if of[folder] == tokenizer] or shared
    return shared[-1] if shared and embodiments else (shared or [*BUNDLED.values()])[0]


def embodiments_in(folder: Path) -> tuple[str, ...]:
    """Return the ids of a checkpoint's embodiments."""
    return tuple(sorted(path.parent.name for path in folder.glob(f"embodiments/*/{CARD}") if path.is_file()))


def training_checkpoints(run: StrPath) -> list[Path]:
    """Return the checkpoints of a training run (str or path of its folder), oldest first."""
    return sorted(path for path in (as_path(run) / "checkpoints").glob("step-*") if (path / CONFIG).is_file())


def read_metadata(path: Path) -> dict[str, str]:
    """Read the metadata in the header of a safetensors file."""
    with opened_weights(path) as file:  # the header alone needs no torch
        return file.metadata() or {}


def inside(folder: Path, name: str) -> Path:
    """Return the path of a file of a checkpoint; raise CheckpointError if it is not there."""
    path = folder / name
    if not path.is_file():
        raise CheckpointError(path, "no such file", "pull or save the checkpoint again")
    return path


def check_id(embodiment: str, where: object) -> None:
    """Raise CheckpointError unless the name is an embodiment's id."""
    if not ID_PATTERN.fullmatch(embodiment) or ".." in embodiment:
        raise CheckpointError(where, f"{embodiment!r} is not an embodiment's id", "ids are of a-z 0-9 _ - .")


def digest(tokenizer: Mapping[str, Any]) -> str:
    """Return sixteen hex digits of the SHA-256 of a tokenizer's spec."""
    return short_sha256(json.dumps(dict(tokenizer), sort_keys=True))


def require_tokenizer(config: HMAConfig, spec: "TokenizerSpec", where: object) -> None:
    """Raise CheckpointError, which names the difference, unless the model was trained on this tokenizer.

    The hashes of the tokenizer's weights are not compared if the model states none, as in released models.
    """
    ours, theirs = dict(config.tokenizer), spec.to_json()
    if not ours.get("weights_sha256"):
        ours["weights_sha256"] = theirs["weights_sha256"]
    differing = [key for key in sorted(ours | theirs) if ours.get(key) != theirs.get(key)]
    if differing:
        key, name = differing[0], ours.get("name")
        fault = f"the model was trained on tokenizer {name!r}, the data is of {spec.name!r}"
        if key == "colors" and "name" not in differing:
            fault = f"the model was trained on other colours of {name!r}"
        if key == "colors" or "name" in differing:
            remedy = f"convert the recordings with --tokenizer {name}"
            raise CheckpointError(where, fault, remedy + (_own_colors(config) if ours.get("colors") else ""))
        fault = f"{fault}: {key} is {ours.get(key)!r} there and {theirs.get(key)!r} here"
        if differing == ["resize_filter"]:
            remedy = f"convert the recordings with --tokenizer {name}:{ours.get(key)}"
            raise CheckpointError(where, fault, remedy)
        raise CheckpointError(where, fault, f"use the tokenizer described in its {CONFIG}")


def _own_colors(config: HMAConfig) -> str:
    """Return the option of `hma convert` that takes the colours of a model; none for the default ones."""
    from hma_data.tokenizers.shapes import get_spec

    with suppress(HMAError):  # an installed package may lack this tokenizer
        if config.tokenizer["colors"] == get_spec(str(config.tokenizer["name"])).colors:
            return ""
    for folder in BUNDLED.values():
        if Checkpoint.open(folder).config.tokenizer == config.tokenizer:
            return f" --weights {folder / CONFIG}"
    return f" --weights PATH, the path of the model's {CONFIG}"


def value_of(values: Any, key: str) -> Any:
    """Return the value of a key of a card's part; None also if the part is no object."""
    return values.get(key) if isinstance(values, dict) else None


def action_stats(stats: Mapping[str, Any], where: object) -> ActionStats:
    """Return the mean and std of the actions from the values of stats.json."""
    try:
        action = stats["action"]
        rule = str(action.get("zero_variance", "zero"))
        keys = ("mean", "std", *(key for key in ("min", "max") if key in action))
        mean, std, *ends = ([float(v) for v in action[key]] for key in keys)
    except (AttributeError, KeyError, TypeError, ValueError) as fault:
        raise CheckpointError(where, "lacks action.mean or action.std as lists of numbers") from fault
    if any(len(end) != len(mean) for end in ends):
        raise CheckpointError(where, "has action.min or action.max of another length than action.mean")
    return ActionStats(mean, std, rule)


def _require_same(
    where: Path, facts: Mapping[str, Any], key: str, expected: str, fault: str, remedy: str = _OTHER_TRUNK
) -> None:
    found = facts.get(key)
    if found != expected:
        shown = f"its {key} is {str(found)[:16]}, here it is {expected[:16]}"
        raise CheckpointError(where, f"{fault}: {shown}", remedy)
