"""Define the verb `hma view`: an episode, or a run beside its truth, in Rerun."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

from typer import Argument, Option

from hma_data.cli.options import robot_option
from hma_data.console import say
from hma_data.errors import UsageError
from hma_model.cli.play import has_display

if TYPE_CHECKING:
    from hma_data.inspection.view import View


def view(
    place: Annotated[str, Argument(help="A recording (with -e), a shard set, or a training run.")],
    data: Annotated[
        list[Path] | None, Argument(help="For a run: its shard sets, if they were moved.")
    ] = None,
    embodiment: Annotated[
        str | None, robot_option("Robot of a recording: a registry id, or a YAML file.")
    ] = None,
    episode: Annotated[
        int, Option(min=0, help="Index of the episode; for a run, of the held-out window.")
    ] = 0,
    tokenizer: Annotated[str | None, Option(help="For a recording: also show its decoded tokens.")] = None,
    out: Annotated[Path | None, Option(help="The .rrd file; by default the viewer opens.")] = None,
) -> None:
    """Show an episode in Rerun: cameras, decoded tokens, actions, states and skew on one clock.

    For a run, it shows losses, learning rate, gradient norm, step times, and a held-out window next to its
    prediction. Without a display, it writes the file to the current folder.

    Example: hma view shards/my_arm --out my_arm.rrd
    """
    if out is not None and out.suffix != ".rrd":
        raise UsageError("--out", f"{out} does not end in .rrd")
    from hma_data.inspection.view import rerun

    rerun()
    made = _made(place, data or [], embodiment, episode, tokenizer)
    if out is None and has_display():
        made.open()
        return
    path = out or Path(f"{Path(place).resolve().stem}.rrd")
    made.save(path)
    say(f"wrote {path}; rerun {path} opens it")


def _made(
    place: str, data: list[Path], embodiment: str | None, episode: int, tokenizer: str | None
) -> "View":
    from hma_data.inspection.view import view_recording, view_shards
    from hma_data.storage.kinds import kind_of
    from hma_model.checkpoint.folder import BUNDLED

    kind = kind_of(Path(place).expanduser())
    if place in BUNDLED and not Path(place).exists():
        kind = "a checkpoint"
    if not kind and not Path(place).expanduser().exists() and "://" not in place:
        raise UsageError(place, "does not exist", "name a recording (with -e), a shard set or a run")
    if data and kind in ("a shard set", "a recording"):
        raise UsageError("DATA", f"is for a checkpoint, and {place} is {kind}", "leave it out")
    if tokenizer and kind in ("a shard set", "a checkpoint"):
        raise UsageError("--tokenizer", f"is for a recording, and {place} is {kind}", "leave it out")
    if embodiment is None and kind == "a checkpoint":
        from hma_model.training.view import view_run

        return view_run(Path(place).expanduser(), episode, data)
    if embodiment is None and kind == "a recording":
        remedy = "add -e ROBOT; hma registry infer writes the YAML of a new one"
        raise UsageError(place, "is a recording, whose robot is not named", remedy)
    if embodiment is None:
        return view_shards(place, episode)
    return view_recording(place, embodiment, episode, tokenizer)
