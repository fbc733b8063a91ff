"""Define the verb `hma evaluate`: the table of metrics, and the page."""

import json as json_text
import shlex
import sys
from collections.abc import Sequence
from decimal import Decimal, InvalidOperation
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

from typer import Argument, Option

from hma_data.console import interruptible, print_lines, print_table
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

FIGURES = {  # figures of `hma evaluate` as its table names them; the others have their names in the JSON
    "against": "compared with",
    "unmoved_windows": "windows whose pictures never change",
    "draws": "draws of shuffled actions",
    "loss": "loss, nats a token",
    "stored_loss": "loss, nats a stored token",
    "shuffled_loss": "loss with shuffled actions",
    "baseline_loss": "loss of token frequencies alone",
    "accuracy": "accuracy, share of tokens",
    "masked_perplexity": "perplexity of tokens masked as in training",
    "masked_accuracy": "accuracy of these",
    "psnr_action_gain_last": "last frame, true less shuffled, dB",
}
ROLLOUTS = ("true", "shuffled", "none", "copy")
HIDDEN = ("checkpoint", "data", "seconds_a_frame", "sees_actions", "merge")  # of the readable form
MEASURES = {"lpips": "LPIPS", "fid": "FID", "fvd": "FVD"}
DIGITS = {"ssim": 3, "lpips": 3}  # of the figures of rollouts; the others have two


