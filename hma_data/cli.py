"""The data verbs of `hma`: inspect, doctor, mixture; the others in modules of their own.

Only what is light is imported here; each verb imports what it needs.
"""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from hma_data.cli_bench import bench
from hma_data.cli_convert import convert
from hma_data.cli_registry import registry_app
from hma_data.cli_shards import shards_app
from hma_data.cli_tokenizer import tokenizer_app
from hma_data.console import print_json, print_table

Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]


def mount(app: typer.Typer) -> None:
    """Add every data verb to the command."""
    app.add_typer(registry_app, name="registry")
    app.command("inspect")(inspect)
    app.command("doctor")(doctor)
    app.command("convert")(convert)
    app.add_typer(shards_app, name="shards")
    app.command("mixture")(mixture)
    app.add_typer(tokenizer_app, name="tokenizer")
    app.command("bench")(bench)


# -- recordings


def inspect(
    uri: Annotated[str, typer.Argument(help="A recording: file, folder or URI.")],
    embodiment: Annotated[
        str | None, typer.Option("--embodiment", "-e", help="Check against this embodiment.")
    ] = None,
    json: Json = False,
) -> None:
    """What is in a recording.

    Example: hma inspect ./demo.hdf5
    """
    from hma_data.inspect import inspect_recording

    report = inspect_recording(uri, embodiment)
    if json:
        print_json(report)
    else:
        _print_inspection(report)
    raise typer.Exit(1 if report["problems"] else 0)


def _print_inspection(report: dict[str, Any]) -> None:
    facts = [f"{report['format']}", f"{report['episodes']:,} episodes"]
    if report["frames"]:
        facts.append(f"{report['frames']:,} frames")
    if report["hz"]:
        facts.append(f"{report['hz']:g} Hz")
    if report["robot"]:
        facts.append(report["robot"])
    print(f"{report['uri']}: " + ", ".join(facts))
    if report["lengths"]:
        lengths = sorted(report["lengths"])
        print(f"episode lengths: {lengths[0]} to {lengths[-1]}, median {lengths[len(lengths) // 2]}")
    rows = [
        [
            key["key"],
            key["kind"],
            "×".join(map(str, key["shape"])) or "1",
            key["dtype"],
            key["codec"],
            key["hz"],
            key["jitter_ms"],
            key["count"],
            " ".join(key["names"] or [])[:60] or None,
        ]
        for key in report["keys"]
    ]
    print_table(["key", "kind", "shape", "dtype", "codec", "Hz", "jitter ms", "count", "names"], rows)
    for name, value in report["facts"].items():
        print(f"{name}: {value}")
    for name, value in report.get("embodiment", {}).items():
        print(f"{name}: {value}")
    for problem in report["problems"]:
        print(f"problem: {problem}")


class Severity(StrEnum):
    info = "info"
    warn = "warn"
    error = "error"


def doctor(
    target: Annotated[str, typer.Argument(help="A recording, or the folder of a shard set.")],
    embodiment: Annotated[
        str | None, typer.Option("--embodiment", "-e", help="Look into the episodes as this robot's.")
    ] = None,
    episodes: Annotated[int, typer.Option("--episodes", min=1, help="How many are looked into.")] = 20,
    fail_on: Annotated[
        Severity, typer.Option("--fail-on", help="Exit with 1 from this severity on.")
    ] = Severity.error,
    json: Json = False,
) -> None:
    """Health checks: what of a recording or shard set will hurt training.

    Example: hma doctor ./demo.hdf5 -e my_arm.yaml --fail-on warn
    """
    from hma_data.doctor import SEVERITIES, examine

    found = examine(target, embodiment, episodes)
    if json:
        print_json({"target": target, "findings": [finding.to_json() for finding in found]})
    else:
        for finding in found:
            remedy = f" — {finding.remedy}" if finding.remedy else ""
            print(f"{finding.severity:5} {finding.check}: {finding.message}{remedy}")
        print(f"{target}: {sum(finding.severity != 'info' for finding in found)} findings")
    worst = max((SEVERITIES.index(finding.severity) for finding in found), default=-1)
    raise typer.Exit(1 if worst >= SEVERITIES.index(fail_on.value) else 0)


# -- mixture


def mixture(
    folders: Annotated[list[Path], typer.Argument(help="Shard sets.")],
    temperature: Annotated[
        float, typer.Option("--temperature", help="τ: 1 proportional, large uniform.")
    ] = 3.0,
    frames: Annotated[int, typer.Option("--frames", min=2, help="T of a window.")] = 12,
    split: Annotated[str, typer.Option("--split", help="train or val.")] = "train",
    plot: Annotated[Path | None, typer.Option("--plot", help="PNG or SVG to draw.")] = None,
    json: Json = False,
) -> None:
    """How often each embodiment is drawn.

    Example: hma mixture shards/a shards/b --plot mixture.png
    """
    from hma_data.loader import open_sets
    from hma_data.mixture import Mixture
    from hma_data.windows import WindowIndex

    sets = open_sets(list(folders))
    indexes = {name: WindowIndex.of(shards, split, frames) for name, shards in sets.items()}
    mix = Mixture.of({name: index.count for name, index in indexes.items()}, temperature)
    total = sum(mix.counts)
    rows = [
        {
            "embodiment": name,
            "windows": count,
            "short_episodes": indexes[name].short_episodes,
            "proportional": count / total,
            "probability": float(p),
        }
        for name, count, p in zip(mix.names, mix.counts, mix.p)
    ]
    if plot:
        from hma_data.plots import plot_mixture

        plot_mixture(mix, temperature, plot)
    if json:
        print_json({"temperature": temperature, "frames": frames, "split": split, "embodiments": rows})
    else:
        print_table(
            ["embodiment", "windows", "episodes too short", "proportional", f"p at τ = {temperature:g}"],
            [list(r.values()) for r in rows],
        )
