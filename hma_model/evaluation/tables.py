"""Put the results of several checkpoints and shard sets into tables; name each figure once.

A mean over sets counts each set once; its interval is that of the mean. The mean perplexity is exp of the
mean loss.
"""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from decimal import Decimal
from typing import Any

from hma_data.console import human_count, short_paths
from hma_data.storage.files import finite
from hma_data.tables import Table
from hma_model.evaluation.intervals import ANY, NATURAL, SHARE, over_datasets
from hma_model.evaluation.metrics import PSNR_GAIN_RANGE, PSNR_RANGE, SSIM_RANGE, perplexity
from hma_model.evaluation.suite import Part
from hma_model.evaluation.verdict import verdict

MEAN = "mean over sets"
ROLLOUTS = {  # kind -> what the model was given
    "true": "the window's own actions",
    "shuffled": "another window's actions",
    "none": "no actions",
    "copy": "the prompt's last frame, repeated",
    "reconstruction": "the true images, from their tokens",  # of the state's tables only
}


@dataclass(frozen=True)
class Figure:
    """A figure of `hma evaluate`, as its tables show it.

    Attributes:
        name: its heading.
        path: where the result has it, such as `true.psnr`.
        digits: after the point.
        meaning: in words.
        by_window: its key among the values of windows, of which the mean over sets is made; empty if none.
        within: what those values can be.
        exponential: whether it is exp of the mean of those values.
        detail: whether only the list of a single checkpoint and set has it.
    """

    name: str
    path: str
    digits: int
    meaning: str
    by_window: str = ""
    within: tuple[float, float] = ANY
    exponential: bool = False
    detail: bool = False


def _of_windows(name: str, path: str, digits: int, meaning: str, within: tuple[float, float]) -> Figure:
    return Figure(name, path, digits, meaning, by_window=path, within=within)


FIGURES = (
    Figure("loss", "loss", 3, "nats per token (or square of tokens), given the recorded past", detail=True),
    Figure("loss, shuffled", "shuffled_loss", 3, "the same with shuffled actions", detail=True),
    Figure("loss, frequencies", "baseline_loss", 3, "the same from token frequencies alone", detail=True),
    Figure(
        "perplexity", "perplexity", 2,
        "of fully masked frames, given the recorded past; per square if the model merges tokens",
        by_window="loss", within=NATURAL, exponential=True,
    ),
    Figure("nats/token", "stored_loss", 3, "loss per stored token, comparable between models of a tokenizer"),
    Figure(
        "masked", "masked_perplexity", 2, "perplexity of the tokens that training masks, under its masks",
        by_window="masked_loss", within=NATURAL, exponential=True,
    ),
    Figure("masked accuracy", "masked_accuracy", 3, "share of these tokens that are correct", detail=True),
    _of_windows("accuracy", "accuracy", 3, "share of correct tokens (or squares), recorded past", SHARE),
    _of_windows("PSNR", "true.psnr", 2, "dB, mean over the horizon of rollouts", PSNR_RANGE),
    _of_windows("PSNR last", "true.psnr_last", 2, "dB, last frame", PSNR_RANGE),
    _of_windows(
        "ΔPSNR", "psnr_action_gain_last", 2, "dB, last frame, recorded vs shuffled actions", PSNR_GAIN_RANGE
    ),
    _of_windows("SSIM", "true.ssim", 3, "mean over the horizon", SSIM_RANGE),
    _of_windows("LPIPS", "true.lpips", 3, "AlexNet, mean over the horizon", NATURAL),
    Figure("FID", "true.fid", 1, "of all predicted frames"),
    Figure("FVD", "true.fvd", 1, "of the predicted parts of windows"),
    _of_windows(
        "ΔPSNR (paper)", "paper.delta_psnr", 2,
        "dB, last frame after the recorded past, recorded vs Gaussian actions", PSNR_GAIN_RANGE,
    ),
    Figure("PSNR last (paper)", "paper.psnr_last", 2, "dB, the same frame, recorded actions", detail=True),
    Figure("PSNR Gaussian (paper)", "paper.gaussian_psnr_last", 2, "dB, Gaussian actions", detail=True),
    Figure("perplexity (paper)", "paper.perplexity", 2, "mean over batches of four windows", detail=True),
    Figure("state px", "state.true.error_px_last", 2, "error of the robot's place, last frame, px of 128"),
    Figure(
        "state sd", "state.true.error_sd_last", 2,
        "error of the recorded state at the last frame, in its standard deviations",
        by_window="state.error_sd_last", within=NATURAL,
    ),
    _of_windows(
        "PSNR shuffled", "shuffled.psnr_last", 2, "dB, last frame, another window's actions", PSNR_RANGE
    ),
    _of_windows("PSNR none", "none.psnr_last", 2, "dB, last frame, without actions", PSNR_RANGE),
    _of_windows("PSNR copy", "copy.psnr_last", 2, "dB, the prompt's last frame repeated", PSNR_RANGE),
)  # fmt: skip
MEANINGS = {figure.name: figure.meaning for figure in FIGURES}


