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
import torch

from hma_data.arrays import Images, Ints
from hma_data.console import human_count
from hma_data.errors import HMAError
from hma_data.loading.dataset import Batch
from hma_data.shards.preview import tokenizer_of
from hma_data.shards.reader import ShardSet
from hma_data.shards.recorded import Recorded
from hma_data.storage.files import to_json, write_atomic
from hma_data.storage.paths import StrPath, as_path
from hma_model.arrays import evenly
from hma_model.config import token_words
from hma_model.evaluation.losses import windows
from hma_model.evaluation.pages import Page
from hma_model.evaluation.plots import over_horizon
from hma_model.evaluation.rollout_video import GIVEN_COLOUR, PREDICTED_COLOUR
from hma_model.evaluation.suite import RESULTS, Part
from hma_model.evaluation.tables import (
    ROLLOUTS,
    absences,
    markdown,
    renamed,
    results,
    state,
    state_unit,
    turned,
    value,
)
from hma_model.evaluation.verdict import verdict
from hma_model.generation.decode import decode

GAP_COLOUR = (128, 128, 128)
GAP_PX, MARK_PX = 3, 4  # between frames, and of the line below them
STRIP_FRAMES = 12  # at most
BRIGHTEST = 96.0  # mean difference of a pixel's channels that is shown brightest


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
        f"first {first['prompt']}. The reference is the decoded recorded tokens."
    )
    made = Page(f"Evaluation of {', '.join(labels)}", lead)
    made.definitions(legend)
    _headline(made, parts)
    made.section("Does it follow its actions?")
    made.definitions([(_whose(part, parts), verdict(part.found)) for part in parts])
    made.section("Figures", "Below a figure: the 95 % interval of its mean, by bootstrap of recordings.")
    table = turned(parts)
    made.table(table.columns, table.rows)
    if said := absences(parts):
        made.section("Not measured, and notes")
        made.definitions(said)
    made.section(
        "How to read the strips",
        "Each strip is a window. Grey line: frames that the model gets; green line: frames that it predicts. "
        "Difference: prediction vs decoded tokens, from black (none) to yellow "
        f"({BRIGHTEST:.0f} of 255 or more). Other actions are those of another window.",
    )
    for robot in robots:
        _robot(made, [part for part in parts if part.found["embodiment"] == robot])
    made.section("The command")
    made.commands(command)
    return made.html()


def _whose(part: Part, parts: Sequence[Part]) -> str:
    """Return the robot of a part, and its checkpoint where there are several."""
    robot = part.found["embodiment"]
    return robot if len({each.checkpoint for each in parts}) == 1 else f"{part.checkpoint}, {robot}"


