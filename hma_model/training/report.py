"""Write `report.html` of a run: the recipe, the losses, and pictures of predictions.

The page is one file that fetches nothing. It is made from the files of the run's folder alone, so it can be
made again at any time.
"""

import json
from pathlib import Path
from typing import Any

from hma_data.console import human_seconds
from hma_data.storage.files import write_atomic
from hma_data.storage.paths import StrPath, as_path
from hma_model.config import OBJECTIVES
from hma_model.evaluation.html import Page
from hma_model.evaluation.sample_images import FOLDER
from hma_model.training.logging import read_metrics
from hma_model.training.runtime import ENVIRONMENT, RECIPE

REPORT = "report.html"
RECENT = 50  # number of last steps over which the closing figures are averaged


def write_report(out: StrPath) -> None:
    """Write `report.html` into a run's folder, a str or path.

    Raises:
        OSError: the file cannot be written.
    """
    out = as_path(out)
    lines = read_metrics(out)
    steps = [line for line in lines if line["kind"] == "train"]
    evaluations = [line for line in lines if line["kind"] == "eval"]
    recipe, ground = (_json(out / name) for name in (RECIPE, ENVIRONMENT))
    page = Page(f"Training: {out.absolute().name}", _lead(recipe, ground))
    _headline(page, recipe, steps, evaluations)
    _robots(page, steps, evaluations)
    _curves(page, steps, evaluations, _unit(recipe, evaluations))
    _samples(page, out)
    _course(page, steps)
    page.section("Recipe")
    page.table(["key", "value"], [[key, _plain(value)] for key, value in sorted(recipe.items())])
    page.section("Environment")
    page.table(["what", "is"], [[key, _plain(value)] for key, value in ground.items()])
    write_atomic(out / REPORT, page.html())


def _lead(recipe: dict[str, Any], ground: dict[str, Any]) -> str:
    robots = len(recipe.get("data") or ())
    revision = str(ground.get("git_revision") or "")[:10]
    where = f"{ground.get('device')}, torch {ground.get('torch')}"
    return f"{robots} shard set{'s' * (robots != 1)}, {where}" + (
        f", revision {revision}" if revision else ""
    )


def _headline(
    page: Page, recipe: dict[str, Any], steps: list[dict[str, Any]], evaluations: list[dict[str, Any]]
) -> None:
    if not steps:
        return
    seconds = sum(line["step_seconds"] for line in steps)
    recent = steps[-RECENT:]
    pace = sum(s["windows"] for s in recent) / max(sum(s["step_seconds"] for s in recent), 1e-9)
    tiles = [
        (f"{steps[-1]['step']:,} of {recipe.get('steps', 0):,}", "steps"),
        (f"{_mean([s['loss'] for s in recent]):.3f}", f"training loss, last {len(recent)} steps"),
    ]
    if evaluations:
        last = evaluations[-1]
        tiles.append((_short(last["loss"]), "held-out loss"))
        if last.get("baseline") is not None:
            tiles.append((_short(last["baseline"]), "the same, looking at nothing"))
    tiles += [
        (f"{pace:.1f}", "windows a second"),
        (human_seconds(seconds), "spent in steps"),
        (f"{max(s.get('memory_mib') or 0 for s in steps):,.0f} MiB", "of memory at most"),
        (f"{steps[-1].get('skipped', 0)}", "steps left out"),
    ]
    page.figures(tiles)


def _robots(page: Page, steps: list[dict[str, Any]], evaluations: list[dict[str, Any]]) -> None:
    names = sorted({name for line in steps for name in line["loss_by_embodiment"]})
    if not names:
        return
    held = evaluations[-1] if evaluations else {}
    rows = []
    for name in names:
        own = [line["loss_by_embodiment"][name] for line in steps if name in line["loss_by_embodiment"]]
        row = [name, _mean(own[-RECENT:])]
        for key in ("loss", "baseline", "accuracy"):
            row.append((held.get(f"{key}_by_embodiment") or {}).get(name))
        rows.append(row)
    page.section("Robots", "Losses of the last steps and the last evaluation.")
    page.table(["robot", "training loss", "held-out loss", "looking at nothing", "accuracy"], rows)


def _curves(page: Page, steps: list[dict[str, Any]], evaluations: list[dict[str, Any]], unit: str) -> None:
    from hma_model.evaluation.plots import losses_by_robot

    if not steps:
        return
    page.section("Losses")
    training: dict[str, list[tuple[int, float]]] = {}
    for line in steps:
        for name, loss in line["loss_by_embodiment"].items():
            if loss is not None:
                training.setdefault(name, []).append((line["step"], loss))
    validation: dict[str, list[tuple[int, float]]] = {}
    for line in evaluations:
        for name, loss in line["loss_by_embodiment"].items():
            validation.setdefault(name, []).append((line["step"], loss))
    plot = losses_by_robot(training, validation, unit)
    page.picture(plot, "svg+xml", "Training (lines) and held-out (markers) loss by robot", plot=True)


def _samples(page: Page, out: Path) -> None:
    newest: dict[str, Path] = {}
    for path in sorted((out / FOLDER).glob("step-????????-*.png")):
        newest[path.stem[14:]] = path
    if newest:
        page.section("Predictions on held-out windows")
    for name, path in newest.items():
        page.picture(path.read_bytes(), "png", f"{name}, after step {int(path.stem[5:13]):,}")


def _course(page: Page, steps: list[dict[str, Any]]) -> None:
    from hma_model.evaluation.plots import course

    if not steps:
        return
    page.section("Course")
    for key, label, log in (
        ("lr", "learning rate", False),
        ("grad_norm", "gradient's norm", True),
        ("step_seconds", "seconds a step", False),
    ):
        points = [(line["step"], line[key]) for line in steps if line.get(key) is not None]
        page.picture(course(points, label, log), "svg+xml", f"{label} over the run", plot=True)


def _unit(recipe: dict[str, Any], evaluations: list[dict[str, Any]]) -> str:
    names = recipe.get("objectives") or ()
    video = any(objective.predicts_video for name, objective in OBJECTIVES.items() if name in names)
    discrete = any("perplexity" in line for line in evaluations)
    return "loss, nats a token" if video and discrete else "loss"


def _json(path: Path) -> dict[str, Any]:
    return json.loads(path.read_text(encoding="utf-8")) if path.is_file() else {}


def _mean(values: list[Any]) -> float:
    known = [value for value in values if value is not None]
    return sum(known) / len(known) if known else float("nan")


def _short(value: Any) -> str:
    return "–" if value is None else f"{value:.3f}"


def _plain(value: Any) -> str:
    return value if isinstance(value, str) else json.dumps(value, ensure_ascii=False)
