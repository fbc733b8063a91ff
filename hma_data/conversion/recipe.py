"""Read several conversions from one YAML: `hma convert --recipe recipes/convert/four_robots.yaml`.

    defaults: {tokenizer: fsq-16, workers: 4}     # optional; any key of a job
    jobs:
      - {embodiment: bridge_dataset, source: "gs://…", out: shards/bridge}
      - {embodiment: ./my_arm.yaml, source: ./demos, out: shards/my_arm, frames: strided}

The keys are the options of `hma convert`, with `_` for `-`.
"""

from collections.abc import Sequence
from difflib import get_close_matches
from pathlib import Path
from typing import Any, Literal

from pydantic import BaseModel, ConfigDict, Field, ValidationError

from hma_data.conversion.plan import Settings
from hma_data.errors import RecipeError, UsageError
from hma_data.storage.paths import StrPath, as_path
from hma_data.storage.yaml_io import read_yaml


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
    cameras: tuple[str, ...] = ()
    shard_frames: int | None = Field(None, ge=1)
    val_fraction: float = Field(0.05, ge=0, lt=1)
    seed: int = 0
    max_quarantine: float = Field(0.01, ge=0, le=1)
    episode_timeout: float = Field(300.0, ge=0)

    @property
    def settings(self) -> Settings:
        """Return the settings that decide the plan."""
        return Settings(
            self.frames, self.cameras, self.val_fraction, self.seed, self.limit, self.shard_frames
        )


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
        raise UsageError(name, f"is {first['input']!r}: {first['msg'].lower()}") from fault


def load_jobs(path: StrPath) -> list[ConversionJob]:
    """Return the conversions of a recipe, in its order.

    Args:
        path: str or path of the YAML.

    Raises:
        RecipeError: it has an unknown key, a value of another type, or two jobs with one `out`.
    """
    path = as_path(path)
    values = read_yaml(path, RecipeError)
    if not isinstance(values, dict) or not isinstance(values.get("jobs"), list) or not values["jobs"]:
        raise RecipeError(path, "holds no jobs", "expected `jobs:` with a list, see recipes/convert")
    unknown = sorted(set(values) - {"defaults", "jobs", "description"})
    if unknown:
        raise RecipeError(path, f"unknown key {unknown[0]!r}", "allowed: defaults, jobs, description")
    defaults = values.get("defaults") or {}
    if not isinstance(defaults, dict):
        raise RecipeError(path, "defaults must be a mapping of a job's keys")
    jobs = [_job(defaults, item, f"{path}: jobs[{i}]") for i, item in enumerate(values["jobs"])]
    _refuse_repeated([job.out for job in jobs], path)
    return jobs


def _job(defaults: dict[str, Any], item: Any, where: str) -> ConversionJob:
    if not isinstance(item, dict):
        raise RecipeError(where, f"must be a mapping, is {item!r}")
    try:
        return ConversionJob.model_validate({**defaults, **item})
    except ValidationError as fault:
        first = fault.errors()[0]
        key = ".".join(map(str, first["loc"]))
        known = list(ConversionJob.model_fields)
        if first["type"] == "extra_forbidden":
            near = get_close_matches(key, known, n=1)
            hint = f", did you mean {near[0]!r}?" if near else ""
            raise RecipeError(where, f"unknown key {key!r}{hint}", f"known: {', '.join(known)}") from fault
        if first["type"] == "missing":
            raise RecipeError(where, f"lacks {key}") from fault
        raise RecipeError(where, f"{key} is {first['input']!r}: {first['msg'].lower()}") from fault


def _refuse_repeated(outs: Sequence[Path], path: Path) -> None:
    seen: set[Path] = set()
    for out in outs:
        if out.absolute() in seen:
            raise RecipeError(path, f"two jobs write {out}", "give each an out of its own")
        seen.add(out.absolute())
