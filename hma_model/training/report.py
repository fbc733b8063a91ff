"""Write `report.html` of a run: the recipe, the losses, and pictures of predictions.

The page is one file that fetches nothing. It is made from the files of the run's folder alone, so it can be
made again at any time.
"""

import json
from array import array
from collections import deque
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.console import human_count, human_seconds
from hma_data.storage.files import read_json, write_atomic
from hma_data.storage.paths import StrPath, as_path
from hma_model.checkpoint.folder import Checkpoint, training_checkpoints
from hma_model.config import OBJECTIVES, token_words
from hma_model.evaluation.pages import Page
from hma_model.evaluation.plots import course, loss_curves
from hma_model.evaluation.rollout_video import newest_sheets
from hma_model.training.logging import read_metrics
from hma_model.training.runtime import ENVIRONMENT, RECIPE

REPORT = "report.html"
RECENT = 50  # number of last steps over which the closing figures are averaged
RATES = {  # key of a line -> what it is, and whether its axis is logarithmic
    "lr": ("learning rate", False),
    "grad_norm": ("gradient's norm", True),
    "step_seconds": ("seconds per step", False),
}

Line = dict[str, Any]  # of metrics.jsonl


class Figures:
    """Figures over training, of which a point takes 16 bytes: a run may have millions of steps."""

    def __init__(self) -> None:
        self._values: dict[str, array[float]] = {}

    def add(self, line: Line) -> None:
        """Add the losses by robot and the rates of a line; those that are None are left out."""
        kind = "training" if line["kind"] == "train" else "held_out"
        values = {f"{kind}/loss/{name}": loss for name, loss in line["loss_by_embodiment"].items()}
        values |= {f"rates/{name}": line.get(name) for name in (*RATES, "data_seconds", "memory_mib")}
        for name, value in values.items():
            if value is not None:
                self._values.setdefault(name, array("d")).extend((line["step"], value))

    def points(self, home: str = "") -> dict[str, NDArray[np.float64]]:
        """Return the points (N, 2), steps and values, of each figure whose name begins with `home`."""
        return {
            name.removeprefix(home): np.array(values).reshape(-1, 2)
            for name, values in self._values.items()
            if name.startswith(home)
        }


def write_report(out: StrPath) -> None:
    """Write `report.html` into a run's folder, a str or path.

    Raises:
        OSError: the file cannot be written.
    """
    out = as_path(out)
    figures, recent, evaluations = Figures(), deque[Line](maxlen=RECENT), list[Line]()
    for line in read_metrics(out):
        figures.add(line)
        (recent if line["kind"] == "train" else evaluations).append(line)
    recipe, ground = read_json(out / RECIPE), read_json(out / ENVIRONMENT)
    sets = human_count(len(recipe["data"]), "shard set")
    facts = [sets, ground["device"], f"torch {ground['torch']}"]
    if revision := ground["git_revision"]:
        facts.append(f"revision {revision[:10]}")
    page = Page(f"Training: {out.absolute().name}", ", ".join(facts))
    if recent:
        _headline(page, recipe, recent, evaluations, figures)
        _robots(page, recent, evaluations, figures)
        _curves(page, out, recipe, evaluations, figures)
    sheets = newest_sheets(out)
    if sheets:
        page.section("Predictions on held-out windows")
    for name, path in sheets.items():
        page.picture(path.read_bytes(), "png", f"{name}, after step {int(path.stem[5:13]):,}")
    if recent:
        page.section("Course")
        rates = figures.points("rates/")
        for key, (label, log) in RATES.items():
            page.picture(course(rates.get(key, ()), label, log), "svg+xml", f"{label} over the run")
    for title, columns, values in (
        ("Recipe", ["key", "value"], sorted(recipe.items())),
        ("Environment", ["what", "is"], ground.items()),
    ):
        page.section(title)
        plain = ((k, v if isinstance(v, str) else json.dumps(v, ensure_ascii=False)) for k, v in values)
        page.table(columns, list(map(list, plain)))
    write_atomic(out / REPORT, page.html())


def _headline(
    page: Page, recipe: dict[str, Any], recent: deque[Line], evaluations: list[Line], figures: Figures
) -> None:
    main, rates = max(recipe["objectives"], key=recipe["objectives"].get), figures.points("rates/")
    own = [s.get("loss_by_objective", {main: s["loss"]}).get(main) for s in recent]
    losses = [loss for loss in own if loss is not None]
    pace = sum(s["windows"] for s in recent) / max(sum(s["step_seconds"] for s in recent), 1e-9)
    last = evaluations[-1] if evaluations else {}
    planned = "" if recipe.get("cpu_seconds") or recipe.get("seconds") else f" of {recipe['steps']:,}"
    tiles = [
        (f"{recent[-1]['step']:,}{planned}", "steps"),
        (_short(_mean(losses)) if losses else "", f"training loss, {main}, last {len(recent)} steps"),
        (_short(last.get("loss")), "held-out loss"),
        (_short(last.get("baseline")), "held-out loss of the token frequencies"),
        (f"{pace:.1f}", "windows per second"),
        (human_seconds(rates["step_seconds"][:, 1].sum()), "spent in steps"),
        (f"{rates['memory_mib'][:, 1].max():,.0f} MiB", "peak memory"),
        (f"{recent[-1].get('skipped', 0)}", "steps skipped"),
    ]
    page.figures([tile for tile in tiles if tile[0]])


def _robots(page: Page, recent: deque[Line], evaluations: list[Line], figures: Figures) -> None:
    held, losses = evaluations[-1] if evaluations else {}, figures.points("training/loss/")
    rows = []
    for name in sorted({*losses, *recent[-1]["loss_by_embodiment"]}):
        last = losses[name][-RECENT:, 1].tolist() if name in losses else []
        others = (held.get(f"{key}_by_embodiment", {}).get(name) for key in ("loss", "baseline", "accuracy"))
        rows.append([name, _mean(last), *others])
    page.section("Robots", "Losses of the last steps and the last evaluation.")
    page.table(["robot", "training loss", "held-out loss", "token frequencies", "accuracy"], rows)


def _curves(page: Page, out: Path, recipe: dict[str, Any], evaluations: list[Line], figures: Figures) -> None:
    video = any(OBJECTIVES[name].predicts_video for name in recipe["objectives"])
    discrete = any("perplexity" in line for line in evaluations)
    label, kept = "loss", training_checkpoints(out)
    if video and discrete:
        label = f"loss, nats a {token_words(Checkpoint.open(kept[-1]).config.merge) if kept else 'token'}"
    page.section("Losses")
    plot = loss_curves(figures.points("training/loss/"), figures.points("held_out/loss/"), label)
    page.picture(plot, "svg+xml", "Training (lines) and held-out (markers) loss by robot")


def _mean(values: list[Any]) -> float:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else float("nan")


def _short(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"
