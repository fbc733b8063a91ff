"""Write the report of an evaluation: one page that shows what the figures mean.

Each window is shown as a strip: what was recorded, what the tokenizer keeps of it, what each checkpoint
predicts, and how far that is from what the tokenizer keeps.

T frames, S pixels a side.
"""

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.console import human_count
from hma_data.storage.files import to_json, write_atomic
from hma_data.storage.paths import StrPath, as_path
from hma_model.evaluation.evaluate import verdict
from hma_model.evaluation.pages import Page
from hma_model.evaluation.plots import over_horizon
from hma_model.evaluation.showcase import Showcase, choose
from hma_model.evaluation.suite import RESULTS, Part
from hma_model.evaluation.tables import WORDS, absences, markdown, renamed, results, rows, value

Images = NDArray[np.uint8]
GIVEN, PREDICTED, GAP = (150, 150, 150), (0, 158, 115), (128, 128, 128)
GAP_PX, MARK_PX, MOST = 3, 4, 12  # between frames, of the line below them, frames of a strip
REACH = 96.0  # mean difference of a pixel's channels that is shown brightest
BASELINES = {
    "shuffled": "another window's commands",
    "none": "no commands",
    "copy": "prompt's last frame repeated",
}
SHORT = {
    "true": "true commands",
    "shuffled": "another window's",
    "none": "none",
    "copy": "frame repeated",
    "reconstruction": "true pictures",
}
STATE = {"true": "true commands", **BASELINES, "reconstruction": "true pictures, from their tokens"}


def write_results(parts: Sequence[Part], out: StrPath, command: str) -> Path:
    """Write results.json, results.md and report.html into a folder (str or path); return the page's path."""
    folder = as_path(out)
    write_atomic(folder / RESULTS, to_json(results(parts)))
    write_atomic(folder / "results.md", markdown(parts, command))
    path = folder / "report.html"
    write_atomic(path, page(parts, command))
    return path


def page(parts: Sequence[Part], command: str) -> str:
    """Return the page."""
    parts, legend = renamed(parts)
    labels = list(dict.fromkeys(part.checkpoint for part in parts))
    robots = list(dict.fromkeys(part.found["embodiment"] for part in parts))
    first = parts[0].found
    counted = f"{human_count(len(labels), 'checkpoint')}, {human_count(len(robots), 'robot')}"
    lead = (
        f"{counted}; windows of {first['frames']} frames of {first['split']}, of which the model gets the "
        f"first {first['prompt']}. Pictures are compared with those decoded from the true tokens."
    )
    made = Page(f"Evaluation of {', '.join(labels)}", lead)
    made.definitions(legend)
    _headline(made, parts)
    made.section("Does it follow its commands?")
    made.definitions([(_whose(part, parts), verdict(part.found)) for part in parts])
    made.section("Figures", "Below a figure: the 95 % interval of its mean, by bootstrap of whole episodes.")
    _figures(made, parts)
    if said := absences(parts):
        made.section("Not measured, and to be known")
        made.definitions(said)
    made.section(
        "How to read the strips",
        "Each strip is a window. Grey line: frames that the model gets; green line: frames that it predicts. "
        "The difference is that of the prediction to what the tokens keep: black is none, yellow is "
        f"{REACH:.0f} of 255 and more. Other commands are those of another window.",
    )
    for robot in robots:
        _robot(made, [part for part in parts if part.found["embodiment"] == robot])
    made.section("The command")
    made.commands(command)
    return made.html()


def _figures(made: Page, parts: Sequence[Part]) -> None:
    """Add the table: a column a checkpoint and robot, so that what is compared stands side by side."""
    names, lines = rows(parts)
    several = len({part.checkpoint for part in parts}) > 1
    heads = [f"{line[0]}\n{line[1]}" if several else line[1] for line in lines]
    turned = zip(names[2:], *(line[2:] for line in lines), strict=True)
    made.table(
        ["figure", *heads],
        [[f"{name}\n{WORDS.get(name, '')}", *map(_below, cells)] for name, *cells in turned],
    )