def renamed(parts: Sequence[Part]) -> tuple[list[Part], list[tuple[str, str]]]:
    """Return the parts under short names of their checkpoints, and the pairs (short, full) that differ."""
    names = short_paths(list(dict.fromkeys(part.checkpoint for part in parts)))
    legend = [(short, name) for name, short in names.items() if short != name]
    return [replace(part, checkpoint=names[part.checkpoint]) for part in parts], legend


def value(found: Mapping[str, Any], path: str) -> Any:
    """Return a figure by its path, such as `true.psnr`; None where it is absent. Means have paths as keys."""
    if path in found:
        return found[path]
    item: Any = found
    for key in path.split("."):
        item = item.get(key) if isinstance(item, Mapping) else None
    return item


# -- several checkpoints and sets


def present(parts: Sequence[Part]) -> list[Figure]:
    """Return the figures that some part has; details of a single part only."""
    return [
        figure
        for figure in FIGURES
        if (len(parts) == 1 or not figure.detail)
        and any(value(part.found, figure.path) is not None for part in parts)
    ]


def means(parts: Sequence[Part]) -> list[dict[str, Any]]:
    """Return for each checkpoint the means over its sets, with their intervals."""
    found = []
    for label in dict.fromkeys(part.checkpoint for part in parts):
        own = [part for part in parts if part.checkpoint == label]
        row = {"checkpoint": label, "embodiment": MEAN, "sets": len(own)}
        row["windows"] = sum(part.found["windows"] for part in own)
        row["episodes"] = sum(part.found["episodes"] for part in own)
        for figure in present(own):
            of_sets = [value(part.found, figure.path) for part in own]
            if None in of_sets:
                continue
            if not figure.by_window:
                row[figure.path] = round(sum(of_sets) / len(of_sets), 4)
                continue
            recordings = [part.by_window["recording"] for part in own]
            values = [part.by_window[figure.by_window] for part in own]
            mean, ends = over_datasets(values, recordings, figure.within)
            scaled = perplexity if figure.exponential else float
            row[figure.path] = round(scaled(mean), 4)
            row[f"{figure.path}_95"] = ends and [round(scaled(end), 4) for end in ends]
        found.append(row)
    return found


def results(parts: Sequence[Part]) -> dict[str, Any]:
    """Return the content of results.json."""
    return finite({"results": [part.found for part in parts], "means": means(parts)})


def comparison(parts: Sequence[Part], intervals: bool = True) -> Table:
    """Return the table of all parts: a row a checkpoint and set, then the means over sets."""
    figures = present(parts)
    rows: list[list[Any]] = []
    for average in means(parts):
        label = average["checkpoint"]
        own = [part.found for part in parts if part.checkpoint == label]
        for found in [*own, average] if len(own) > 1 else own:
            cells = [_cell(found, figure, intervals) for figure in figures]
            rows.append([label, found["embodiment"], found["windows"], found["episodes"], *cells])
    return Table(["checkpoint", "robot", "windows", "episodes", *(figure.name for figure in figures)], rows)


def turned(parts: Sequence[Part]) -> Table:
    """Return the table of all parts with a row a figure; a second line has its meaning, or its interval."""
    table = comparison(parts)
    several = len({part.checkpoint for part in parts}) > 1
    heads = [f"{row[0]}\n{row[1]}" if several else row[1] for row in table.rows]
    rows = []
    for column, name in enumerate(table.columns[2:], 2):
        about = f"{name}\n{MEANINGS.get(name, '')}"
        rows.append([about, *(_interval_below(row[column]) for row in table.rows)])
    return Table(["figure", *heads], rows)


def _interval_below(cell: Any) -> Any:
    return cell.replace(" [", "\n", 1).rstrip("]").replace(", ", " to ") if isinstance(cell, str) else cell


def _cell(found: Mapping[str, Any], figure: Figure, intervals: bool) -> str | Decimal | None:
    number, ends, digits = value(found, figure.path), value(found, f"{figure.path}_95"), figure.digits
    if number is None or not ends or not intervals:
        return _digits(number, digits)
    return f"{number:.{digits}f} [{ends[0]:.{digits}f}, {ends[1]:.{digits}f}]"


def _digits(figure: float | None, digits: int) -> Decimal | None:
    return None if figure is None else Decimal(f"{figure:.{digits}f}")


