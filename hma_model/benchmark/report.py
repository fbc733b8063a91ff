"""Read results of the benchmark, and show them: a table for a model card, a page, and two compared."""

import json
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.errors import OutputError, UsageError
from hma_data.storage.files import short_sha256, write_atomic
from hma_data.tables import Table
from hma_model.benchmark.planning import difference
from hma_model.evaluation.agreement import Estimate
from hma_model.evaluation.intervals import ends_of, interval
from hma_model.evaluation.pages import Page, as_sentence
from hma_model.evaluation.plots import COLOURS, MARKERS, label_axes, svg_bytes
from hma_model.evaluation.tables import value

NAME, RESULTS = "hma-benchmark", "benchmark.json"
REMEDY = f"give the {RESULTS} of a finished hma benchmark; delete a damaged one to measure again"
CARD, PAGE = "benchmark.md", "benchmark.html"
COLUMNS = ("robot", "measure", "value (95 % interval)", "reference")
PLAIN = (  # key of a robot's figures, measure, key or text of the reference, its name
    ("psnr", "PSNR over the horizon, dB", "copy_psnr", "first frame repeated"),
    ("psnr_last", "PSNR of the last frame, dB", "copy_psnr_last", "first frame repeated"),
    ("error_px", "state error, px of 128", "", ""),
    ("error_px_last", "state error of the last frame, px", "", ""),
    ("decision", "decision fidelity, share of right choices among 5", "chance", "by chance"),
    (  # a model that stays where it is would otherwise be the most stable
        "inverse.turn_px",
        "distance from the start before the inverses, px",
        "inverse.true_turn_px",
        "simulator",
    ),
    (
        "inverse.return_px",
        "distance from the start after actions and their inverses, px",
        "inverse.true_return_px",
        "simulator",
    ),
    ("inverse.return_psnr", "PSNR after actions and inverses, dB", "inverse.turn_psnr", "before inverses"),
    ("planning.truth", "goals reached by planning in the simulator", "planning.random", "random actions"),
    ("planning.model", "goals reached by planning in the model", "planning.random", "random actions"),
    ("planning.gap", "planning gap: simulator minus model", "planning.verdict", "limited by: {}"),
    ("calibration.gap_px", "calibration gap of the state error, px", "", ""),
    (
        "calibration.half_px",
        "state error of the least uncertain half, px",
        "calibration.all_px",
        "of all",
    ),
    ("calibration.right", "share of right warning decisions", "calibration.clock", "at a fixed time"),
    ("calibration.misses", "misses: the error doubles without a prior warning", "", ""),
    ("calibration.false_alarms", "false alarms: no doubling soon after a warning", "", ""),
    ("frames_per_second", "frames per second, one rollout", "frames_per_cpu_second", "per CPU second"),
)
RELIABILITY = (
    "uncertainty since the start",
    "expected state error, px",
    "state error, px (95 % interval)",
    "expected RMSE of pixels",
    "RMSE of pixels",
)
ABSENT = {  # why a figure is absent though its part was measured
    "inverse.turn_px": "the probe locates no part",
    "inverse.return_px": "the probe locates no part",
    "calibration.misses": "no error doubles",
    "calibration.false_alarms": "no warnings",
}
AGREEMENT = (  # path in the results of hma policy-eval, measure
    ("correlation.success.pearson", "policies: Pearson of success rates"),
    ("correlation.success.spearman", "policies: rank correlation"),
    ("correlation.success.mmrv", "policies: MMRV, 0 is best"),
    ("judge.precision", "policies: precision per episode"),
    ("judge.recall", "policies: recall per episode"),
    ("judge.auroc", "policies: AUROC of scores"),
)


def rows(found: dict[str, Any]) -> list[list[str]]:
    """Return a row of COLUMNS for each measure of each robot."""
    return [[robot, *row] for robot, one in found["measures"].items() for _, *row in _measures(one)]


