"""Run `hma convert`: one conversion, a recipe of several, a share of one, or only its plan."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from enum import StrEnum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from hma_data.console import human_bytes, human_seconds, print_json, print_table, progress
from hma_data.errors import HMAError, UsageError

if TYPE_CHECKING:
    from hma_data.conversion.job import Progress, Shared, Summary
    from hma_data.conversion.output import Share
    from hma_data.conversion.recipe import ConversionJob

SHOWN = 20  # reasons of quarantine that are printed
Option = typer.Option


class Frames(StrEnum):
    all = "all"
    strided = "strided"


class Engine(StrEnum):
    local = "local"
    ray = "ray"


def convert(
    embodiment: Annotated[
        str | None, Option("--embodiment", "-e", help="Registry id, or a YAML file.")
    ] = None,
    out: Annotated[Path | None, Option("--out", help="Folder of the shard set.")] = None,
    source: Annotated[
        str | None, Option("--source", help="Recording; default: source.uri of the YAML.")
    ] = None,
    recipe: Annotated[
        Path | None, Option("--recipe", help="Several conversions: a YAML as in recipes/convert.")
    ] = None,
    tokenizer: Annotated[str, Option("--tokenizer", help="Name of the tokenizer.")] = "fsq-16",
    weights: Annotated[
        str | None, Option("--weights", help="The tokenizer's weights, if not the usual.")
    ] = None,
    device: Annotated[str, Option("--device", help="Where the tokenizer runs: cpu, cuda, mps.")] = "cpu",
    workers: Annotated[
        int, Option("--workers", min=0, help="Processes; 0 works in this one and survives no crash.")
    ] = 1,
    engine: Annotated[Engine, Option("--engine", help="What runs the workers.")] = Engine.local,
    limit: Annotated[int | None, Option("--limit", min=1, help="Only the first episodes.")] = None,
    frames: Annotated[Frames, Option("--frames", help="All rows, or the model's grid only.")] = Frames.all,
    frequency_hz: Annotated[
        float | None, Option("--frequency-hz", help="The recording's rate, where the YAML's is unknown.")
    ] = None,
    camera: Annotated[list[str] | None, Option("--camera", help="Camera to keep; repeat for more.")] = None,
    shard_frames: Annotated[
        int | None, Option("--shard-frames", min=1, help="About so many a shard.")
    ] = None,
    val_fraction: Annotated[float, Option("--val-fraction", help="Share of episodes for validation.")] = 0.05,
    seed: Annotated[int, Option("--seed", help="Of the split.")] = 0,
    max_quarantine: Annotated[
        float, Option("--max-quarantine", min=0, max=1, help="Share of bad episodes allowed.")
    ] = 0.01,
    episode_timeout: Annotated[
        float,
        Option(
            "--episode-timeout",
            min=0,
            help="Seconds without progress, then the episode is refused; 0: never.",
        ),
    ] = 300.0,
    extend: Annotated[
        bool, Option("--extend", help="Add the episodes that the set in --out does not have yet.")
    ] = False,
    overwrite: Annotated[bool, Option("--overwrite", help="Throw away the shard set in --out.")] = False,
    shard_index: Annotated[
        int | None, Option("--shard-index", min=0, help="This job's share of the shards, of --shard-count.")
    ] = None,
    shard_count: Annotated[
        int | None, Option("--shard-count", min=1, help="Jobs that share the work, e.g. a Slurm array.")
    ] = None,
    dry_run: Annotated[
        bool, Option("--dry-run", help="Print the plan, its size and time, and stop.")
    ] = False,
    json: Annotated[bool, Option("--json", help="Print JSON.")] = False,
) -> None:
    """Convert recordings to tokenized shards; run it again to continue.

    Example: hma convert -e my_arm.yaml --source ./demo.hdf5 --out shards/my_arm
    """
    from hma_data.conversion.output import Share
    from hma_data.conversion.recipe import job_of_options, load_jobs

    if extend and overwrite:
        raise UsageError("hma convert", "--extend keeps what --overwrite throws away", "give one of them")
    if recipe:
        if embodiment or out or source:
            raise UsageError("--recipe", "states embodiment, source and out itself", "leave the options out")
        jobs = load_jobs(recipe)
    else:
        if embodiment is None or out is None:
            raise UsageError(
                "hma convert", "needs --embodiment and --out, or --recipe", "see hma convert --help"
            )
        jobs = [
            job_of_options(
                embodiment=embodiment,
                out=out,
                source=source,
                tokenizer=tokenizer,
                weights=weights,
                device=device,
                workers=workers,
                engine=engine.value,
                limit=limit,
                frames=frames.value,
                frequency_hz=frequency_hz,
                cameras=tuple(camera or ()),
                shard_frames=shard_frames,
                val_fraction=_fraction(val_fraction),
                seed=seed,
                max_quarantine=max_quarantine,
                episode_timeout=episode_timeout,
            )
        ]
    if (shard_index is None) != (shard_count is None):
        raise UsageError("hma convert", "--shard-index and --shard-count belong together")
    share = None if shard_index is None or shard_count is None else Share(shard_index, shard_count)
    if share and share.index >= share.count:
        raise UsageError("--shard-index", f"must be below --shard-count {share.count}, is {share.index}")
    if share and (overwrite or engine is Engine.ray):
        raise UsageError("--shard-index", "goes with neither --overwrite nor --engine ray")
    run = _planned if dry_run else _shared if share else _converted
    _run_all(jobs, lambda job: run(job, json, extend=extend, overwrite=overwrite, share=share))


def _fraction(value: float) -> float:
    if not 0 <= value < 1:
        raise UsageError("--val-fraction", f"must lie in 0..1, is {value}")
    return value


def _run_all(jobs: "list[ConversionJob]", run: "Callable[[ConversionJob], bool]") -> None:
    """Run each job and exit; of several jobs, one that fails does not stop the others."""
    if len(jobs) == 1:
        raise typer.Exit(0 if run(jobs[0]) else 1)
    failed = 0
    for job in jobs:
        try:
            failed += not run(job)
        except HMAError as fault:
            failed += 1
            typer.echo(f"error: {job.embodiment}: {fault}", err=True)
    if failed:
        typer.echo(f"error: {failed} of {len(jobs)} conversions failed", err=True)
    raise typer.Exit(1 if failed else 0)


# -- kinds of runs


def _converted(
    job: "ConversionJob", json: bool, *, extend: bool, overwrite: bool, share: "Share | None"
) -> bool:
    from hma_data.conversion.engines.base import Limits
    from hma_data.conversion.job import convert as run

    with _shown(job) as on_progress:
        summary = run(
            _robot(job),
            job.source,
            job.tokenizer,
            job.out,
            settings=job.settings,
            workers=job.workers,
            engine=job.engine,
            weights=job.weights,
            device=job.device,
            limits=Limits(quiet_s=job.episode_timeout or None),
            max_quarantine=job.max_quarantine,
            overwrite=overwrite,
            extend=extend,
            on_progress=on_progress,
        )
    _report(summary, job.max_quarantine, json)
    return not summary.too_many


def _shared(
    job: "ConversionJob", json: bool, *, extend: bool, overwrite: bool, share: "Share | None"
) -> bool:
    from hma_data.conversion.engines.base import Limits
    from hma_data.conversion.job import convert_share

    assert share is not None
    with _shown(job) as on_progress:
        done = convert_share(
            _robot(job),
            job.source,
            job.tokenizer,
            job.out,
            share,
            settings=job.settings,
            workers=job.workers,
            weights=job.weights,
            device=job.device,
            limits=Limits(quiet_s=job.episode_timeout or None),
            extend=extend,
            on_progress=on_progress,
        )
    _report_share(done, share, json)
    return True


def _planned(
    job: "ConversionJob", json: bool, *, extend: bool, overwrite: bool, share: "Share | None"
) -> bool:
    from hma_data.conversion.job import plan_conversion
    from hma_data.conversion.plan import estimate
    from hma_data.storage.remote import place
    from hma_data.tokenizers.base import get_tokenizer

    robot = _robot(job)
    opened = get_tokenizer(job.tokenizer, weights=job.weights, device=job.device)
    plan, uri = plan_conversion(robot, job.source, opened, job.settings)
    cost = estimate(plan, uri, robot, opened, job.workers)
    units = [
        {"shard": unit.name, "episodes": len(unit.episodes), "frames": unit.frames} for unit in plan.units
    ]
    facts = {
        "source": uri,
        "out": str(place(job.out)),
        "episodes": plan.episodes,
        "frames": plan.frames,
        "bytes": cost.bytes,
        "frames_per_second": cost.frames_per_second,
        "seconds": cost.seconds,
        "shards": units,
    }
    if json:
        print_json(facts)
        return True
    print_table(["shard", "episodes", "frames, about"], [list(unit.values()) for unit in units])
    print(
        f"{uri}: {plan.episodes:,} episodes, about {plan.frames:,} frames into {len(units)} shards, "
        f"about {human_bytes(cost.bytes)}"
    )
    if cost.seconds is not None:
        print(
            f"about {human_seconds(cost.seconds)} with --workers {job.workers}: one does "
            f"{cost.frames_per_second:,.0f} frames/s, measured on one episode"
        )
    else:
        print(f"time unknown, no episode could be read: {cost.fault}")
    return True


def _robot(job: "ConversionJob") -> Any:
    from hma_data.registry.embodiment import find

    robot = find(job.embodiment)
    return robot if job.frequency_hz is None else robot.with_rate(job.frequency_hz)


# -- what is shown


@contextmanager
def _shown(job: "ConversionJob") -> "Iterator[Callable[[Progress], None]]":
    with progress(f"convert {Path(job.embodiment).stem}") as update:
        told = 0

        def show(state: "Progress") -> None:
            nonlocal told
            for reason in state.retries[told:]:
                typer.echo(f"again: a worker {reason}", err=True)
            told = len(state.retries)
            words = f"{state.episodes:,}/{state.total_episodes:,} episodes, {human_bytes(state.bytes)}"
            if state.quarantined:
                words += f", {state.quarantined:,} in quarantine"
            update(state.frames, words, state.total_frames)

        yield show


def _report_share(done: "Shared", share: "Share", json: bool) -> None:
    if json:
        print_json(
            {
                "out": str(done.out),
                "shards_made": done.made_shards,
                "shards_kept": done.kept_shards,
                "shards_missing": done.missing,
                "seconds": done.seconds,
            }
        )
        return
    said = (
        f"{done.missing} shards are left to the other shares; the last of them writes the manifest"
        if done.missing
        else "all shards are there, the manifest is written"
    )
    print(
        f"{done.out}: share {share.name} made {done.made_shards} shards "
        f"({done.kept_shards} were there already), {human_seconds(done.seconds)}; {said}"
    )


def _report(summary: "Summary", max_quarantine: float, json: bool) -> None:
    manifest = summary.manifest
    totals = manifest.to_json()["totals"]
    if json:
        print_json(
            {
                "out": str(summary.out),
                **totals,
                "splits": manifest.splits,
                "shards_made": summary.made_shards,
                "shards_kept": summary.kept_shards,
                "seconds": summary.seconds,
                "flags": summary.flags,
                "reasons": summary.reasons,
                "too_many_quarantined": summary.too_many,
            }
        )
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
    for reason, count in sorted(summary.reasons.items(), key=lambda item: -item[1])[:SHOWN]:
        typer.echo(f"quarantine: {count:,} × {reason}", err=True)
    if summary.too_many:
        typer.echo(
            f"error: {summary.out}: {totals['quarantined']:,} episodes are in quarantine, more than "
            f"--max-quarantine {max_quarantine:g} allows — see quarantine.jsonl; what was converted is kept",
            err=True,
        )
