"""Run `hma inspect` (what is in a recording) and `hma doctor` (what in it will hurt training)."""

from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, NoReturn

import typer
from typer import Argument

from hma_data.cli.options import Episodes, FailOn, Json, robot_option
from hma_data.console import human_count, human_number, print_json, print_lines, print_table, say

if TYPE_CHECKING:
    from hma_data.inspection.folder import Found

COLUMNS = ["key", "shape", "dtype", "Hz", "jitter ms", "skew ms", "count", "values"]
NO_JITTER_MS = 0.001  # a smaller jitter comes from rounded stamps


def inspect(
    uri: Annotated[str, Argument(help="A recording (file, folder or URI), or a folder of several.")],
    embodiment: Annotated[
        str | None, robot_option("Check whether this robot fits: a registry id, or a YAML file.")
    ] = None,
    episodes: Episodes = 20,
    fail_on: FailOn = "error",
    json: Json = False,
) -> None:
    """Show the contents of a recording, or list the recordings in a folder.

    Exits with 1 if there is a finding of severity --fail-on or worse, as hma doctor does.

    Example: hma inspect ./demo.hdf5
    """
    if embodiment is None and Path(uri).expanduser().is_dir():
        from hma_data.inspection.folder import several

        if recordings := several(uri):
            _list(uri, [found.counted() for found in recordings], json)
            return
    from hma_data.inspection.inspect import inspect_recording

    report = inspect_recording(uri, embodiment, episodes)
    if json:
        print_json(report)
    else:
        _print_inspection(report)
    _exit([finding["severity"] for finding in report["findings"]], fail_on)


def _exit(found: list[str], fail_on: str) -> NoReturn:
    """Exit with 1 if one of the severities is `fail_on` or worse, else with 0."""
    from hma_data.sources.common.checks import SEVERITIES

    levels: list[str] = [*SEVERITIES, "never"]
    raise typer.Exit(int(any(levels.index(one) >= levels.index(fail_on) for one in found)))


def _list(folder: str, found: "list[Found]", json: bool) -> None:
    """Print the recordings of a folder, each with the command that looks at it."""
    if json:
        print_json({"folder": folder, "recordings": [one.to_json() for one in found]})
        return
    say(f"{folder}: {human_count(len(found), 'recording')}; inspect them one by one:")
    rows = [[one.command, one.format, one.episodes] for one in found]
    print_table(["command", "format", "episodes"], rows)
    for one in found:
        if one.problem:
            say(f"cannot be counted: {one.problem}")


def _print_inspection(report: dict[str, Any]) -> None:
    episodes = human_count(report["episodes"], "episode")
    frames = f"{report['frames']:,} frames" if report["frames"] else None
    rate = f"{report['hz']:.4g} Hz" if report["hz"] else None
    facts = [report["format"], episodes, frames, rate, report["robot"]]
    say(f"{report['uri']}: " + ", ".join(fact for fact in facts if fact))
    lengths = sorted(report["lengths"])
    if lengths:
        told = "" if len(lengths) == report["episodes"] else f" of the {len(lengths):,} counted"
        middle = lengths[len(lengths) // 2]
        say(f"episode lengths{told}: min {lengths[0]:,}, median {middle:,}, max {lengths[-1]:,} frames")
    say(f"sampled: {report['looked_at']:,} of {episodes}")
    print_table(COLUMNS, [_row(key) for key in report["keys"]])
    named = {key["key"]: " ".join(key["names"]) for key in report["keys"] if key["names"]}
    print_lines([(f"names of {key}", names) for key, names in named.items()])
    print_lines([*report["facts"].items(), *report.get("embodiment", {}).items()])
    print()
    _print_checks(report)


def _row(key: dict[str, Any]) -> list[Any]:
    """Return the table row of one key: cameras with their codec, the skew as p50/p95/max."""
    skew = "/".join(f"{part:.3g}" for part in key["skew_ms"]) if key["skew_ms"] else None
    kind = {"camera": f"{key['dtype']} {key['codec'] or ''}", "text": "text"}.get(key["kind"], key["dtype"])
    bounds = [human_number(key[side]) for side in ("low", "high")]
    jitter = key["jitter_ms"]
    return [
        key["key"],
        "×".join(map(str, key["shape"])) or "1",
        kind.strip(),
        human_number(key["hz"]),
        human_number(0.0 if jitter is not None and jitter < NO_JITTER_MS else jitter),
        skew,
        key["count"],
        None if bounds[0] is None else f"{bounds[0]} to {bounds[1]}",
    ]


def _print_checks(report: dict[str, Any]) -> None:
    """Print the checks with their results, one line for each finding, and one of what was not checked."""
    from hma_data.inspection.inspect import NOT_CHECKED
    from hma_data.sources.common.survey import CHECKS

    findings: dict[str, list[str]] = {}
    for finding in report["findings"]:
        remedy = f" — {finding['remedy']}" if finding["remedy"] else ""
        said = f"{finding['severity']}: {finding['message']}{remedy}"
        findings.setdefault(finding["check"], []).append(said)
    titles = {**CHECKS, "fits": "the embodiment fits", "usable": "episodes the embodiment can use"}
    titles["robot"] = "frames and actions of a robot"
    done = {check: result for check, result in report["checks"].items() if result != NOT_CHECKED}
    print_lines(
        (titles.get(check, check), line)
        for check, result in done.items()
        for line in findings.get(check, [result])
    )
    if others := [titles.get(check, check) for check in report["checks"] if check not in done]:
        say(f"{NOT_CHECKED}: {', '.join(others)}")


def doctor(
    target: Annotated[str, Argument(help="A recording, or the folder of a shard set.")],
    embodiment: Annotated[str | None, robot_option("Check the episodes against this robot's YAML.")] = None,
    episodes: Episodes = 20,
    fail_on: FailOn = "error",
    json: Json = False,
) -> None:
    """Check a recording or shard set for problems that hurt training.

    Example: hma doctor ./demo.hdf5 -e my_arm.yaml --fail-on warn
    """
    from hma_data.inspection.inspect import examine
    from hma_data.sources.common.checks import SEVERITIES

    found = examine(target, embodiment, episodes)
    if json:
        print_json({"target": target, "findings": [finding.to_json() for finding in found]})
    else:
        print_lines((f"{finding.severity:5} {finding.check}", str(finding)) for finding in found)
        counts = [f"{sum(one.severity == level for one in found)} {level}" for level in reversed(SEVERITIES)]
        print(f"{target}: {', '.join(counts)}" if found else f"{target}: no problems found")
    _exit([finding.severity for finding in found], fail_on)
