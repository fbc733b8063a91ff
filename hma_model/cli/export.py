"""Define the verb `hma export`: ONNX graphs of a checkpoint, and a page that drives them without a server."""

from functools import cache
from pathlib import Path
from shlex import quote
from typing import Annotated, Any

from typer import Argument, Option

from hma_data.console import say
from hma_model.cli.options import Checkpoint, Embodiments, UnmaskSteps, require_checkpoint


def export(
    checkpoint: Checkpoint,
    out: Annotated[Path, Option(help="Folder to write; an older export there is replaced.")],
    data: Annotated[
        list[Path] | None, Argument(help="Shard sets whose held-out episodes provide first frames.")
    ] = None,
    embodiment: Embodiments = None,
    starts: Annotated[int, Option(min=1, max=20, help="Scenes per robot to start from.")] = 3,
    unmask_steps: UnmaskSteps = 2,
    half: Annotated[
        bool, Option("--half/--float32", help="Store weights in float16 if that costs less than 0.1 dB.")
    ] = True,
    runtime: Annotated[
        Path | None,
        Option(
            "--with-runtime", metavar="PACKAGE",
            help="Copy ONNX Runtime Web from this npm package (node_modules/onnxruntime-web) to the page; by "
            "default the page takes it from a CDN.",
        ),
    ] = None,
) -> None:  # fmt: skip
    """Write ONNX graphs of a model, and a page that drives its robots in a browser without a server.

    Example: hma export embedded --out page -e rails_03
    """
    made = export_checkpoint(
        checkpoint, data or [], out, embodiment, starts=starts, unmask_steps=unmask_steps, half=half,
        runtime=runtime,
    )  # fmt: skip
    parts = [made["step"], *(robot["stem"] for robot in made["robots"])]
    size = sum(part["bytes"] for part in parts) / 1e6
    robots = len(made["robots"])
    said = f"{robots} robot{'s' * (robots != 1)}, graphs of {size:.1f} MB with weights in {made['weights']}"
    if made["float16_loss_db"] is not None:
        said += f" (float16 costs {made['float16_loss_db']:.2f} dB)"
    say(f"wrote {out}: {said}")
    say(f"drive it: python -m http.server --bind 127.0.0.1 -d {quote(str(out))}")


def export_checkpoint(
    checkpoint: str,
    data: list[Path],
    out: Path,
    embodiments: list[str] | None,
    name: str | None = None,
    **settings: Any,
) -> dict[str, Any]:
    """Export robots of a checkpoint; return the manifest."""

    from hma_model.export import require_onnx

    require_onnx()  # before torch is imported
    from hma_data.errors import UsageError
    from hma_data.shards.reader import ShardSet
    from hma_model.hub.publish import located
    from hma_model.worlds.scenes import Drivable, drivable, trained_on

    sets = list(map(ShardSet, data))
    require_checkpoint(checkpoint)
    opened, ids = located(checkpoint, embodiments)

    @cache
    def tokenizer() -> Any:
        from hma_data.tokenizers.base import reopened

        return reopened(opened.config.tokenizer)

    chosen: dict[str, Drivable] = {}
    offered = drivable(opened, sets or trained_on(opened), tokenizer).values()
    for robot in sorted(offered, key=lambda one: ("simulator", "recordings", "images").index(one.source)):
        if robot.embodiment.id in ids:
            chosen.setdefault(robot.embodiment.id, robot)
    if not chosen:
        raise UsageError("--embodiment", "none has frames to start from", "give shards of one")
    if lacking := [name for name in ids if name not in chosen]:
        say(f"left out, no frames to start from: {', '.join(lacking)}", err=True)
    from hma_model.checkpoint.io import load
    from hma_model.export.folder import export_folder

    model = load(opened, list(chosen), "cpu").eval()
    shown = name or ("the bundled model" if opened.bundled else Path(checkpoint).name)
    robots = list(chosen.values())

    def report(said: str) -> None:
        say(f"export: {said}", err=True)

    return export_folder(model, tokenizer(), robots, out, name=shown, report=report, **settings)
