"""Put the results of several checkpoints and shard sets into tables: rows, Markdown, JSON.

A mean over sets counts each set once; its interval is that of the mean. The mean perplexity is exp of the
mean loss.
"""

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from hma_data.console import short_paths
from hma_data.storage.files import finite
from hma_model.evaluation.evaluate import verdict
from hma_model.evaluation.intervals import over_datasets
from hma_model.evaluation.suite import Part

MEAN = "mean over sets"
# heading, its key among the values of windows, the figure's path, digits, and whether exp is taken
COLUMNS: tuple[tuple[str, str, str, int, bool], ...] = (
    ("perplexity", "loss", "perplexity", 2, True),
    ("nats/token", "", "stored_loss", 3, False),
    ("masked", "masked_loss", "masked_perplexity", 2, True),
    ("accuracy", "accuracy", "accuracy", 3, False),
    ("PSNR", "true.psnr", "true.psnr", 2, False),
    ("PSNR last", "true.psnr_last", "true.psnr_last", 2, False),
    ("ΔPSNR", "psnr_action_gain_last", "psnr_action_gain_last", 2, False),
    ("SSIM", "true.ssim", "true.ssim", 3, False),
    ("LPIPS", "true.lpips", "true.lpips", 3, False),
    ("FID", "", "true.fid", 1, False),
    ("FVD", "", "true.fvd", 1, False),
    ("ΔPSNR (paper)", "paper.delta_psnr", "paper.delta_psnr", 2, False),
    ("state px", "", "state.true.error_px_last", 2, False),
    ("state sd", "state.error_sd_last", "state.true.error_sd_last", 2, False),
    ("PSNR none", "none.psnr_last", "none.psnr_last", 2, False),
    ("PSNR copy", "copy.psnr_last", "copy.psnr_last", 2, False),
)
WORDS = {
    "perplexity": "of whole masked frames, given the true past; of squares, where the model takes squares",
    "nats/token": "loss a stored token: comparable between all models of a tokenizer",
    "masked": "perplexity of the tokens that training masks, among its masks",
    "accuracy": "share of tokens (or of squares of tokens), given the true past",
    "PSNR": "dB, mean over the horizon of rollouts",
    "PSNR last": "dB, last frame",
    "ΔPSNR": "dB, last frame, true less shuffled actions",
    "SSIM": "mean over the horizon",
    "LPIPS": "AlexNet, mean over the horizon",
    "FID": "of all predicted frames",
    "FVD": "of the predicted parts of windows",
    "ΔPSNR (paper)": "dB, last frame after the true past, true less Gaussian actions",
    "state px": "error of the robot's place at the last frame, px of 128",
    "state sd": "error of the recorded state at the last frame, in its standard deviations",
    "PSNR none": "dB, last frame, without commands",
    "PSNR copy": "dB, last frame, the prompt's last frame repeated",
}


def renamed(parts: Sequence[Part]) -> tuple[list[Part], list[tuple[str, str]]]:
    """Return the parts under short names of their checkpoints, and the pairs (short, full) that differ."""
    names = short_paths(list(dict.fromkeys(part.checkpoint for part in parts)))
    legend = [(short, name) for name, short in names.items() if short != name]
    return [replace(part, checkpoint=names[part.checkpoint]) for part in parts], legend


def value(found: Mapping[str, Any], path: str) -> Any:
    """Return a figure by its path, such as `true.psnr`; None where it is absent."""
    item: Any = found
    for key in path.split("."):
        item = item.get(key) if isinstance(item, Mapping) else None
    return item


def present(parts: Sequence[Part]) -> list[tuple[str, str, str, int, bool]]:
    """Return those of the columns that some part has a figure for."""
    return [column for column in COLUMNS if any(value(part.found, column[2]) is not None for part in parts)]


def means(parts: Sequence[Part]) -> list[dict[str, Any]]:
    """Return for each checkpoint the means over its sets, with their intervals."""
    rows = []
    for label in dict.fromkeys(part.checkpoint for part in parts):
        own = [part for part in parts if part.checkpoint == label]
        row: dict[str, Any] = {"checkpoint": label, "embodiment": MEAN, "sets": len(own)}
        row["windows"] = sum(part.found["windows"] for part in own)
        row["episodes"] = sum(part.found["episodes"] for part in own)
        for _, key, path, _, exponential in present(own):
            figures = [value(part.found, path) for part in own]
            if None in figures:
                continue
            if not key:
                row[path] = sum(figures) / len(figures)
                continue
            episodes = [part.by_window.get("episode") for part in own]
            mean, ends = over_datasets([part.by_window[key] for part in own], episodes=episodes)
            row[path] = math.exp(mean) if exponential else mean
            row[f"{path}_95"] = [math.exp(end) for end in ends] if exponential and ends else ends
        rows.append(row)
    return rows


