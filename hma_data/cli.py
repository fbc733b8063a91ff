"""The data verbs of `hma`: inspect, convert, mixture; registry, shards and tokenizer in modules of their own.

Only what is light is imported here; each verb imports what it needs.
"""

from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any

import typer

from hma_data.cli_bench import bench
from hma_data.cli_registry import registry_app
from hma_data.cli_shards import shards_app
from hma_data.cli_tokenizer import tokenizer_app
from hma_data.console import human_bytes, human_seconds, print_json, print_table, progress

Json = Annotated[bool, typer.Option("--json", help="Print JSON.")]
EmbodimentOption = Annotated[str, typer.Option("--embodiment", "-e", help="Registry id, or a YAML file.")]


class Frames(StrEnum):
    all = "all"
    strided = "strided"


class Engine(StrEnum):
    local = "local"


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


def convert(
    embodiment: EmbodimentOption,
    out: Annotated[Path, typer.Option("--out", help="Folder of the shard set.")],
    source: Annotated[
        str | None, typer.Option("--source", help="Recording; default: source.uri of the YAML.")
    ] = None,
    tokenizer: Annotated[str, typer.Option("--tokenizer", help="Name of the tokenizer.")] = "fsq-16",
    weights: Annotated[
        str | None, typer.Option("--weights", help="The tokenizer's weights, if not the usual.")
    ] = None,
    device: Annotated[
        str, typer.Option("--device", help="Where the tokenizer runs: cpu, cuda, mps.")
    ] = "cpu",
    workers: Annotated[int | None, typer.Option("--workers", min=1, help="Processes; default: one.")] = None,
    engine: Annotated[Engine, typer.Option("--engine", help="What runs the work.")] = Engine.local,
    limit: Annotated[int | None, typer.Option("--limit", min=1, help="Only the first episodes.")] = None,
    frames: Annotated[
        Frames, typer.Option("--frames", help="All rows, or the model's grid only.")
    ] = Frames.all,
    frequency_hz: Annotated[
        float | None,
        typer.Option("--frequency-hz", help="The recording's rate, where the YAML's is unknown."),
    ] = None,
    camera: Annotated[
        list[str] | None, typer.Option("--camera", help="Camera to keep; repeat for more.")
    ] = None,
    shard_frames: Annotated[
        int | None, typer.Option("--shard-frames", min=1, help="About so many a shard.")
    ] = None,
    val_fraction: Annotated[
        float, typer.Option("--val-fraction", help="Share of episodes for validation.")
    ] = 0.05,
    seed: Annotated[int, typer.Option("--seed", help="Of the split.")] = 0,
    max_quarantine: Annotated[
        float, typer.Option("--max-quarantine", min=0, max=1, help="Share of bad episodes allowed.")
    ] = 0.01,
    overwrite: Annotated[
        bool, typer.Option("--overwrite", help="Throw away the shard set in --out.")
    ] = False,
    dry_run: Annotated[bool, typer.Option("--dry-run", help="Print the plan and stop.")] = False,
    json: Json = False,
) -> None:
    """Recordings to tokenized shards; run it again to continue.

    Example: hma convert -e my_arm.yaml --source ./demo.hdf5 --out shards/my_arm
    """
    from hma_data.convert import Progress, plan_conversion
    from hma_data.convert import convert as run
    from hma_data.embodiment import find
    from hma_data.plan import Settings
    from hma_data.tokenizers.base import get_tokenizer

    robot = find(embodiment)
    if frequency_hz is not None:
        robot = robot.with_rate(frequency_hz)
    settings = Settings(frames.value, tuple(camera or ()), val_fraction, seed, limit, shard_frames)
    if dry_run:
        plan, uri = plan_conversion(
            robot, source, get_tokenizer(tokenizer, weights=weights, device=device), settings
        )
        units = [{"shard": u.name, "episodes": len(u.episodes), "frames": u.frames} for u in plan.units]
        facts = {"source": uri, "episodes": plan.episodes, "frames": plan.frames, "shards": units}
        if json:
            print_json(facts)
        else:
            print(f"{uri}: {plan.episodes:,} episodes, about {plan.frames:,} frames into {len(units)} shards")
            print_table(["shard", "episodes", "frames, about"], [list(unit.values()) for unit in units])
        return
    with progress(f"convert {robot.id}") as update:

        def show(state: Progress) -> None:
            words = f"{state.episodes:,}/{state.total_episodes:,} episodes, {human_bytes(state.bytes)}"
            if state.quarantined:
                words += f", {state.quarantined:,} in quarantine"
            update(state.frames, words, state.total_frames)

        summary = run(
            robot,
            source,
            tokenizer,
            out,
            settings=settings,
            workers=workers or 1,
            weights=weights,
            device=device,
            max_quarantine=max_quarantine,
            overwrite=overwrite,
            on_progress=show,
        )
    _report_conversion(summary, max_quarantine, json)
    raise typer.Exit(1 if summary.too_many else 0)


def _report_conversion(summary: Any, max_quarantine: float, json: bool) -> None:
    manifest = summary.manifest
    totals = manifest.to_json()["totals"]
    if json:
        facts = {
            "out": str(summary.out),
            **totals,
            "splits": manifest.splits,
            "shards_made": summary.made_shards,
            "shards_kept": summary.kept_shards,
            "seconds": summary.seconds,
            "reasons": summary.reasons,
            "flags": summary.flags,
            "too_many_quarantined": summary.too_many,
        }
        print_json(facts)
    else:
        splits = ", ".join(f"{name} {split['episodes']:,}" for name, split in manifest.splits.items())
        kept = f" ({summary.kept_shards} were there already)" if summary.kept_shards else ""
        print(
            f"{summary.out}: {totals['episodes']:,} episodes ({splits}), {totals['frames']:,} frames, "
            f"{human_bytes(totals['bytes'])} in "
            f"{len(manifest.shards)} shards{kept}, {human_seconds(summary.seconds)}"
        )
        if summary.flags:
            counts = [f"{count:,} {name.replace('_', ' ')}" for name, count in summary.flags.items()]
            print(f"flags: {', '.join(counts)}")
    for reason, count in sorted(summary.reasons.items(), key=lambda item: -item[1])[:20]:
        typer.echo(f"quarantine: {count:,} × {reason}", err=True)
    if summary.too_many:
        typer.echo(
            f"error: {summary.out}: {totals['quarantined']:,} episodes are in quarantine, more than "
            f"--max-quarantine {max_quarantine:g} allows — see quarantine.jsonl; what was converted is kept",
            err=True,
        )


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
