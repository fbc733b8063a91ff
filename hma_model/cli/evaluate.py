"""Define the verb `hma evaluate`: the table of metrics, and the page."""

import json as json_text
import shlex
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option

from hma_data.console import interruptible, print_lines, say
from hma_model.cli.options import (
    Cameras,
    Checkpoint,
    Compile,
    Device,
    Precision,
    SampleSteps,
    Split,
    UnmaskSteps,
    camera_names,
    device_name,
    kept,
    require_checkpoint,
)

if TYPE_CHECKING:
    from hma_model.evaluation.suite import Part


def evaluate(
    checkpoint: Checkpoint,
    data: Annotated[list[Path], Argument(help="Shard sets.")],
    compare: Annotated[list[str] | None, Option(help="Another checkpoint to compare; repeatable.")] = None,
    split: Split = "val",
    windows: Annotated[int, Option(min=1, help="Number of windows, evenly spaced.")] = 64,
    frames: Annotated[int | None, Option(min=2, help="Frames per window; default: the model's.")] = None,
    prompt: Annotated[int | None, Option(min=1, help="Number of recorded frames to start from.")] = None,
    unmask_steps: UnmaskSteps = 2,
    sample_steps: SampleSteps = None,
    precision: Precision = "float32",
    compile: Compile = False,
    device: Device = "auto",
    seed: Annotated[int, Option(min=0, help="Seed of the rollouts.")] = 0,
    cameras: Cameras = None,
    paper: Annotated[
        bool, Option("--paper", help="Also use the paper's protocol: Gaussian actions, recorded past.")
    ] = False,
    state: Annotated[
        bool,
        Option(
            "--state",
            help="Compare the robot's state in the predicted frames with the recorded or simulated one.",
        ),
    ] = False,
    episodes: Annotated[
        int, Option(min=2, help="Episodes that --state simulates for a simulated robot.")
    ] = 32,
    lpips: Annotated[
        str | None, Option(metavar="FILE#SHA256", help="TorchScript of LPIPS, with its hash.")
    ] = None,
    fid: Annotated[str | None, Option(metavar="FILE#SHA256", help="TorchScript of FID's Inception.")] = None,
    fvd: Annotated[str | None, Option(metavar="FILE#SHA256", help="TorchScript of FVD's I3D.")] = None,
    out: Annotated[Path | None, Option(help="Folder for results.json, results.md and report.html.")] = None,
    json: Annotated[
        bool, Option("--json", help="Print one line of JSON for each checkpoint and set.")
    ] = False,
) -> None:
    """Measure rollouts under recorded, shuffled and no actions, and a copy of the last given frame.

    With --out, finished parts are kept, and the same command continues.

    Example: hma evaluate runs/first shards/my_arm --out evaluation
    """
    from hma_data.shards.reader import ShardSet

    checkpoints = [checkpoint, *(compare or [])]
    for folder in data:
        ShardSet(folder)  # it and the checkpoints are refused before torch is imported
    for name in checkpoints:
        require_checkpoint(name)
    with interruptible(lambda: kept("parts", out)):
        from hma_model.evaluation.perceptual import open_networks
        from hma_model.evaluation.suite import EvaluationSettings, evaluate_all

        sampling: dict[str, Any] = {"unmask_steps": unmask_steps, "sample_steps": sample_steps}
        sampling |= {"precision": precision, "compile": compile}
        settings = EvaluationSettings(
            split, windows, frames, prompt, seed=seed, cameras=camera_names(cameras), paper=paper,
            state=episodes if state else 0, sampling=sampling,
        )  # fmt: skip
        networks = open_networks(lpips, fid, fvd)
        parts = evaluate_all(checkpoints, data, settings, networks, out, device_name(device))
        if out is not None:
            from hma_model.evaluation.report import write_results

            page = write_results(parts, out, shlex.join(["hma", *sys.argv[1:]]))
    if json:
        for part in parts:
            print(json_text.dumps(part.found, ensure_ascii=False))
    else:
        _print(parts)
    if out is not None and not json:
        say(f"open {page}")


def _print(parts: "Sequence[Part]") -> None:
    from hma_model.evaluation.tables import absences, comparison, conditions, renamed, single, state, verdicts

    parts, legend = renamed(parts)
    print_lines(legend)
    if len(parts) == 1:
        found = parts[0].found
        print(conditions(found))
        single(parts[0]).print()
        for table, about in state(found.get("state")):
            table.print()
            if about:
                print(about)
    else:
        comparison(parts, intervals=False).print()
    print_lines(absences(parts))
    for whose, said in verdicts(parts):
        say(f"{whose} {said}")