def _measures(one: dict[str, Any]) -> Iterator[tuple[str, str, str, str]]:
    """Yield the key of each measure of a robot, its name, its figure in words, and its reference."""
    for key, measure, reference, about in PLAIN:
        number = value(one, key)
        if number is None and "." in key:
            part = one.get(key.split(".")[0], {})
            yield key, measure, f"not measured: {part.get('missing') or ABSENT[key]}", ""
            continue
        beside = value(one, reference) if reference else None
        if beside is not None:
            about = about.format(beside) if isinstance(beside, str) else f"{beside:.2f} {about}"
        yield key, measure, _shown(number, value(one, f"{key}_95")), "" if beside is None else about
    policies = one["policies"]
    for path, measure in AGREEMENT:
        found = value(policies, path) or {}
        reason = policies.get("missing") or found["reason"]
        if policies.get("refused") and path.startswith("correlation"):
            reason = policies["refused"]  # as hma policy-eval shows none then
        yield path, measure, f"not measured: {reason}" if reason else str(Estimate(**found)), ""


def _shown(number: float | None, ends: list[float] | None) -> str:
    if number is None:
        return "not measured"
    return f"{number:.2f}" if ends is None else f"{number:.2f} ({ends[0]:.2f} to {ends[1]:.2f})"


def title(found: dict[str, Any]) -> str:
    """Return the protocol in words."""
    seed = "" if found["seed"] == 0 else f", seed {found['seed']}"
    return f"{NAME} {found['version']}, {found['mode']}{seed}"


def write_report(found: dict[str, Any], folder: Path) -> Path:
    """Write the table for the model card and the page beside the results; return the path of the page."""
    table = Table(COLUMNS, rows(found))
    lead = (
        f"{found['checkpoint']} by {title(found)}: {found['scenes']} scenes of {found['frames']} frames, and "
        f"{found['episodes']} episodes of {found['policy_frames']} frames per policy, for each robot"
    )
    page = Page("Benchmark", lead)
    page.table(COLUMNS, table.rows)
    page.text(
        "Intervals hold 95 %, over scenes and episodes. All branches are paired: same starts, same seeds."
    )
    for robot, one in found["measures"].items():
        page.section(robot, "By predicted frame.")
        by_frame = zip(one["psnr_by_frame"], one["error_px_by_frame"], strict=True)
        cells = [[frame, signal, error] for frame, (signal, error) in enumerate(by_frame, 1)]
        page.table(("frame", "PSNR, dB", "state error, px"), cells)
        _calibration(page, one["calibration"])
    write_atomic(folder / CARD, f"{lead}.\n\n{table.markdown()}\n")
    write_atomic(folder / PAGE, page.html())
    return folder / PAGE


def _calibration(page: Page, found: dict[str, Any]) -> None:
    """Add the reliability curve, risk against coverage, and what the warnings are worth."""
    if "missing" in found:
        page.text(f"Uncertainty is not calibrated: {found['missing']}.")
        return
    page.text(
        f"{as_sentence(found['meter']['verdict'])} In time: by the frame at which the state error reaches "
        f"{found['doubled_px']:.2f} px, twice that of first frames, at most {found['lead_frames']} frames "
        "before. A clock warns all rollouts at the same frame, the best one. The scenes of a rate are not "
        "those that its limit was fitted on."
    )
    curve, risk = found["reliability"], found["risk"]
    page.picture(_curves(curve, risk), "svg+xml", "Reliability of the uncertainty, and risk against coverage")
    names = ("stated", "expected_px", "measured_px", "expected_pixels", "measured_pixels")
    cells = [list(row) for row in zip(*(curve[name] for name in names), strict=True)]
    for row, ends in zip(cells, curve["measured_px_95"], strict=True):
        row[2] = _shown(row[2], ends)
    page.table(RELIABILITY, cells)


