"""Read a training recipe, a frozen object, from YAML and dotted overrides.

    extends: discrete_tiny          # another recipe, by name or path beside this one
    data: [shards/arm, shards/hand]
    model: {layers: 4, width: 128}
    lr: 1e-3

A recipe refuses unknown keys. The values that the shards state (kind, grid, vocabulary, latents) are derived
from them and cannot be given. All faults are reported at once, before any shard is opened.
"""

import math
from collections.abc import Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any, Literal, get_type_hints

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    StrictBool,
    ValidationError,
    create_model,
)  # fmt: skip

from hma_data.errors import HMAError, RecipeError, UsageError, meant
from hma_data.loading.views import view_count
from hma_data.shards.reader import ShardSet
from hma_data.storage.paths import StrPath, as_text, shipped
from hma_data.storage.yaml_io import parse_yaml, plain_fault, read_yaml
from hma_data.tokenizers.base import TokenizerSpec
from hma_model.checkpoint.folder import BUNDLED, EMBEDDED_NAME, resolve
from hma_model.config import MOST_IDS, HMAConfig

# keys that may change when a run is resumed: places and intervals, but nothing that changes the weights
_FREE = {
    *("data", "out", "start", "device", "workers", "parallel", "compile", "checkpointing"),
    *("eval_every", "eval_windows", "pictures", "pictures_share", "checkpoint_every", "keep_last"),
    *("report", "track", "project"),
}
_DERIVED = {
    *("kind", "grid", "views", "factored", "channels", "latent_scale", "frames", "objectives", "tokenizer"),
}
_PATTERN = "must be auto, cpu, mps, cuda or cuda:N"  # only `device` has a pattern