def _whose(part: Part, parts: Sequence[Part]) -> str:
    """Return the robot of a part, and its checkpoint where there are several."""
    robot: str = part.found["embodiment"]
    return robot if len({each.checkpoint for each in parts}) == 1 else f"{part.checkpoint}, {robot}"


def _below(cell: Any) -> Any:
    """Put the interval of a figure below it."""
    return cell.replace(" [", "\n", 1).rstrip("]").replace(", ", " to ") if isinstance(cell, str) else cell


def _units(found: dict[str, Any]) -> str:
    side = found.get("merge") or 1
    return "tokens" if side == 1 else f"squares of {side}×{side} tokens"


def _headline(made: Page, parts: Sequence[Part]) -> None:
    tiles = []
    for part in parts[:6]:
        gain = part.found["psnr_action_gain_last"]
        if gain is not None:
            words = "nearer to the truth with its own commands than with others, last frame"
            tiles.append((f"{gain:+.1f} dB", f"{_whose(part, parts)}: {words}"))
    if len(parts) == 1:
        found = parts[0].found
        for path, digits, unit, about in (
            ("true.psnr_last", 1, " dB", "PSNR of the last frame"),
            ("copy.psnr_last", 1, " dB", "the same of a copy of the prompt's last frame"),
            ("perplexity", 1, "", f"perplexity of a frame's {_units(found)}"),
            ("accuracy", 2, "", f"share of {_units(found)} predicted right"),
        ):
            if (figure := value(found, path)) is not None:
                tiles.append((f"{figure:.{digits}f}{unit}", about))
    made.figures(tiles)


def _robot(made: Page, parts: Sequence[Part]) -> None:
    found = parts[0].found
    made.section(found["embodiment"], f"{found['windows']} windows of {parts[0].data}.")
    seconds = found["seconds_a_frame"]
    for name, unit, words in (("psnr", "PSNR, dB", "PSNR"), ("lpips", "LPIPS", "LPIPS")):
        if curves := _curves(parts, name):
            caption = f"{words} over the horizon; bands are 95 % intervals of the mean"
            made.picture(over_horizon(curves, seconds, unit), "svg+xml", caption)
    for part in parts:
        _state(made, part, seconds)
    _strips(made, parts)


def _curves(parts: Sequence[Part], name: str) -> dict[str, tuple[Any, Any]]:
    """Return the means by frame and their intervals of each checkpoint, and of the first one's baselines."""
    kinds = [(part.checkpoint, part.found["true"]) for part in parts]
    several = len(parts) > 1
    for kind, words in BASELINES.items():  # a copy is the same whatever the model
        own = f"{words} ({parts[0].checkpoint})" if several and kind != "copy" else words
        kinds.append((own, parts[0].found[kind]))
    key = f"{name}_by_frame"
    return {
        label: (found[key], found[f"{key}_95"])
        for label, found in kinds
        if found.get(key) and None not in found[key]
    }


def _state(made: Page, part: Part, seconds: float) -> None:
    state = part.found.get("state")
    if not state or "true" not in state:
        return
    if "values" in state:
        _recorded_state(made, part.checkpoint, state, seconds)
        return
    caption = (
        f"{part.checkpoint}: how far the robot in the picture is from where the simulator's is, "
        f"{state['episodes']} new episodes; the probe that reads it errs by {state['probe_px']:.2f} px"
    )
    made.picture(over_horizon(_errors(state, "error_px"), seconds, "px of 128"), "svg+xml", caption)
    noisy = state["perturbed"]
    about = f"perturbed by {noisy['scale']:g} standard deviations, against the simulator's answer to them"
    names = ["commands", "PSNR dB", "last frame dB", *(["perplexity"] if "perplexity" in noisy else [])]
    lines = []
    for words, mark in (("true", ""), (about, "_star")):
        line = [words, noisy[f"psnr{mark}"], noisy[f"psnr{mark}_last"]]
        lines.append([*line, *([noisy[f"perplexity{mark}"]] if "perplexity" in noisy else [])])
    made.table(names, lines)