def results(parts: Sequence[Part]) -> dict[str, Any]:
    """Return the content of results.json."""
    averages = [
        {k: [round(e, 4) for e in v] if isinstance(v, list) else round(v, 4) if isinstance(v, float) else v
         for k, v in row.items()}
        for row in means(parts)
    ]  # fmt: skip
    return finite({"results": [part.found for part in parts], "means": averages})


def rows(parts: Sequence[Part], intervals: bool = True) -> tuple[list[str], list[list[Any]]]:
    """Return the headings and rows of the table: a row a checkpoint and set, then the means over sets."""
    columns = present(parts)
    names = ["checkpoint", "robot", "windows", "episodes", *(column[0] for column in columns)]
    lines: list[list[Any]] = []
    averages = {row["checkpoint"]: row for row in means(parts)}
    for label in averages:
        own = [part.found for part in parts if part.checkpoint == label]
        entries = own + ([averages[label]] if len(own) > 1 else [])
        for found in entries:
            mean = found is averages[label]
            line = [label, found["embodiment"], found["windows"], found["episodes"]]
            for _, _, path, digits, _ in columns:
                figure = found.get(path) if mean else value(found, path)
                ends = found.get(f"{path}_95") if mean else value(found, f"{path}_95")
                line.append(_cell(figure, ends if intervals else None, digits))
            lines.append(line)
    return names, lines


def _cell(figure: Any, ends: Any, digits: int) -> str | None:
    if figure is None:
        return None
    if not isinstance(ends, list):
        return f"{figure:.{digits}f}"
    return f"{figure:.{digits}f} [{ends[0]:.{digits}f}, {ends[1]:.{digits}f}]"


def absences(parts: Sequence[Part]) -> list[tuple[str, str]]:
    """Return what is not measured, and what else must be known: (metric or whose, words), each once.

    What holds for every one of several parts is of `all`.
    """
    several = len({part.checkpoint for part in parts}) > 1
    said = [pair for part in parts for pair in part.found.get("missing", {}).items()]
    said += [
        (f"{part.checkpoint} on {robot}" if several else robot, note)
        for part in parts
        for robot in [part.found["embodiment"]]
        for note in part.found["notes"]
    ]
    said += [
        (part.found["embodiment"], words)
        for part in parts
        if (words := value(part.found, "state.missing")) is not None
    ]
    everywhere = {text for text in parts[0].found["notes"] if all(text in p.found["notes"] for p in parts)}
    found = []
    for text in dict.fromkeys(text for _, text in said):
        whose = dict.fromkeys(name for name, other in said if other == text)
        found.append(("all" if len(parts) > 1 and text in everywhere else ", ".join(whose), text))
    return found


def verdicts(parts: Sequence[Part]) -> list[tuple[str, str]]:
    """Return for each part whose it is, and a sentence on whether the model follows its actions."""
    return [(f"{part.checkpoint} on {part.found['embodiment']}", verdict(part.found)) for part in parts]


def markdown(parts: Sequence[Part], command: str) -> str:
    """Return the content of results.md."""
    names, lines = rows(parts)
    text = ["# Evaluation", "", f"`{command}`", "", _line(names), _line(["---"] * len(names))]
    text += [_line(["–" if cell is None else cell for cell in line]) for line in lines]
    text += ["", "In brackets: 95 % intervals, by bootstrap of whole episodes (1,000 resamples).", ""]
    text += [*(f"- {whose} {said}" for whose, said in verdicts(parts)), ""]
    text += [f"- {name}: {WORDS[name]}" for name in names if name in WORDS]
    if said := absences(parts):
        text += ["", "Not measured, or to be known:", ""]
        text += [f"- {name}: {words}" for name, words in said]
    return "\n".join(text) + "\n"


def _line(cells: Sequence[Any]) -> str:
    return f"| {' | '.join(str(cell).replace('|', '\\|') for cell in cells)} |"