def evaluate(
    checkpoint: Checkpoint,
    data: Annotated[list[Path], Argument(help="Shard sets.")],
    beside: Annotated[
        list[str] | None, Option(help="Another checkpoint to compare; repeat for more.")
    ] = None,
    split: Split = "val",
    windows: Annotated[int, Option(min=1, help="Number of windows, evenly spaced.")] = 64,
    frames: Annotated[int | None, Option(min=2, help="Frames of a window; by default the model's.")] = None,
    prompt: Annotated[int | None, Option(min=1, help="Number of true frames to start from.")] = None,
    unmask_steps: UnmaskSteps = 2,
    sample_steps: SampleSteps = None,
    precision: Precision = "float32",
    compile: Compile = False,
    device: Device = "auto",
    seed: Annotated[int, Option(min=0, help="Seed of the rollouts.")] = 0,
    cameras: Cameras = None,
    paper: Annotated[
        bool, Option("--paper", help="Also follow the paper's protocol: Gaussian actions, true past.")
    ] = False,
    state: Annotated[
        bool,
        Option(
            "--state",
            help="Measure what the robot does in the pictures, against its recorded or simulated state.",
        ),
    ] = False,
    episodes: Annotated[
        int, Option(min=2, help="Episodes that --state simulates of a laboratory robot.")
    ] = 32,
    lpips: Annotated[
        str | None, Option(metavar="FILE#SHA256", help="TorchScript of LPIPS, with its hash.")
    ] = None,
    fid: Annotated[str | None, Option(metavar="FILE#SHA256", help="TorchScript of FID's Inception.")] = None,
    fvd: Annotated[str | None, Option(metavar="FILE#SHA256", help="TorchScript of FVD's I3D.")] = None,
    out: Annotated[Path | None, Option(help="Folder for results.json, results.md and report.html.")] = None,
    json: Annotated[
        bool, Option("--json", help="Print one JSON object a line, for each checkpoint and set.")
    ] = False,
) -> None:
    """Measure how well rollouts predict: with the true actions, another window's, none, and beside a copy.

    With --out, what is finished is kept, and the same command continues.

    Example: hma evaluate runs/first shards/my_arm --out evaluation
    """
    from hma_data.shards.reader import ShardSet

    checkpoints = [checkpoint, *(beside or [])]
    for folder in data:
        ShardSet(folder)  # it and the checkpoints are refused before torch is imported
    for name in checkpoints:
        require_checkpoint(name)
    with interruptible(lambda: kept("parts", out)):
        from hma_model.evaluation.perceptual import open_networks
        from hma_model.evaluation.suite import Settings, evaluate_all

        sampling: dict[str, Any] = {"unmask_steps": unmask_steps, "sample_steps": sample_steps}
        sampling |= {"precision": precision, "compile": compile}
        settings = Settings(
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
    elif len(parts) == 1:
        _print_one(parts[0])
    else:
        _print_table(parts)
    if out is not None and not json:
        print(f"open {page}")


def _print_one(part: "Part") -> None:
    found = part.found
    hidden = HIDDEN if found.get("merge", 1) > 1 else (*HIDDEN, "stored_loss")
    plain = [
        [_figure(key, found), value, _ends(found.get(f"{key}_95"))]
        for key, value in found.items()
        if not isinstance(value, dict | list) and key not in hidden and not key.endswith("_95")
    ]
    print_table(["figure", "value", "95 %"], plain)
    columns = {"psnr": "PSNR dB", "psnr_last": "last frame dB", "ssim": "SSIM"}
    columns |= {key: name for key, name in MEASURES.items() if key in found["true"]}
    rows = [
        [name, *(_rounded(found[name].get(key), key) for key in columns), _ends(found[name]["psnr_last_95"])]
        for name in ROLLOUTS
    ]
    print_table(["rollout", *columns.values(), "last frame, 95 %"], rows)
    print(
        f"true: the window's actions; shuffled: another window's, mean of {found['draws']} draws; "
        "none: without actions; copy: the prompt's last frame, repeated"
    )
    if paper := found.get("paper"):
        said = [[key, value, _ends(paper.get(f"{key}_95"))] for key, value in paper.items()]
        print_table(["the paper's protocol", "value", "95 %"], [row for row in said if row[0][-3:] != "_95"])
    _print_state(found.get("state"))
    _print_absences([part])
    from hma_model.evaluation.evaluate import verdict

    print(f"{part.checkpoint} {verdict(found)}")


def _print_state(state: dict[str, Any] | None) -> None:
    if not state or "true" not in state:
        return
    if "values" in state:
        _print_recorded_state(state)
        return
    rows = [
        [
            name,
            *(_rounded(state[name][key], key) for key in ("error_px", "error_px_last")),
            _ends(state[name]["error_px_last_95"]),
        ]
        for name in (*ROLLOUTS, "reconstruction")
    ]
    print_table(["robot's place", "error px of 128", "last frame", "95 %"], rows)
    noisy = state["perturbed"]
    rows = [
        [words, noisy[f"psnr{mark}"], noisy[f"psnr{mark}_last"], noisy.get(f"perplexity{mark}")]
        for words, mark in (("true", ""), (f"perturbed by {noisy['scale']:g} standard deviations", "_star"))
    ]
    print_table(["commands", "PSNR dB", "last frame dB", "perplexity"], rows)
    print(f"{state['episodes']} simulated episodes; the probe errs by {state['probe_px']:.2f} px")


def _print_recorded_state(state: dict[str, Any]) -> None:
    kinds = (*ROLLOUTS, "reconstruction")
    rows: list[list[Any]] = [
        [
            name,
            *(_rounded(state[name][key], key) for key in ("error_sd", "error_sd_last")),
            _ends(state[name]["error_sd_last_95"]),
        ]
        for name in kinds
    ]
    print_table(["recorded state", "error, standard deviations", "last frame", "95 %"], rows)
    rows = [[row["name"], row["unit"], *(row[kind] for kind in kinds)] for row in state["values"]]
    print_table(["last frame, error of", "unit", *kinds], rows)
    print(
        f"{state['read']} of {state['of']} values can be read off the pictures; what reads them errs by "
        f"{state['reader_sd']:.2f} standard deviations on true pictures of other episodes"
    )


def _figure(key: str, found: dict[str, Any]) -> str:
    """Return the name of a figure; what is of squares of tokens says so."""
    from hma_model.config import token_words

    side, name = found.get("merge") or 1, FIGURES.get(key, key)
    square = f"{side}×{side}"
    if side == 1:
        return name
    names = {
        "loss": f"loss, nats a {token_words(side)}",
        "perplexity": f"perplexity of squares of {square} tokens",
        "accuracy": f"accuracy, share of squares of {square}",
    }
    return names.get(key, name)


def _ends(ends: Sequence[float] | None) -> str | None:
    return None if not ends or None in ends else f"{ends[0]:.4g} to {ends[1]:.4g}"


def _print_table(parts: "Sequence[Part]") -> None:
    from hma_model.evaluation.tables import renamed, rows, verdicts

    parts, legend = renamed(parts)
    print_lines(legend)
    names, lines = rows(parts, intervals=False)
    if len({part.checkpoint for part in parts}) == 1:  # the same in every row, and perhaps long
        print(parts[0].checkpoint)
        names, lines = names[1:], [line[1:] for line in lines]
    repeated = names.index("robot") + 1
    print_table(names, [[_number(cell) for cell in line] for line in lines], repeated=repeated)
    _print_absences(parts)
    for whose, said in verdicts(parts):
        print(f"{whose} {said}")


def _number(cell: Any) -> Any:
    try:
        return Decimal(cell) if isinstance(cell, str) else cell
    except InvalidOperation:
        return cell


def _rounded(value: float | None, key: str) -> Decimal | None:
    return None if value is None else Decimal(f"{value:.{DIGITS.get(key, 2)}f}")


def _print_absences(parts: "Sequence[Part]") -> None:
    from hma_model.evaluation.tables import absences

    print_lines(absences(parts))