def _recorded_state(made: Page, checkpoint: str, state: dict[str, Any], seconds: float) -> None:
    caption = (
        f"{checkpoint}: how far the state read off the pictures is from the recorded one, mean of "
        f"{state['read']} of {state['of']} values; the network that reads them errs by "
        f"{state['reader_sd']:.2f} on true pictures"
    )
    curves = _errors(state, "error_sd")
    made.picture(over_horizon(curves, seconds, "standard deviations"), "svg+xml", caption)
    kinds = [kind for kind in STATE if kind in state]
    heads = ["error, last frame", "unit", *(SHORT[kind] for kind in kinds)]
    lines = [[row["name"], row["unit"], *(row[kind] for kind in kinds)] for row in state["values"]]
    made.table(heads, lines)


def _errors(state: dict[str, Any], key: str) -> dict[str, tuple[Any, Any]]:
    """Return the errors by frame and their intervals of each kind of rollout whose errors are finite."""
    return {
        words: (state[kind][f"{key}_by_frame"], state[kind][f"{key}_by_frame_95"])
        for kind, words in STATE.items()
        if None not in state[kind][f"{key}_by_frame"]
    }


# -- strips


def _strips(made: Page, parts: Sequence[Part]) -> None:
    """Add the best, the median and the worst window of the first checkpoint, as all predict them."""
    case = choose(parts)
    for i, name in enumerate(case.names):
        said = [part.by_window["true.psnr_last"][case.numbers[i]] for part in parts]
        figures = ", ".join(f"{db:.1f} dB" for db in said)
        whose = f" of {parts[0].checkpoint}" if len(parts) > 1 else ""
        title = f"The {name} window{whose}"
        made.strips(title, f"{figures} on the last frame; {case.titles[i]}", _rows(case, i, parts))
    if case.unread:
        made.text(f"The recorded pictures are not shown: {case.unread}. Strips begin with what tokens keep.")


def _rows(case: Showcase, i: int, parts: Sequence[Part]) -> list[tuple[str, bytes]]:
    truth, prompt = case.truth[i], parts[0].found["prompt"]
    columns = np.unique(np.linspace(0, len(truth) - 1, min(len(truth), MOST)).astype(int))
    films = {} if case.recorded is None else {"recorded": case.recorded[i]}
    films["from its tokens"] = truth
    for part in parts:
        mark = f", {part.checkpoint}" if len(parts) > 1 else ""
        made = case.made[part.checkpoint, "true"][i]
        films[f"prediction{mark}"] = made
        films[f"difference{mark}"] = difference(truth, made)
        films[f"other commands{mark}"] = case.made[part.checkpoint, "shuffled"][i]
    return [(name, strip(film[columns], columns, prompt)) for name, film in films.items()]


def difference(one: Images, other: Images) -> Images:
    """Return the mean difference of pictures' channels as colours (…, 3), from black to yellow."""
    from matplotlib import colormaps

    share = np.abs(one.astype(np.float32) - other).mean(axis=-1) / REACH
    shown: Images = (colormaps["inferno"](share.clip(0, 1))[..., :3] * 255).astype(np.uint8)
    return shown


def strip(film: Images, columns: NDArray[np.int64], prompt: int) -> bytes:
    """Return frames (T, H, W, 3) side by side as a WebP; a line tells those that the model got."""
    from PIL import Image

    parts = []
    for frame, number in zip(film, columns, strict=True):
        line = np.full((MARK_PX, frame.shape[1], 3), GIVEN if number < prompt else PREDICTED, np.uint8)
        parts += [np.concatenate([frame, line]), np.full((len(frame) + MARK_PX, GAP_PX, 3), GAP, np.uint8)]
    buffer = io.BytesIO()
    Image.fromarray(np.concatenate(parts[:-1], axis=1)).save(buffer, "WEBP", quality=88, method=4)
    return buffer.getvalue()