def _curves(curve: dict[str, Any], risk: dict[str, Any]) -> bytes:
    """Return the plot of a reliability curve, and of risk against coverage."""
    from matplotlib.figure import Figure

    figure = Figure(figsize=(9.0, 3.6), layout="constrained")
    left, right = figure.subplots(1, 2)
    top = max(*curve["expected_px"], *curve["measured_px"])
    left.plot([0, top], [0, top], color="#999999", ls=":", lw=1)
    ends = np.array(curve["measured_px_95"], float).T
    bars = np.abs(ends - np.array(curve["measured_px"]))
    look = {"fmt": MARKERS[0], "color": COLOURS[0], "ms": 5, "lw": 1}
    left.errorbar(curve["expected_px"], curve["measured_px"], yerr=bars, **look)
    label_axes(left, "expected state error, px", "measured, px")
    for number, kind in enumerate(("episodes", "frames")):
        values, ends = np.array(risk[f"{kind}_px"]), np.array(risk[f"{kind}_px_95"], float).T
        look = {"color": COLOURS[number], "fmt": f"{MARKERS[number]}-", "ms": 5, "lw": 1}
        right.errorbar(risk["coverage"], values, yerr=np.abs(ends - values), label=f"surest {kind}", **look)
    right.legend(frameon=False, fontsize=9, loc="upper left")
    label_axes(right, "share that is kept", "state error, px")
    return svg_bytes(figure)


def read_results(path: Path) -> dict[str, Any]:
    """Return the results in a file, or in the folder that the benchmark wrote.

    Raises:
        OutputError: there is none, or it is damaged.
    """
    path = path / RESULTS if path.is_dir() else path
    try:
        found = json.loads(path.read_bytes())
        if found["benchmark"] != NAME:
            raise ValueError
    except (OSError, ValueError, TypeError, KeyError, RecursionError):
        raise OutputError(path, "holds no results of the benchmark", REMEDY) from None
    if found.pop("sha256", "") != digest(found):
        raise OutputError(path, "is damaged or edited: its SHA-256 does not match", REMEDY)
    return found


def digest(found: dict[str, Any]) -> str:
    """Return the SHA-256 of results."""
    return short_sha256(json.dumps(found), 64)


def compared(one: dict[str, Any], other: dict[str, Any]) -> Table:
    """Return both results side by side, and the paired difference where both measured the same scenes.

    Raises:
        UsageError: they are not of the same protocol and seed, or share no robot.
    """
    keys = ("version", "mode", "seed", "scenes", "frames", "noises", "episodes", "policy_frames")
    if differing := [key for key in keys if one[key] != other[key]]:
        fault = f"the results differ in {', '.join(differing)}: {title(one)}, and {title(other)}"
        raise UsageError("--compare", fault, "run both with the same protocol and seed")
    robots = [robot for robot in one["measures"] if robot in other["measures"]]
    if not robots:
        raise UsageError("--compare", "the results share no robot", "give checkpoints with common robots")
    made = []
    for robot in robots:
        both = [_measures(result["measures"][robot]) for result in (one, other)]
        scenes = [result["by_scene"][robot] for result in (one, other)]
        for (key, measure, first, _), (_, _, second, _) in zip(*both, strict=True):
            change = _difference(*(each.get(key) for each in scenes))
            made.append([robot, measure, first, second, change])
    settings = [key for key in ("unmask_steps", "temperature") if one.get(key) != other.get(key)]
    heads = (
        ", ".join([each["checkpoint"], *(f"{key.replace('_', ' ')} {each.get(key)}" for key in settings)])
        for each in (one, other)
    )
    return Table(("robot", "measure", *heads, "second − first"), made)


def _difference(one: list[Any] | None, other: list[Any] | None) -> str:
    """Return the mean difference of the same scenes with its interval."""
    if not one or not other or None in one or None in other:
        return ""
    first, second = np.array(one), np.array(other)
    if np.isin([first, second], (0, 1)).all():  # a bootstrap of outcomes that all agree would be certain
        return _shown(*difference(second == 1, first == 1))
    return _shown(float((second - first).mean()), ends_of(interval(second - first)))
