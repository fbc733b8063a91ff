"""Show an evaluation of policies: as a table on a terminal, and as a page with images of episodes."""

import json
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.console import print_lines, print_table, short_paths
from hma_data.episodes.sheets import grid, png_bytes
from hma_data.storage.files import write_atomic
from hma_data.storage.kept import remove_kept
from hma_model.evaluation.agreement import Estimate
from hma_model.evaluation.pages import Page, as_sentence
from hma_model.evaluation.plots import COLOURS, MARKERS, labelled_axes, svg_bytes
from hma_model.policies.scores import MODEL, SHARED, TRUE, WORK, Abstention, PolicyEvaluation, Scored

COLUMNS = ("policy", "simulator", "model", "score, sim.", "score, model", "agree", "same actions, sim.")
LISTED_PAIRS = 6  # pairs of policies that a sentence names
SHOWN_EPISODES = 2  # episodes of each kind on the page
OUTCOME_TITLES = {  # (success in the simulator, in the model) -> title
    (True, True): "Both say success",
    (False, False): "Both say failure",
    (True, False): "Success in the simulator only",
    (False, True): "Success in the model only",
}


def renamed(found: PolicyEvaluation) -> tuple[PolicyEvaluation, list[tuple[str, str]]]:
    """Return the evaluation under short names of the policies that are paths, and the pairs (short, full)."""
    names = short_paths([one.policy for one in found.policies if "/" in one.policy])
    policies = tuple(replace(one, policy=names.get(one.policy, one.policy)) for one in found.policies)
    legend = [(short, name) for name, short in names.items() if short != name]
    return replace(found, policies=policies), legend


def table(found: PolicyEvaluation) -> list[list[Any]]:
    """Return a row of COLUMNS for each policy."""
    return [
        [
            row["policy"],
            rate(row, "true_success"),
            rate(row, "model_success"),
            round(row["true_score"], 1),
            round(row["model_score"], 1),
            rate(row, "episodes_alike"),
            rate(row, "replayed_success"),
        ]
        for row in found.rows()
    ]


def rate(row: dict[str, Any], name: str) -> str:
    """Return a share of a row in words, with its interval."""
    low, high = row[f"{name}_interval"]
    return f"{row[name]:.0%} ({low:.0%}–{high:.0%})"


def sentences(found: PolicyEvaluation) -> list[str]:
    """Return in words what the table means: the task, the judge, and what follows for the policies."""
    scores = "the way it moved" if found.judge.task.name == "moved" else "minus the distance, 0 is best"
    paired = found.paired
    guessed = f"{found.generated.successes / found.generated.count:.0%}"
    said = [
        f"success: {found.judge.task.text}; shares with 95 % intervals over episodes; scores in px: {scores}",
        "agree: episodes with the same outcome in both; same actions, sim.: success in the simulator "
        "under the policy's actions in the model",
        f"paired: simulator and model share {SHARED}; checked: the first action chunks are equal",
        f"judge on held-out recorded episodes: {found.judge.held_out}",
        f"judge on generated frames, vs the simulator under the same actions: {found.generated}",
        f"precision: the simulator confirms {_share(found.precision)} of the model's successes ({guessed} by "
        f"chance); recall: the model shows {_share(found.recall)} of the simulator's successes, same actions",
        f"per-episode scores under the same actions: rank correlation {found.followed}, AUROC {found.auroc}",
        f"model vs simulator, each under its own actions: precision {_share(paired['precision'])}, "
        f"recall {_share(paired['recall'])}, AUROC of scores {paired['auroc']}",
    ]
    if found.abstention is not None:
        said.append(abstained(found.abstention))
    if found.refusal:
        said.append(refused(found))
    else:
        correlated = {"success rates": found.success, "mean scores": found.score}
        for what, one in correlated.items():
            if one["pearson"].reason:  # of the ranks it is the same
                said.append(f"{what} over policies: no correlation: {one['pearson'].reason}")
            else:
                said.append(
                    f"{what} over policies: Pearson {one['pearson']}, Spearman {one['spearman']}, "
                    f"MMRV {one['mmrv']} (0 is best)"
                )
    return said + [_alike(found, where) for where in (TRUE, MODEL) if found.alike(where)]


def refused(found: PolicyEvaluation) -> str:
    """Return the sentence that says why there is no verdict."""
    return f"no verdict: on generated frames {found.refusal}, so the model's success rates are meaningless"


def abstained(found: Abstention) -> str:
    """Return the sentence on what the model says where it does not expect a large error of its own."""
    start = (
        f"abstention: {found.judged} of {found.count} episodes end with an expected state error of at most "
        f"{found.max_error_px:g} px"
    )
    if found.generated is None:
        return f"{start}; nothing is judged"
    rates = f"precision {_share(found.precision)}, recall {_share(found.recall)}"
    return f"{start}; of these the judge on generated frames: {found.generated}, {rates}"


def _share(found: Estimate) -> str:
    if found.low is None or found.value is None:
        return f"an unknown share ({found.reason})"
    return f"{found.value:.0%} ({found.low:.0%} to {found.high:.0%})"