def _headline(made: Page, parts: Sequence[Part]) -> None:
    tiles = []
    for part in parts[:6]:
        gain = part.found["psnr_action_gain_last"]
        if gain is not None:
            words = "last-frame PSNR gain, recorded vs shuffled actions"
            tiles.append((f"{gain:+.1f} dB", f"{_whose(part, parts)}: {words}"))
    if len(parts) == 1:
        found = parts[0].found
        for path, digits, unit, about in (
            ("true.psnr_last", 1, " dB", "PSNR of the last frame"),
            ("copy.psnr_last", 1, " dB", "PSNR of a copy of the prompt's last frame"),
            ("perplexity", 1, "", f"perplexity per {token_words(found['merge'])}"),
            ("accuracy", 2, "", f"accuracy per {token_words(found['merge'])}"),
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
    for kind in ("shuffled", "none", "copy"):
        whose = f" ({parts[0].checkpoint})" if len(parts) > 1 and kind != "copy" else ""  # a copy is anyone's
        kinds.append((f"{ROLLOUTS[kind]}{whose}", parts[0].found[kind]))
    key = f"{name}_by_frame"
    return {
        label: (found[key], found[f"{key}_95"])
        for label, found in kinds
        if found.get(key) and None not in found[key]
    }


def _state(made: Page, part: Part, seconds: float) -> None:
    measured = part.found.get("state", {})
    if not (tables := state(measured)):
        return
    key, unit = state_unit(measured)
    truth = "the recorded one" if "values" in measured else "the simulator's"
    curves = {
        words: (measured[kind][f"{key}_by_frame"], measured[kind][f"{key}_by_frame_95"])
        for kind, words in ROLLOUTS.items()
        if None not in measured[kind][f"{key}_by_frame"]
    }
    caption = f"{part.checkpoint}: distance of the state estimated from the images to {truth}; {tables[0][1]}"
    made.picture(over_horizon(curves, seconds, unit), "svg+xml", caption)
    for table, _ in tables[1:]:
        made.table(table.columns, table.rows)


# -- strips


def _strips(made: Page, parts: Sequence[Part]) -> None:
    """Add the best, the median and the worst window of the first checkpoint, as all predict them."""
    found, shards = parts[0].found, ShardSet(parts[0].data)
    names, count, prompt = found["cameras"].split(", "), found["windows"], found["prompt"]
    cameras = names if len(names) > 1 else names[0]
    (batch,) = windows(shards, found["split"], found["frames"], count, count, cameras)
    tokenizer, dtype = tokenizer_of(shards), batch.stored.numpy().dtype
    assert batch.episode is not None and batch.frame is not None
    last = np.nan_to_num(parts[0].by_window["true.psnr_last"], nan=-1.0)
    order = np.argsort(last, kind="stable")[::-1].tolist()
    columns = evenly(found["frames"], STRIP_FRAMES)
    unread = "the model sees several cameras" if len(names) > 1 else ""
    for number, name in {order[0]: "best", order[count // 2]: "median", order[-1]: "worst"}.items():
        films = {}
        if len(names) == 1:
            try:
                films["recorded"] = recorded_frames(shards, batch, number)
            except (HMAError, OSError, ImportError) as fault:
                unread = " ".join(str(fault).split())
        films["from its tokens"] = truth = decode(tokenizer, batch.stored[[number]])[0]
        for part in parts:
            mark = f", {part.checkpoint}" if len(parts) > 1 else ""
            predicted = (part.predicted[kind][[number]] for kind in ("true", "shuffled"))
            own, other = (
                np.concatenate([truth[:prompt], decode(tokenizer, torch.from_numpy(one.astype(dtype)))[0]])
                for one in predicted
            )
            films[f"prediction{mark}"] = own
            films[f"difference{mark}"] = difference(truth, own)
            films[f"other actions{mark}"] = other
        figures = ", ".join(f"{part.by_window['true.psnr_last'][number]:.1f} dB" for part in parts)
        whose = f" of {parts[0].checkpoint}" if len(parts) > 1 else ""
        where = f"episode {int(batch.episode[number])}, frame {int(batch.frame[number])}"
        rows = [(label, strip(film[columns], columns, prompt)) for label, film in films.items()]
        made.strips(f"The {name} window{whose}", f"{figures} on the last frame; {where}", rows)
    if unread:
        made.text(f"The recorded images are not shown: {unread}. Strips begin with the decoded tokens.")


def difference(one: Images, other: Images) -> Images:
    """Return the mean difference of pictures' channels as colours (…, 3), from black to yellow."""
    from matplotlib import colormaps

    share = np.abs(one.astype(np.float32) - other).mean(axis=-1) / BRIGHTEST
    return (colormaps["inferno"](share.clip(0, 1))[..., :3] * 255).astype(np.uint8)


def strip(film: Images, columns: Ints, prompt: int) -> bytes:
    """Return frames (T, H, W, 3) side by side as a WebP; a line tells those that the model got."""
    from PIL import Image

    parts = []
    for frame, number in zip(film, columns, strict=True):
        colour = GIVEN_COLOUR if number < prompt else PREDICTED_COLOUR
        mark = np.full((MARK_PX, frame.shape[1], 3), colour, np.uint8)
        gap = np.full((len(frame) + MARK_PX, GAP_PX, 3), GAP_COLOUR, np.uint8)
        parts += [np.concatenate([frame, mark]), gap]
    buffer = io.BytesIO()
    Image.fromarray(np.concatenate(parts[:-1], axis=1)).save(buffer, "WEBP", quality=88, method=4)
    return buffer.getvalue()


def recorded_frames(shards: ShardSet, batch: Batch, row: int) -> Images:
    """Return the recorded pictures (T, S, S, 3) of a window, as the tokenizer saw them.

    Raises:
        HMAError: the recording is not where the shard set says, or cannot be read.
    """
    assert batch.episode is not None and batch.frame is not None
    seen = 0 if batch.camera is None else int(batch.camera[row])
    number = int(batch.episode[row])
    (episode,) = (one for one in shards.episodes.to_pylist() if one["episode_index"] == number)
    rows = int(batch.frame[row]) + np.arange(batch.actions.shape[1]) * shards.row_stride
    return Recorded(shards, episode).frames(shards.manifest.cameras[seen], rows)
