"""Define the settings of a conversion, each with its help text; `hma convert` makes options of them.

Only light modules are imported here.
"""

from dataclasses import asdict, dataclass, field
from functools import partial
from pathlib import PurePath
from typing import TYPE_CHECKING, Any, Literal

from hma_data.errors import UsageError

if TYPE_CHECKING:
    from hma_data.registry.embodiment import Embodiment


def _option(default: Any, help: str, panel: str | None = None, **option: Any) -> Any:
    """Return a field that is an option of the command line too, in a panel of its --help."""
    return field(default=default, metadata={"help": help, "rich_help_panel": panel, **option})


_data = partial(_option, panel="Selection and split")
_jobs = partial(_option, panel="Several machines")
_existing = partial(_option, panel="If --out holds a shard set")


def _episodes(what: str) -> Any:
    return _data((), f"{what}: id, glob, or @FILE with one per line; repeatable.", metavar="ID|GLOB|@FILE")


def _names(words: list[str]) -> list[str]:
    return [name.strip() for word in words for name in word.split(",") if name.strip()]


@dataclass(frozen=True)
class Settings:
    """What the plan, and so every byte, depends on.

    `choose_splits` explains the split, `chosen_cameras` the cameras, `chosen_ids` the choice of episodes, and
    `hma_data.episodes.idle` when nothing moves.
    """

    frames: Literal["all", "strided"] = _data("all", "Keep all rows, or only those at the model's rate.")
    cameras: tuple[str, ...] = _option(
        (),
        "Cameras to store; default: the YAML's first, with --to lerobot all.",
        param_decls=("--cameras", "--camera"),
        metavar="all|NAME[,NAME…]",
        callback=_names,
    )
    val_fraction: float | None = _data(
        None,
        "Share of episodes for validation; default: 5 %, but at least 5 episodes (a quarter if fewer than "
        "20); with --to lerobot 0.",
    )
    seed: int = _data(0, "Seed of the split.")
    limit: int | None = _option(None, "Convert only the first N episodes.", min=1)
    shard_frames: int | None = _option(None, "Approximate frames per shard.", "Rarely needed", min=1)
    only: tuple[str, ...] = _episodes("Convert only this episode")
    exclude: tuple[str, ...] = _episodes("Leave out this episode")
    drop_idle: bool = _data(False, "With --to lerobot, leave out frames in which nothing moves.")

    def __post_init__(self) -> None:
        for name in ("cameras", "only", "exclude"):
            object.__setattr__(self, name, tuple(getattr(self, name)))
        if self.val_fraction is not None and not 0 <= self.val_fraction < 1:
            raise UsageError("--val-fraction", f"must be at least 0 and below 1, not {self.val_fraction:g}")
        for name, value in (("--limit", self.limit), ("--shard-frames", self.shard_frames)):
            if value is not None and value < 1:
                raise UsageError(name, f"must be at least 1, is {value}")

    def facts(self, cameras: list[str]) -> dict[str, Any]:
        """Return the settings as the plan states them, without a choice of episodes that was not made."""
        values = asdict(self) | {"cameras": cameras}
        if not self.drop_idle:
            del values["drop_idle"]
        for name in ("only", "exclude"):
            words = values.pop(name)
            if words:  # the plan's digest of the recording covers the ids in a file
                values[name] = [f"@{PurePath(word).name}" if word.startswith("@") else word for word in words]
        return values

    def frame_stride(self, embodiment: "Embodiment") -> int:
        """Return the recorded steps a row; the plan, and with it every shard, states this number."""
        return embodiment.stride if self.frames == "strided" else 1


@dataclass(frozen=True, kw_only=True)
class Options:
    """How a conversion is carried out, and what becomes of episodes that it refuses.

    With `engine="ray"`, fractions let several workers share a CPU or a GPU.
    """

    to: Literal["shards", "lerobot"] = _option("shards", "Output format.")
    device: str = _option("cpu", "Device of the tokenizer: cpu, cuda, mps.")
    engine: Literal["local", "ray"] = _jobs("local", "Engine that runs the workers.")
    worker_cpus: float = _jobs(1.0, "CPUs per Ray worker.", min=0)
    worker_gpus: float | None = _jobs(None, "GPUs per Ray worker; default: 1 with --device cuda.", min=0)
    max_quarantine: float = _option(
        0.01, "Fail if a larger share of episodes is refused.", "Bad episodes", min=0, max=1
    )
    extend: bool = _existing(False, "Add the episodes that the set in --out does not have yet.")
    overwrite: bool = _existing(False, "Delete the shard set in --out first.")
