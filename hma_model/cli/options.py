"""Define the arguments and options that several model verbs share."""

import glob
from pathlib import Path
from typing import Annotated, Literal

from typer import Argument, Option

from hma_data.console import CONTINUE
from hma_data.errors import HMAError, UsageError


def embedded_robots(incomplete: str) -> list[str]:
    """Return the robots of the embedded checkpoint whose ids begin so, for the Tab key."""
    folders = Path(__file__).parents[1].glob(f"embedded*/embodiments/{glob.escape(incomplete)}*")
    return sorted(folder.name for folder in folders)


Checkpoint = Annotated[
    str, Argument(help="A checkpoint, a run's folder, or a hub repo (org/name[@revision]).")
]
Embodiments = Annotated[list[str] | None, Option("--embodiment", "-e", help="Only this robot; repeatable.")]
OfCheckpoint = Annotated[str, Option(help="A checkpoint, a run's folder, or a hub repo.")]
Data = Annotated[Path, Argument(help="A shard set.")]
Split = Annotated[Literal["train", "val"], Option(help="Split of the windows.")]
UnmaskSteps = Annotated[int, Option(min=1, help="Decoding passes per frame of a discrete model.")]
Temperature = Annotated[
    float | None, Option(min=0, help="Sampling temperature; 0 is greedy; default: 0.5, or 0 for latents.")
]
SampleSteps = Annotated[int | None, Option(min=1, help="DDIM steps of a continuous model; default: its own.")]
Precision = Annotated[
    Literal["float32", "bf16", "int8"],
    Option(help="Precision in rollouts; bf16 and int8 (CPUs with VNNI) need hardware support."),
]
Compile = Annotated[
    bool, Option("--compile", help="Compile the trunk: takes a minute, speeds up rollouts on a GPU.")
]
Device = Annotated[str, Option(help="Device: auto (a GPU if available), cpu, cuda or mps.")]
Cameras = Annotated[
    str | None, Option(metavar="NAME[,NAME…]", help="Input cameras of the model; default: as in training.")
]
Seed = Annotated[int, Option(min=0, help="Random seed.")]


def kept(what: str, out: Path | None) -> str:
    """Return what a Ctrl-C leaves in the folder of --out, and how to go on."""
    if out is None:
        return f"nothing is kept; use --out to keep finished {what}"
    return f"finished {what} are kept in {out}; {CONTINUE}"


def device_name(device: str) -> str:
    """Return the device of the option, as torch names it; refuse one that is not here."""
    from hma_model.training.runtime import choose_device

    try:
        return str(choose_device(device))
    except (HMAError, RuntimeError) as fault:
        said = fault.fault if isinstance(fault, HMAError) else f"{device!r} is not a device"
        raise UsageError("--device", said, "use auto or cpu") from fault


def camera_names(cameras: str | None) -> str | list[str] | None:
    """Return the cameras of the option: one name, or a list of several."""
    names = [name.strip() for name in cameras.split(",")] if cameras else []
    return names if len(names) > 1 else cameras


def require_checkpoint(checkpoint: str) -> None:
    """Refuse a folder of this machine that holds no checkpoint; a name in a folder is not one of the hub."""
    from hma_data.storage.paths import is_repository
    from hma_model.checkpoint.folder import resolve

    if "://" in checkpoint or "@" in checkpoint:
        return
    folder = Path(checkpoint).expanduser()
    if folder.parent.is_dir() or not is_repository(checkpoint):
        resolve(folder)