def absences(parts: Sequence[Part]) -> list[tuple[str, str]]:
    """Return what is not measured, and what else must be known: (metric or whose, words), each once.

    What holds for every one of several parts is of `all`.
    """
    several = len({part.checkpoint for part in parts}) > 1
    said: list[tuple[str, str]] = []
    for part in parts:
        said += part.found.get("missing", {}).items()
    for part in parts:
        robot = part.found["embodiment"]
        said += [
            (f"{part.checkpoint} on {robot}" if several else robot, note) for note in part.found["notes"]
        ]
    for part in parts:
        if (words := value(part.found, "state.missing")) is not None:
            said.append((part.found["embodiment"], words))
    everywhere = set.intersection(*(set(part.found["notes"]) for part in parts)) if len(parts) > 1 else set()
    found = []
    for text in dict.fromkeys(text for _, text in said):
        whose = dict.fromkeys(name for name, other in said if other == text)
        found.append(("all" if text in everywhere else ", ".join(whose), text))
    return found


def verdicts(parts: Sequence[Part]) -> list[tuple[str, str]]:
    """Return for each part whose it is, and a sentence on whether the model follows its actions."""
    return [(f"{part.checkpoint} on {part.found['embodiment']}", verdict(part.found)) for part in parts]


def markdown(parts: Sequence[Part], command: str) -> str:
    """Return the content of results.md."""
    table = comparison(parts)
    text = ["# Evaluation", "", f"`{command}`", "", table.markdown(), ""]
    text += ["In brackets: 95 % intervals, by bootstrap of whole recordings (1,000 resamples).", ""]
    text += [*(f"- {whose} {said}" for whose, said in verdicts(parts)), ""]
    text += [f"- {name}: {MEANINGS[name]}" for name in table.columns if name in MEANINGS]
    if said := absences(parts):
        text += ["", "Not measured, and notes:", ""]
        text += [f"- {name}: {words}" for name, words in said]
    return "\n".join(text) + "\n"


# -- one checkpoint on one set


def conditions(found: Mapping[str, Any]) -> str:
    """Return a line on what was measured."""
    windows = human_count(found["windows"], "window")
    episodes = human_count(found["episodes"], "episode")
    given = human_count(found["prompt"], "frame")
    return (
        f"{windows} of {found['frames']} frames from {episodes} of {found['split']}, prompt of {given}; "
        f"camera {found['cameras']}; {found['draws']} draws of shuffled actions; "
        f"images do not change in {human_count(found['unmoved_windows'], 'window')}"
    )


def single(part: Part) -> Table:
    """Return the figures of one part, with what they mean."""
    rows = []
    for figure in present([part]):
        number, ends = _cell(part.found, figure, False), value(part.found, f"{figure.path}_95")
        rows.append([figure.name, number, _ends(ends), figure.meaning])
    return Table(["figure", "value", "95 %", "meaning"], rows)


def state_unit(found: Mapping[str, Any]) -> tuple[str, str]:
    """Return the key of the errors of a measured state, and their unit: of a recorded or a simulated one."""
    return ("error_sd", "standard deviations") if "values" in found else ("error_px", "px of 128")


def state(found: Mapping[str, Any] | None) -> list[tuple[Table, str]]:
    """Return the tables of a part's state, each with a line below it; none if it was not measured."""
    if not found or "true" not in found:
        return []
    key, unit = state_unit(found)
    kinds = [kind for kind in ROLLOUTS if kind in found]
    errors = [
        [kind, _digits(found[kind][key], 2), _digits(found[kind][f"{key}_last"], 2),
         _ends(found[kind][f"{key}_last_95"])]
        for kind in kinds
    ]  # fmt: skip
    first = Table(["state estimated from the images", f"error, {unit}", "last frame", "95 %"], errors)
    if "values" in found:
        said = (
            f"{found['read']} of {found['of']} values can be estimated from the images; the estimator's own "
            f"error is {found['reader_sd']:.2f} standard deviations on recorded images of other episodes"
        )
        values = [[row["name"], row["unit"], *(row[kind] for kind in kinds)] for row in found["values"]]
        return [(first, said), (Table(["last frame, error of", "unit", *kinds], values), "")]
    said = f"{found['episodes']} simulated episodes; the probe's own error is {found['probe_px']:.2f} px"
    noisy = found["perturbed"]
    about = f"perturbed by {noisy['scale']:g} standard deviations, against the simulator's answer to them"
    answers = [
        [words, noisy[f"psnr{mark}"], noisy[f"psnr{mark}_last"], noisy.get(f"perplexity{mark}")]
        for words, mark in (("true", ""), (about, "_star"))
    ]
    return [(first, said), (Table(["actions", "PSNR dB", "last frame dB", "perplexity"], answers), "")]


def _ends(ends: Sequence[float] | None) -> str | None:
    return None if not ends or None in ends else f"{ends[0]:.4g} to {ends[1]:.4g}"