def _alike(found: PolicyEvaluation, where: int) -> str:
    place = "the simulator" if where == TRUE else "the model"
    pairs = found.alike(where)
    count = len(found.policies)
    if len(pairs) == count * (count - 1) // 2:
        return f"no two policies are distinguishable by success in {place}"
    names = [" and ".join(pair) for pair in pairs[:LISTED_PAIRS]]
    if len(pairs) > LISTED_PAIRS:
        names.append(f"{len(pairs) - LISTED_PAIRS} other pairs")
    return f"not distinguishable by success in {place}: {'; '.join(names)}"


def show(found: PolicyEvaluation) -> None:
    """Print the table and what it means."""
    found, legend = renamed(found)
    print_lines(legend)
    print_table(list(COLUMNS), table(found))
    for sentence in sentences(found):
        print(sentence)


def write_report(results: dict[str, Any], page: str, folder: Path) -> Path:
    """Write results.json and report.html; return the path of the page. Finished policies are then removed."""
    folder.mkdir(parents=True, exist_ok=True)
    write_atomic(folder / "results.json", json.dumps(results, indent=1))
    write_atomic(folder / "report.html", page)
    remove_kept(folder / WORK)
    return folder / "report.html"


def html(found: PolicyEvaluation) -> str:
    """Return the page."""
    found, legend = renamed(found)
    count = len(found.policies[0].scores[TRUE])
    lead = (
        f"{found.embodiment} in {found.checkpoint} ({found.sampling}): {count} episodes of {found.frames} "
        "frames per policy, from the same first frames in the simulator and in the world model"
    )
    page = Page("Policies inside the world model", lead)
    figures = [
        (found.precision, "of the model's successes are confirmed by the simulator"),
        (found.recall, "of the simulator's successes are shown by the model"),
        (found.followed, "rank correlation of per-episode scores"),
        (found.auroc, "AUROC of per-episode scores"),
    ]
    if not found.refusal:
        figures = [
            (found.success["pearson"], "correlation of success rates"),
            (found.success["spearman"], "correlation of their ranks"),
            (found.success["mmrv"], "mean maximum rank violation"),
            *figures,
        ]
    page.figures([(_value(one), f"{words}{_ends(one)}") for one, words in figures])
    if found.refusal:  # before anybody reads the rates
        page.section("Do not rely on the model's rates", as_sentence(refused(found)))
    page.definitions(legend)
    # An interval below its value leaves room for the last columns.
    rows = []
    for name, *cells in table(found):
        rows.append([name, *(str(cell).replace(" (", "\n").rstrip(")") for cell in cells)])
    page.table(COLUMNS, rows)
    for sentence in sentences(found):
        if sentence != refused(found):
            page.text(as_sentence(sentence))
    page.section("Success rates", "A policy is a point; bars are 95 % intervals over episodes.")
    page.picture(_plot(found), "svg+xml", "Success in the simulator and in the model")
    for kind, title in OUTCOME_TITLES.items():
        chosen = list(_chosen(found, kind))[:SHOWN_EPISODES]
        if chosen:
            page.section(title)
        for one, number in chosen:
            strip = png_bytes(grid([list(one.true_images[number]), list(one.model_images[number])]))
            caption = (
                f"{one.policy}, episode {number}, frames {', '.join(map(str, one.shown))}: simulator above, "
                f"scored {one.scores[TRUE, number]:.1f} px, model below, judged "
                f"{one.scores[MODEL, number]:.1f} px"
            )
            page.picture(strip, "png", caption)
    return page.html()


def _value(found: Estimate) -> str:
    return "–" if found.value is None else f"{found.value:.2f}"


def _ends(found: Estimate) -> str:
    if found.value is None:
        return ""
    if found.low is None:
        return "; too few for an interval"
    return f"; 95 %: {found.low:.2f} to {found.high:.2f}"


def _chosen(found: PolicyEvaluation, kind: tuple[bool, bool]) -> Iterator[tuple[Scored, int]]:
    """Yield episodes of a kind, of each policy one before any second one."""
    there = [
        np.flatnonzero((one.success[TRUE] == kind[0]) & (one.success[MODEL] == kind[1]))
        for one in found.policies
    ]
    for turn in range(SHOWN_EPISODES):
        for one, numbers in zip(found.policies, there, strict=True):
            if turn < len(numbers):
                yield one, int(numbers[turn])


def _plot(found: PolicyEvaluation) -> bytes:
    names = "success in the simulator", "success in the model"
    figure, axes = labelled_axes(*names, size=(5.6, 4.4))
    axes.plot([0, 1], [0, 1], color="#999999", ls=":", lw=1)
    for i, row in enumerate(found.rows()):
        x = row["true_success"]
        y = row["model_success"]
        ends = ((x, row["true_success_interval"]), (y, row["model_success_interval"]))
        bars = [[[max(at - low, 0)], [max(high - at, 0)]] for at, (low, high) in ends]
        look: dict[str, Any] = {
            "color": COLOURS[i % len(COLOURS)],
            "fmt": MARKERS[i // len(COLOURS) % len(MARKERS)],
        }
        axes.errorbar([x], [y], xerr=bars[0], yerr=bars[1], label=row["policy"], ms=7, lw=1, **look)
    axes.set(xlim=(-0.05, 1.05), ylim=(-0.05, 1.05))
    axes.legend(frameon=False, fontsize=9)
    return svg_bytes(figure)
