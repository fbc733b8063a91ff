"""Read several conversions from one YAML: `hma convert --recipe recipes/convert/four_robots.yaml`.

    defaults: {tokenizer: fsq-16, workers: 4}     # optional; any key of a job
    jobs:
      - {embodiment: bridge_dataset, source: "gs://…", out: shards/bridge}
      - {embodiment: ./my_arm.yaml, source: ./demos, out: shards/my_arm, frames: strided, cameras: all}

The keys are the options of `hma convert`, with `_` for `-`.
"""

from difflib import get_close_matches
from pathlib import Path
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError

from hma_data.conversion.plan import Settings
from hma_data.errors import RecipeError, UsageError
from hma_data.storage.paths import StrPath, as_path
from hma_data.storage.yaml_io import read_yaml


def _names(value: Any) -> Any:
    """Split `a,b` and `[a, "b,c"]` into names."""
    texts = [value] if isinstance(value, str) else value
    if not isinstance(texts, list | tuple) or not all(isinstance(text, str) for text in texts):
        return value
    return tuple(name for text in texts for word in text.split(",") if (name := word.strip()))


class ConversionJob(BaseModel):
    """One conversion; its defaults are those of the command."""

    model_config = ConfigDict(extra="forbid", frozen=True)

    embodiment: str
    out: Path
    source: str | None = None
    tokenizer: str = "fsq-16"
    weights: str | None = None
    device: str = "cpu"
    workers: int = Field(1, ge=0)
    engine: Literal["local", "ray"] = "local"
    limit: int | None = Field(None, ge=1)
    frames: Literal["all", "strided"] = "all"
    frequency_hz: float | None = Field(None, gt=0, allow_inf_nan=False)
    cameras: Annotated[tuple[str, ...], BeforeValidator(_names)] = ()
    shard_frames: int | None = Field(None, ge=1)
    val_fraction: float = Field(0.05, ge=0, lt=1)
    seed: int = 0
    max_quarantine: float = Field(0.01, ge=0, le=1)
    episode_timeout: float = Field(300.0, ge=0)
    only: tuple[str, ...] = ()
    exclude: tuple[str, ...] = ()

    @property
    def settings(self) -> Settings:
        """Return the settings that decide the plan."""
        return Settings(
            self.frames,
            self.cameras,
            self.val_fraction,
            self.seed,
            self.limit,
            self.shard_frames,
            self.only,
            self.exclude,
        )


class _Recipe(BaseModel):
    model_config = ConfigDict(extra="forbid")

    description: str = ""
    defaults: dict[str, Any] = {}
    jobs: list[dict[str, Any]] = Field(min_length=1)


def job_of_options(**values: Any) -> ConversionJob:
    """Return the conversion that the command's options state.

    Raises:
        UsageError: an option has a value that is not allowed.
    """
    try:
        return ConversionJob(**values)
    except ValidationError as fault:
        first = fault.errors()[0]
        name = "--" + "-".join(map(str, first["loc"])).replace("_", "-")
        raise UsageError(name, f"is {first['input']!r}, {_rule(first['msg'])}") from fault


def load_jobs(path: StrPath) -> list[ConversionJob]:
    """Return the conversions of a recipe, in its order.

    Args:
        path: str or path of the YAML.

    Raises:
        RecipeError: it has an unknown key, a value of another type, or two jobs with one `out`.
    """
    path = as_path(path)
    recipe = _valid(_Recipe, read_yaml(path, RecipeError), str(path))
    jobs: list[ConversionJob] = []
    for number, item in enumerate(recipe.jobs):
        job = _valid(ConversionJob, {**recipe.defaults, **item}, f"{path}: jobs[{number}]")
        if any(job.out.absolute() == other.out.absolute() for other in jobs):
            raise RecipeError(path, f"two jobs write {job.out}", "give each an out of its own")
        jobs.append(job)
    return jobs


def _valid[T: BaseModel](model: type[T], values: Any, where: str) -> T:
    try:
        return model.model_validate(values)
    except ValidationError as fault:
        first = fault.errors()[0]
        key, known = ".".join(map(str, first["loc"])) or "the recipe", list(model.model_fields)
        remedy = f"the keys are {', '.join(known)}; see recipes/convert"
        if first["type"] == "extra_forbidden":
            near = get_close_matches(key, known, n=1)
            hint = f", did you mean {near[0]!r}?" if near else ""
            raise RecipeError(where, f"has the unknown key {key!r}{hint}", remedy) from fault
        if first["type"] == "missing":
            raise RecipeError(where, f"lacks {key}", remedy) from fault
        raise RecipeError(where, f"{key} is {first['input']!r}, {_rule(first['msg'])}", remedy) from fault


def _rule(message: str) -> str:
    """Return pydantic's message in our words: must be less than 1."""
    return message.lower().replace("input should be", "must be")