def _no_bool(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError("must be a number, not true or false")
    return value


def _listed(value: Any) -> Any:
    return [value] if isinstance(value, str) else value


def _named(value: str) -> str:
    if not value.strip():
        raise ValueError("must name a folder or URI")
    return str(Path(value).expanduser()) if value.startswith("~") else value  # no shell has expanded it


def _words(value: Any) -> Any:
    if isinstance(value, str) or (isinstance(value, list) and all(isinstance(v, str) for v in value)):
        return value
    raise ValueError("must be a word or a list of words")


def _cameras(value: Any) -> str | tuple[str, ...]:
    if isinstance(value, str) and value:
        return value
    if isinstance(value, list | tuple) and value and all(isinstance(v, str) and v for v in value):
        return tuple(value)
    raise ValueError("must be first, drawn, a camera's name, or a list of names")


Count = Annotated[int, BeforeValidator(_no_bool)]
Number = Annotated[float, BeforeValidator(_no_bool), Field(allow_inf_nan=False)]
Steps = Annotated[Count, Field(ge=0)]
Share = Annotated[Number, Field(ge=0, le=1)]
Beta = Annotated[Number, Field(ge=0, lt=1)]
Cap = Annotated[Number, Field(gt=0, le=1)]
Place = Annotated[str, AfterValidator(_named)]
Places = Annotated[tuple[Place, ...], BeforeValidator(_listed)]
Trackers = Annotated[tuple[Literal["tensorboard", "trackio", "wandb"], ...], BeforeValidator(_listed)]


CameraChoice = Annotated[Any, AfterValidator(_cameras)]


class _Settings(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True)


_WORDS = Annotated[Any, AfterValidator(_words)]
_TYPES: dict[Any, Any] = {int: Count, float: Number, bool: StrictBool, str: str, tuple[str, ...]: _WORDS}
_TYPES[tuple[int, ...]] = tuple[Count, ...]
_NETWORK: dict[str, Any] = {
    name: (_TYPES[kind], None) for name, kind in get_type_hints(HMAConfig).items() if name not in _DERIVED
}
_Network = create_model("_Network", __base__=_Settings, **_NETWORK)


class MixtureSettings(_Settings):
    """The settings of how often each embodiment is drawn; see `hma_data.loading.mixture`."""

    temperature: Number = Field(3.0, gt=0)
    draw: Literal["per_sample", "per_batch"] = "per_sample"
    weights: dict[str, Number] = Field({}, description="embodiment id -> factor on its probability")
    groups: dict[str, str] = Field({}, description="embodiment id -> group; groups have equal shares")
    caps: dict[str, Cap] = Field({}, description="embodiment id -> maximum probability")
    max_epochs: Number | None = Field(None, gt=0, description="maximum passes over an embodiment's windows")


class Recipe(_Settings):
    """The settings of a training run. `load_recipe` makes it and explains its errors."""

    data: Places = Field((), description="shard sets, one per embodiment")
    cameras: CameraChoice = Field("first", description="first, drawn, a name, or a list of stacked views")
    mixture: MixtureSettings = MixtureSettings()
    frames: Count = Field(12, ge=2, le=4096, description="frames T per window")
    short: Literal["drop", "pad"] = Field("drop", description="rule for episodes shorter than a window")
    batch_size: Count = Field(8, ge=1, description="windows per forward pass")
    accumulate: Count = Field(1, ge=1, description="forward passes per step")
    model: dict[str, Any] = Field({}, description="keys of the network, [below](#model)")
    objectives: dict[str, Number] = Field({"forward": 1.0}, description="objective -> sampling weight")

    start: Place | None = Field(None, description="a checkpoint to start from: folder, run, URI or hub repo")
    freeze: Literal["nothing", "trunk"] = Field("nothing", description="part whose weights stay fixed")
    new_stem: Literal["like", "fresh"] = Field(
        "like", description="with start: initialise a new stem from a similar robot's, or fresh"
    )
    # a token's digits: the tokenizer's, or split into this many values (FSQ's levels) or joined up to them
    digits: Count = Field(0, ge=0, description="values per digit: 8 (splits 512) or 512; 0: as the tokenizer")
    # model.merge or model.patch, unless the recipe gives it, is the least that leaves so few
    places: Count = Field(0, ge=0, description="maximum trunk tokens per camera frame; 0: no limit")

    steps: Count = Field(1000, ge=1, le=10**12)
    # an end by time in steps; lr then falls by the share that is spent. CPU time is that of a rank's threads
    seconds: Number = Field(0.0, ge=0, description="maximum seconds of training steps; 0: no limit")
    cpu_seconds: Number = Field(0.0, ge=0, description="maximum CPU seconds of training steps; 0: no limit")
    lr: Number = Field(3e-4, gt=0, le=1e6)
    optimizer: Literal["adamw", "muon"] = Field("adamw", description="muon: for the blocks' matrices")
    muon_lr: Number = Field(0.02, gt=0, le=1e3, description="muon: maximum spectral norm of a step")
    lr_rule: Literal["plain", "paper"] = Field(
        "plain", description="paper: lr × windows per step / 64 (1 to 8)"
    )
    warmup: Steps = Field(100, description="warm-up steps of lr from 0")
    schedule: Literal["constant_with_warmup", "cosine"] = "constant_with_warmup"
    lr_end: Share = Field(0.1, description="cosine: final lr as a share of lr")
    betas: tuple[Beta, Beta] = (0.9, 0.95)
    eps: Number = Field(1e-8, gt=0, le=1e6)
    weight_decay: Number = Field(0.05, ge=0, le=1e6)
    clip: Number = Field(1.0, gt=0, description="limit of the gradient norm")
    nonfinite: Literal["stop", "skip"] = Field("stop", description="at a non-finite loss: stop, or skip it")
    ema: Beta = Field(0.0, description="decay of averaged weights, which are evaluated and saved; 0: off")
    self_forward: Share = Field(0.0, description="share of windows with a self-predicted past")
    self_forward_frames: Count = Field(2, ge=1, description="self-predicted frames in a row (U-Net: minimum)")
    self_forward_from: Steps = Field(0, description="first step with self-predicted pasts, from 0")
    whole_from: Share = Field(
        1.0, description="with model.crop: share of the run after which frames are whole"
    )

    seed: Count = Field(42, ge=0, lt=2**63)
    precision: Literal["auto", "fp32", "bf16"] = Field(
        "auto", description="of matrix products; auto: bf16 where it is faster"
    )
    device: str = Field("auto", pattern=r"^(auto|cpu|mps|cuda(:\d+)?)$")
    parallel: Literal["ddp", "fsdp"] = Field("ddp", description="with torchrun: parallelism of the network")
    compile: bool = Field(False, description="torch.compile of the trunk's blocks")
    checkpointing: bool = Field(False, description="recompute activations: less memory, a third more time")
    workers: Count = Field(1, ge=0, le=512, description="prefetch threads per rank")
    eval_every: Steps = Field(250, description="steps between evaluations; 0: only at the end")
    eval_windows: Count = Field(64, ge=1, description="validation windows per embodiment")
    pictures: Steps = Field(1, description="windows per robot that an evaluation rolls out as images")
    pictures_share: Number = Field(0.05, ge=0, description="maximum share of time for these images")
    checkpoint_every: Steps = Field(250, description="steps between checkpoints; 0: only at the end")
    keep_last: Count = Field(3, ge=1, description="number of checkpoints to keep")
    report: bool = Field(True, description="write report.html")
    track: Trackers = Field((), description="experiment trackers; each needs its package")
    project: str = Field("hma", description="project name in trackio and wandb")
    out: Place | None = Field(None, description="the run's folder")

    @property
    def windows_per_step(self) -> int:
        """Return the number of windows of a step, between two updates of the weights."""
        return self.batch_size * self.accumulate

    @property
    def ends_by_time(self) -> bool:
        """Return whether the run may end before its steps are done."""
        return bool(self.seconds or self.cpu_seconds)

    def values(self) -> dict[str, Any]:
        """Return all settings as plain values."""
        return self.model_dump(mode="json")

    def identity(self) -> dict[str, Any]:
        """Return the settings that must be the same when a run is resumed."""
        return {key: value for key, value in self.values().items() if key not in _FREE}

    def factored(self, spec: TokenizerSpec) -> tuple[int, ...]:
        """Return the values of each digit of a token of this tokenizer, low digit first.

        With `digits`, each of the tokenizer's digits is split into as many of that many values as divide it,
        and neighbours are joined as long as they have no more values than that.
        """
        stated = spec.factored or (spec.vocab_size or 1,)
        if self.digits < 2:
            return stated
        split: list[int] = []
        for values in stated:
            while values % self.digits == 0:
                split.append(self.digits)
                values //= self.digits
            split += [values] if values > 1 else []
        joined = split[:1]
        for values in split[1:]:
            if joined[-1] * values <= self.digits:
                joined[-1] *= values
            else:
                joined.append(values)
        return tuple(joined)

    def network(self, spec: TokenizerSpec) -> HMAConfig:
        """Return the network's config for tokens of this tokenizer.

        Raises:
            RecipeError: a value of `model` is not allowed.
        """
        derived: dict[str, Any] = {"kind": spec.kind, "grid": spec.grid, "tokenizer": spec.to_json()}
        if spec.kind == "discrete":
            derived["factored"] = self.factored(spec)
        else:
            derived.update(channels=spec.channels, latent_scale=spec.latent_scale)
        derived |= self._side(spec)
        derived.update(frames=self.frames, objectives=self.objectives, views=view_count(self.cameras))
        return HMAConfig(**{**self.model, **derived})

    def _side(self, spec: TokenizerSpec) -> dict[str, int]:
        """Return the side of the squares or patches for `places`; nothing if the recipe gives it."""
        name = "merge" if spec.kind == "discrete" else "patch"
        if not self.places or name in self.model:
            return {}
        values = math.prod(self.factored(spec)) if spec.kind == "discrete" else 1
        sides = [
            side for side in range(1, min(spec.grid) + 1) if not any(length % side for length in spec.grid)
        ]
        allowed = [side for side in sides if values**side**2 < MOST_IDS]
        enough = [side for side in allowed if math.prod(spec.grid) // side**2 <= self.places]
        return {name: (enough or allowed[-1:] or [1])[0]}


def load_recipe(name_or_path: StrPath, overrides: Sequence[str] = ()) -> Recipe:
    """Read the recipe of a YAML file, with overrides.

    Args:
        name_or_path: str or path of a file, or the name of a recipe that comes with the package.
        overrides: `key=value` with dots for keys inside keys, values as YAML: `model.layers=4`.

    Raises:
        RecipeError: there is no such recipe; or all its problems, each with key, value and allowed values.
        UsageError: an override is not key=value.
    """
    path = find_recipe(name_or_path)
    values = _extended(path, [])
    own = values.get("objectives", Recipe.model_fields["objectives"].default)
    if any(one.startswith("objectives.") for one in overrides):
        values = {**values, "objectives": own}
    values = parse_overrides(overrides, values)
    return make_recipe(values, f"{path}" + (" with overrides" if overrides else ""))


def make_recipe(values: Mapping[str, Any], where: str = "recipe") -> Recipe:
    """Make a recipe of plain values; it raises the errors of `load_recipe`."""
    faults: list[str] = []
    given = dict(values)
    if isinstance(given.get("model"), dict):
        network = _validated(_Network, given["model"], "model.", faults)
        given["model"] = {key: getattr(network, key) for key in given["model"]} if network else {}
    recipe = _validated(Recipe, given, "", faults)
    if recipe is not None and not faults:
        # any grid that the patches divide, and digits so few that they may be merged, will do for this check
        side = recipe.model.get("patch", 1) * recipe.model.get("merge", 1)
        side *= 2 ** len(recipe.model.get("levels", HMAConfig.levels)) * max(recipe.model.get("crop", 0), 1)
        continuous = recipe.model.get("video_loss") == "regression"
        try:
            given = {"patch": 1, **recipe.model, "objectives": recipe.objectives}
            kind = "continuous" if continuous else "discrete"  # until the tokenizer is known
            HMAConfig(**given, kind=kind, grid=(side, side), factored=(2,))
            return recipe
        except RecipeError as fault:
            key = fault.where.replace("model.objectives", "objectives")
            faults.append(f"{key}: {fault.fault}: {fault.remedy}")
    raise RecipeError(where, "; ".join(faults), "correct the recipe or the override")


def find_recipe(name_or_path: StrPath, where: object = None) -> Path:
    """Return the file of a recipe: a path, or a name below the shipped `recipes/` or `recipes/train/`.

    `where` is the recipe that extends it, for the error.

    Raises:
        RecipeError: there is no such recipe.
    """
    name = as_text(name_or_path)
    folder = shipped("recipes")
    for path in (Path(name), folder / "train" / f"{name}.yaml", folder / f"{name}.yaml", folder / name):
        if path.is_file():
            return path
    known = sorted(path.stem for path in (folder / "train").glob("*.yaml"))
    hint = meant(Path(name).stem.lower(), known, 1)
    remedy = f"{hint} Give" if hint else "give"
    remedy = f"{remedy} a YAML file or one of {', '.join(known)}"
    if where is not None:
        raise RecipeError(where, f"extends {name!r}: no such recipe", remedy)
    raise RecipeError(name, "no such recipe", remedy)


def recipe_for(source: StrPath, data: StrPath) -> str:
    """Return the name of the recipe by which a model is finetuned on a shard set where none is given."""
    name = as_text(source)
    folder = BUNDLED.get(name)
    if name == EMBEDDED_NAME:
        tokenizer = None
        with suppress(HMAError):  # the run says what is wrong with the shards
            tokenizer = ShardSet(data).spec.name
        folder = resolve(name, tokenizer=tokenizer)
    if folder == BUNDLED["embedded-fsq"]:
        return "finetune_tiny"
    return "finetune_colors" if folder in BUNDLED.values() else "finetune"


def parse_overrides(overrides: Sequence[str], base: Mapping[str, Any] | None = None) -> dict[str, Any]:
    """Parse overrides such as `["model.layers=4", "lr=1e-3"]` to nested values, one after the other.

    `objectives={policy: 1}` replaces the objectives of `base`, `objectives.policy=1` adds one.

    Raises:
        UsageError: an override is not key=value.
    """
    values = dict(base or {})
    for override in overrides:
        key, equals, text = override.partition("=")
        parts = key.strip().split(".")
        if not equals or not all(parts):
            raise UsageError(f"override {override!r}", "is not key=value", "write for example model.layers=4")
        nested = parse_yaml(text, f"override {override!r}", UsageError)
        for part in reversed(parts):
            nested = {part: nested}
        if parts[0] == "objectives" and len(parts) > 1:
            values["objectives"] = merge(values.get("objectives", {}), nested["objectives"])
        else:
            values = merge(values, nested)
    return values


def merge(base: Mapping[str, Any], over: Mapping[str, Any]) -> dict[str, Any]:
    """Merge mappings key by key; other values, and objectives, of `over` replace those of `base`."""
    merged = dict(base)
    for key, value in over.items():
        if isinstance(value, dict) and isinstance(merged.get(key), dict) and key != "objectives":
            merged[key] = merge(merged[key], value)
        else:
            merged[key] = value
    return merged


def differences(old: Any, new: Any, path: str = "") -> list[str]:
    """Return the differences of two recipes' values, one an entry, such as `lr: 0.001, now 0.002`."""
    if isinstance(old, dict) and isinstance(new, dict):
        return [
            line
            for key in sorted(old.keys() | new.keys())
            for line in differences(old.get(key), new.get(key), f"{path}.{key}" if path else str(key))
        ]
    return [] if old == new else [f"{path}: {old!r}, now {new!r}"]


def _extended(path: Path, seen: list[Path]) -> dict[str, Any]:
    """Read the values of a recipe's file, merged over those of the recipe that it extends."""
    if path.resolve() in seen:
        chain = " -> ".join(p.name for p in [*seen, path])
        raise RecipeError(path, f"extends itself: {chain}", "extend another recipe")
    values = read_yaml(path, RecipeError) or {}
    if not isinstance(values, dict):
        fault = f"must be a mapping, is {type(values).__name__}"
        raise RecipeError(path, fault, "write keys with values, as in steps: 1000")
    base = values.pop("extends", None)
    if base is None:
        return values
    if not isinstance(base, str):
        fault = f"extends must name a recipe, is {base!r}"
        raise RecipeError(path, fault, "name one, as in extends: discrete_tiny")
    beside = (path.parent / base, path.parent / f"{base}.yaml")
    found = next((p for p in beside if p.is_file()), None) or find_recipe(base, path)
    return merge(_extended(found, [*seen, path.resolve()]), values)


# -- faults of the values


def _validated[Model: BaseModel](
    kind: type[Model], values: Mapping[str, Any], home: str, faults: list[str]
) -> Model | None:
    """Return the validated values, or None after adding their faults to `faults`."""
    try:
        return kind.model_validate(values)
    except ValidationError as fault:
        faults += [_problem(item, home) for item in fault.errors(include_url=False)]
        return None


def _problem(item: Any, home: str) -> str:
    """Describe one of pydantic's errors: the key, the allowed values, the value, and a likely correction."""
    path = home + ".".join(str(part) for part in item["loc"] if part != "[key]")
    kind, near = item["type"], ""
    if kind == "extra_forbidden":
        return _unknown(path)
    text = _PATTERN if kind == "string_pattern_mismatch" else plain_fault(item)
    if kind == "literal_error":
        allowed = item["ctx"]["expected"].replace(" or ", ", ").replace("'", "").split(", ")
        near = meant(str(item["input"]).lower(), allowed, 1)
    value = repr(item["input"])
    value = value if len(value) <= 80 else f"{value[:77]}…"
    return f"{path}: {text}{near and f', {near}'} (is {value})"


def _unknown(path: str) -> str:
    """Describe an unknown key, and suggest a key of the same mapping or of another one."""
    known = {"": Recipe.model_fields, "mixture": MixtureSettings.model_fields, "model": _Network.model_fields}
    home, _, key = path.rpartition(".")
    if path == "extends":
        return "extends: cannot be an override: write it in the recipe's file"
    if home == "model" and key in _DERIVED:
        return f"{path}: follows from the shards and the recipe, and cannot be given"
    inside = [f"{name}.{key}" for name in ("mixture", "model") if not home and key in known[name]]
    near = meant(key, inside, 1, cutoff=0) or meant(key.lower(), known[home], 1)
    return f"{path}: unknown key{near and f', {near}'}"
