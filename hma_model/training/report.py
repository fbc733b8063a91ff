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
    "step_seconds": ("seconds a step", False),
}

Line = dict[str, Any]  # of metrics.jsonl


class _Figures:
    """Figures over training, of which a point takes 16 bytes: a run may have millions of steps."""

    def __init__(self) -> None:
        self._values: dict[str, array[float]] = {}

    def add(self, line: Line, values: dict[str, float | None]) -> None:
        """Add the values of a line by name, without those that are None."""
        for name, value in values.items():
            if value is not None:
                self._values.setdefault(name, array("d")).extend((line["step"], value))

    def points(self) -> dict[str, NDArray[np.float64]]:
        """Return the points (N, 2) of each figure: steps and values."""
        return {name: np.array(values).reshape(-1, 2) for name, values in self._values.items()}


class _Steps:
    """What the report shows of the steps of a run, whose lines are added one by one."""

    def __init__(self) -> None:
        self.recent: deque[Line] = deque(maxlen=RECENT)
        self.of_robots: dict[str, deque[float | None]] = {}  # the last losses of each
        self.losses, self.rates = _Figures(), _Figures()
        self.memory_mib = 0.0

    def add(self, line: Line) -> None:
        self.recent.append(line)
        for name, loss in line["loss_by_embodiment"].items():
            self.of_robots.setdefault(name, deque(maxlen=RECENT)).append(loss)
        self.losses.add(line, line["loss_by_embodiment"])
        self.rates.add(line, {key: line.get(key) for key in RATES})
        self.memory_mib = max(self.memory_mib, line.get("memory_mib") or 0)


def write_report(out: StrPath) -> None:
    """Write `report.html` into a run's folder, a str or path.

    Raises:
        OSError: the file cannot be written.
    """
    out = as_path(out)
    steps, evaluations = _Steps(), list[Line]()
    for line in read_metrics(out):
        (steps.add if line["kind"] == "train" else evaluations.append)(line)
    recipe, ground = read_json(out / RECIPE), read_json(out / ENVIRONMENT)
    sets = human_count(len(recipe["data"]), "shard set")
    facts = [sets, ground["device"], f"torch {ground['torch']}"]
    if revision := ground["git_revision"]:
        facts.append(f"revision {revision[:10]}")
    page = Page(f"Training: {out.absolute().name}", ", ".join(facts))
    if steps.recent:
        _headline(page, recipe, steps, evaluations)
        _robots(page, steps, evaluations)
        _curves(page, out, recipe, steps, evaluations)
    _samples(page, out)
    if steps.recent:
        _course(page, steps)
    for title, columns, values in (
        ("Recipe", ["key", "value"], sorted(recipe.items())),
        ("Environment", ["what", "is"], ground.items()),
    ):
        page.section(title)
        plain = ((k, v if isinstance(v, str) else json.dumps(v, ensure_ascii=False)) for k, v in values)
        page.table(columns, list(map(list, plain)))
    write_atomic(out / REPORT, page.html())


def _headline(page: Page, recipe: dict[str, Any], steps: _Steps, evaluations: list[Line]) -> None:
    recent, main = steps.recent, max(recipe["objectives"], key=recipe["objectives"].get)
    own = [s.get("loss_by_objective", {main: s["loss"]}).get(main) for s in recent]
    losses = [loss for loss in own if loss is not None]
    pace = sum(s["windows"] for s in recent) / max(sum(s["step_seconds"] for s in recent), 1e-9)
    last = evaluations[-1] if evaluations else {}
    tiles = [
        (f"{recent[-1]['step']:,} of {recipe['steps']:,}", "steps"),
        (_short(_mean(losses)) if losses else "", f"training loss, {main}, last {len(recent)} steps"),
        (_short(last.get("loss")), "held-out loss"),
        (_short(last.get("baseline")), "held-out loss of the token frequencies"),
        (f"{pace:.1f}", "windows a second"),
        (human_seconds(steps.rates.points()["step_seconds"][:, 1].sum()), "spent in steps"),
        (f"{steps.memory_mib:,.0f} MiB", "of memory at most"),
        (f"{recent[-1].get('skipped', 0)}", "steps skipped"),
    ]
    page.figures([tile for tile in tiles if tile[0]])


def _robots(page: Page, steps: _Steps, evaluations: list[Line]) -> None:
    held = evaluations[-1] if evaluations else {}
    rows = []
    for name, losses in sorted(steps.of_robots.items()):
        figures = (held.get(f"{key}_by_embodiment", {}).get(name) for key in ("loss", "baseline", "accuracy"))
        rows.append([name, _mean(list(losses)), *figures])
    page.section("Robots", "Losses of the last steps and the last evaluation.")
    page.table(["robot", "training loss", "held-out loss", "token frequencies", "accuracy"], rows)


def _curves(page: Page, out: Path, recipe: dict[str, Any], steps: _Steps, evaluations: list[Line]) -> None:
    held = _Figures()
    for line in evaluations:
        held.add(line, line["loss_by_embodiment"])
    video = any(OBJECTIVES[name].predicts_video for name in recipe["objectives"])
    discrete = any("perplexity" in line for line in evaluations)
    label, kept = "loss", training_checkpoints(out)
    if video and discrete:
        label = f"loss, nats a {token_words(Checkpoint.open(kept[-1]).config.merge) if kept else 'token'}"
    page.section("Losses")
    plot = loss_curves(steps.losses.points(), held.points(), label)
    page.picture(plot, "svg+xml", "Training (lines) and held-out (markers) loss by robot")


def _samples(page: Page, out: Path) -> None:
    newest = newest_sheets(out)
    if newest:
        page.section("Predictions on held-out windows")
    for name, path in newest.items():
        page.picture(path.read_bytes(), "png", f"{name}, after step {int(path.stem[5:13]):,}")


def _course(page: Page, steps: _Steps) -> None:
    page.section("Course")
    figures = steps.rates.points()
    for key, (label, log) in RATES.items():
        page.picture(course(figures.get(key, ()), label, log), "svg+xml", f"{label} over the run")


def _mean(values: list[Any]) -> float:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else float("nan")


def _short(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}"
