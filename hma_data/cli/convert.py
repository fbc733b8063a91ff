"""Run `hma convert`: a conversion, a share of one, or only its plan."""

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer import Option

from hma_data.cli.complete import robots, tokenizers
from hma_data.console import (
    human_bytes,
    human_count,
    human_seconds,
    interruptible,
    print_json,
    print_table,
    progress,
)
from hma_data.errors import UsageError

if TYPE_CHECKING:
    from hma_data.conversion.output import Share
    from hma_data.conversion.plan import Settings
    from hma_data.conversion.report import Progress, Shared, Summary

SHOWN = 20  # reasons of quarantine that are printed
DATA, BAD, OLD = "What is kept, and the split", "Episodes that cannot be used", "If --out holds a shard set"
JOBS, RARE = "Several machines", "Rarely needed"

Text = str | None
CHOICE = "ID|GLOB|@FILE"


@dataclass(frozen=True)
class _Job:
    """The conversion that the options state."""

    embodiment: str
    out: Path
    source: str | None
    tokenizer: str
    weights: str | None
    device: str
    workers: int
    engine: Literal["local", "ray"]
    worker_cpus: float
    worker_gpus: float | None
    frequency_hz: float | None
    max_quarantine: float
    episode_timeout: float
    settings: "Settings"


def convert(
    embodiment: Annotated[
        str,
        Option(
            "--embodiment",
            "-e",
            help="The robot: an id of the registry, or a YAML file.",
            autocompletion=robots,
        ),
    ],
    out: Annotated[Path, Option(help="Folder of the shard set.")],
    source: Annotated[
        Text, Option(help="Recording: file, folder or URI; default: source.uri of the YAML.")
    ] = None,
    tokenizer: Annotated[
        str, Option(help="Name of the tokenizer; see hma tokenizer list.", autocompletion=tokenizers)
    ] = "fsq-16",
    weights: Annotated[
        Text, Option(help="The tokenizer's weights, if not the usual ones.", rich_help_panel=RARE)
    ] = None,
    device: Annotated[str, Option(help="Where the tokenizer runs: cpu, cuda, mps.")] = "cpu",
    workers: Annotated[int, Option(min=0, help="Processes; 0 works in this one and survives no crash.")] = 1,
    engine: Annotated[
        Literal["local", "ray"], Option(help="What runs the workers.", rich_help_panel=JOBS)
    ] = "local",
    worker_cpus: Annotated[
        float, Option(min=0, help="CPUs that a worker of Ray reserves.", rich_help_panel=JOBS)
    ] = 1.0,
    worker_gpus: Annotated[
        float | None,
        Option(min=0, help="GPUs of a worker of Ray; default: 1 with --device cuda.", rich_help_panel=JOBS),
    ] = None,
    limit: Annotated[
        int | None, Option(min=1, help="Convert only so many episodes, from the first on.")
    ] = None,
    only: Annotated[
        list[str] | None,
        Option(
            help="Episode to take: id, glob or @FILE of ids; repeat it for more.",
            metavar=CHOICE,
            rich_help_panel=DATA,
        ),
    ] = None,
    exclude: Annotated[
        list[str] | None,
        Option(
            help="Episode to leave out: id, glob or @FILE of ids; repeat it for more.",
            metavar=CHOICE,
            rich_help_panel=DATA,
        ),
    ] = None,
    frames: Annotated[
        Literal["all", "strided"],
        Option(help="Keep all rows, or only those of the model's grid.", rich_help_panel=DATA),
    ] = "all",
    frequency_hz: Annotated[
        float | None,
        Option(help="Rate of the recording, where the YAML does not know it.", rich_help_panel=DATA),
    ] = None,
    cameras: Annotated[
        list[str] | None,
        Option(
            "--cameras",
            "--camera",
            metavar="all|NAME[,NAME…]",
            help="Cameras to store; default: the YAML's first.",
        ),
    ] = None,
    shard_frames: Annotated[
        int | None, Option(min=1, help="Frames in a shard, about.", rich_help_panel=RARE)
    ] = None,
    val_fraction: Annotated[
        float,
        Option(
            help="Share of episodes for validation; a recording with a split of its own keeps that.",
            rich_help_panel=DATA,
        ),
    ] = 0.05,
    seed: Annotated[int, Option(help="Seed of the split.", rich_help_panel=DATA)] = 0,
    max_quarantine: Annotated[
        float,
        Option(min=0, max=1, help="Fail if a larger share of episodes is refused.", rich_help_panel=BAD),
    ] = 0.01,
    episode_timeout: Annotated[
        float,
        Option(
            min=0,
            help="Refuse an episode after this many seconds without progress; 0: never.",
            rich_help_panel=BAD,
        ),
    ] = 300.0,
    extend: Annotated[
        bool,
        Option(
            "--extend", help="Add the episodes that the set in --out does not have yet.", rich_help_panel=OLD
        ),
    ] = False,
    overwrite: Annotated[
        bool, Option("--overwrite", help="Delete the shard set in --out first.", rich_help_panel=OLD)
    ] = False,
    shard_index: Annotated[
        int | None,
        Option(
            min=0, help="Which share of the shards this job makes, of --shard-count.", rich_help_panel=JOBS
        ),
    ] = None,
    shard_count: Annotated[
        int | None,
        Option(min=1, help="Jobs that share the work, for example a Slurm array.", rich_help_panel=JOBS),
    ] = None,
    dry_run: Annotated[
        bool, Option("--dry-run", help="Only print the plan, its size and its time; write nothing.")
    ] = False,
    json: Annotated[bool, Option("--json", help="Print JSON.")] = False,
) -> None:
    """Convert recordings to tokenized shards; run it again to continue.

    Example: hma convert -e my_arm.yaml --source ./demo.hdf5 --out shards/my_arm
    """
    from hma_data.conversion.output import Share
    from hma_data.conversion.plan import Settings

    if extend and overwrite:
        raise UsageError("hma convert", "--extend keeps what --overwrite deletes", "give one of them")
    names = tuple(name.strip() for word in cameras or () for name in word.split(",") if name.strip())
    choice = tuple(only or ()), tuple(exclude or ())
    settings = Settings(frames, names, val_fraction, seed, limit, shard_frames, *choice)
    job = _Job(
        embodiment=embodiment,
        out=out,
        source=source,
        tokenizer=tokenizer,
        weights=weights,
        device=device,
        workers=workers,
        engine=engine,
        worker_cpus=worker_cpus,
        worker_gpus=worker_gpus,
        frequency_hz=frequency_hz,
        max_quarantine=max_quarantine,
        episode_timeout=episode_timeout,
        settings=settings,
    )
    share = None
    if shard_index is not None and shard_count is not None:
        share = Share(shard_index, shard_count)
        if shard_index >= shard_count:
            raise UsageError("--shard-index", f"must be below --shard-count {shard_count}, is {shard_index}")
        if overwrite or engine == "ray":
            raise UsageError("--shard-index", "cannot be combined with --overwrite or --engine ray")
    elif shard_index is not None or shard_count is not None:
        raise UsageError("hma convert", "--shard-index and --shard-count belong together", "give both")
    sound = _plan(job, json, share) if dry_run else _convert(job, json, extend, overwrite, share)
    raise typer.Exit(0 if sound else 1)


def _convert(job: _Job, json: bool, extend: bool, overwrite: bool, share: "Share | None") -> bool:
    """Run a conversion, or a share of it; return False if too many episodes are in quarantine."""
    robot = _ready(job)
    from hma_data.conversion.engines import Limits, Resources
    from hma_data.conversion.job import convert as run
    from hma_data.conversion.job import convert_share

    what = (robot, job.source, job.tokenizer, job.out)
    with interruptible(lambda: _kept(job, overwrite)), _shown(job) as on_progress:
        options: dict[str, Any] = {
            "settings": job.settings,
            "workers": job.workers,
            "weights": job.weights,
            "device": job.device,
            "limits": Limits(quiet_s=job.episode_timeout or None),
            "extend": extend,
            "on_progress": on_progress,
        }
        if share:
            done = convert_share(*what, share, **options)
        else:
            options |= {"engine": job.engine, "max_quarantine": job.max_quarantine}
            options["resources"] = Resources(job.worker_cpus, job.worker_gpus)
            summary = run(*what, overwrite=overwrite, **options)
    if share:
        _report_share(done, share, json)
        return True
    _report(summary, job.max_quarantine, json)
    return not summary.too_many


def _kept(job: _Job, overwrite: bool) -> str:
    """Return what a Ctrl-C leaves, and how to go on."""
    from hma_data.storage.remote import is_remote, place

    out = place(job.out)
    again = "run the same command again" + (", without --overwrite," if overwrite else "") + " to continue"
    if is_remote(out):
        return f"finished shards in {job.out} kept; {again}"
    shards = sum(1 for _ in out.glob("*/shard-*.parquet"))
    return f"{human_count(shards, 'finished shard')} in {job.out} kept; {again}"


def _plan(job: _Job, json: bool, share: "Share | None") -> bool:
    robot = _ready(job)
    from hma_data.conversion.job import plan_conversion
    from hma_data.conversion.plan import estimate, idle_workers
    from hma_data.shards.manifest import cameras_line
    from hma_data.storage.remote import place
    from hma_data.tokenizers.base import get_tokenizer

    opened = get_tokenizer(job.tokenizer, weights=job.weights, device=job.device)
    plan, uri = plan_conversion(robot, job.source, opened.spec, job.settings)
    tasks = share.count if share else 1
    cost = estimate(plan, uri, robot, opened, job.workers, tasks)
    units = [{"shard": unit.name, "episodes": len(unit), "frames": unit.frames} for unit in plan.units]
    if json:
        print_json(
            {
                "source": uri,
                "out": str(place(job.out)),
                "episodes": plan.episodes,
                "left_out": plan.left_out,
                "frames": plan.frames,
                "bytes": cost.bytes,
                "frames_per_second": cost.frames_per_second,
                "seconds": cost.seconds,
                "cameras": plan.facts["cameras"],
                "pictures": cost.pictures,
                "shards": units,
            }
        )
        return True
    print_table(["shard", "episodes", "recorded frames, about"], [list(unit.values()) for unit in units])
    stride = plan.facts["frame_stride"]
    kept = f" (1 of {stride} is kept)" if stride > 1 else ""
    print(
        f"{uri}: {human_count(plan.episodes, 'episode')}, about {plan.frames:,} recorded frames{kept} into "
        f"{human_count(len(units), 'shard')}, about {human_bytes(cost.bytes)}"
    )
    _print_cameras(cameras_line(plan.facts["cameras"], robot), cost.pictures, robot, opened.spec.image_size)
    _print_left_out(plan.left_out)
    if cost.seconds is None:
        print(f"time unknown, no episode could be read: {cost.fault}")
    else:
        each = f" in each of {tasks} tasks" if tasks > 1 else ""
        print(
            f"about {human_seconds(cost.seconds)} with --workers {job.workers}{each}: one worker converts "
            f"{cost.frames_per_second:,.0f} frames/s, measured on one episode"
        )
    if idle := idle_workers(plan, len(units[share.index :: tasks] if share else units), job.workers, tasks):
        print(idle)
    return True


def _print_cameras(line: str, pictures: dict[str, tuple[int, int]], robot: Any, size: int) -> None:
    """Print which cameras are stored, and what becomes of their pictures."""
    from hma_data.episodes.images import describe_resize

    print(f"cameras: {line}")
    for name, (height, width) in pictures.items():
        print(describe_resize(robot.camera(name), height, width, size))


def _ready(job: _Job) -> Any:
    """Return the robot; refuse what can be seen from the command line before torch is imported."""
    from hma_data.registry.embodiment import find
    from hma_data.sources.detect import require_there
    from hma_data.tokenizers.catalog import find_entry

    robot = find(job.embodiment)
    find_entry(job.tokenizer)
    require_there(job.source or robot.source.uri or "")
    return robot if job.frequency_hz is None else robot.with_rate(job.frequency_hz)


@contextmanager
def _shown(job: _Job) -> "Iterator[Callable[[Progress], None]]":
    with progress(f"convert {Path(job.embodiment).stem}") as update:
        noticed = told = 0

        def show(state: "Progress") -> None:
            nonlocal noticed, told
            for line in state.notices[noticed:]:
                typer.echo(line, err=True)
            for reason in state.retries[told:]:
                typer.echo(f"again: a worker {reason}", err=True)
            noticed, told = len(state.notices), len(state.retries)
            words = f"{state.episodes:,}/{state.total_episodes:,} episodes, {human_bytes(state.bytes)}"
            if state.quarantined:
                words += f", {state.quarantined:,} in quarantine"
            update(state.frames, words, state.total_frames)

        yield show


def _report_share(done: "Shared", share: "Share", json: bool) -> None:
    if json:
        facts = {"shards_made": done.made_shards, "shards_kept": done.kept_shards}
        facts |= {"shards_missing": done.missing}
        told = {"changed": done.changed, "warning": done.warning}
        print_json({"out": str(done.out), **facts, **told, "seconds": done.seconds})
        return
    said = "all shards are there, the manifest is written"
    if done.missing:
        missing = human_count(done.missing, "shard")
        said = f"{missing} left to the other shares; the last of them writes the manifest"
    print(
        f"{done.out}: share {share.name} made {human_count(done.made_shards, 'shard')} "
        f"({done.kept_shards} were there already), {human_seconds(done.seconds)}; {said}"
    )
    _print_changes(done)


def _print_changes(done: "Shared | Summary") -> None:
    """Print what of the YAML is new in a finished set, and the fault of its rate, a line each."""
    if done.changed:
        print(done.changed)
    if done.warning:
        typer.echo(f"warning: {done.warning}", err=True)


def _print_left_out(count: int) -> None:
    if count:
        print(f"left out by only and exclude: {count:,} episode{'s' if count > 1 else ''}")


def _report(summary: "Summary", max_quarantine: float, json: bool) -> None:
    from hma_data.cli.shards import totals_line
    from hma_data.shards.schema import flag_words

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
                "cameras": manifest.cameras,
                "pictures": summary.pictures,
                "flags": summary.flags,
                "left_out": summary.left_out,
                "changed": summary.changed,
                "warning": summary.warning,
                "notes": list(summary.notes),
                "reasons": summary.reasons,
                "too_many_quarantined": summary.too_many,
            }
        )
    else:
        kept = f" ({summary.kept_shards} were there already)" if summary.kept_shards else ""
        print(f"{totals_line(summary.out, manifest)}{kept}, {human_seconds(summary.seconds)}")
        robot, size = manifest.embodiment, manifest.tokenizer.image_size
        _print_cameras(manifest.cameras_line, summary.pictures, robot, size)
        _print_left_out(summary.left_out)
        if summary.flags:
            counts = [f"{count:,} {flag_words(name)}" for name, count in summary.flags.items()]
            print(f"flags: {', '.join(counts)}")
        _print_changes(summary)
        for note in summary.notes:
            typer.echo(f"warning: {note}", err=True)
    for reason, count in sorted(summary.reasons.items(), key=lambda item: -item[1])[:SHOWN]:
        typer.echo(f"quarantine: {count:,} × {reason}", err=True)
    if summary.too_many:
        typer.echo(
            f"error: {summary.out}: {human_count(totals['quarantined'], 'episode')} in quarantine, more than "
            f"--max-quarantine {max_quarantine:g} allows; what was converted is kept "
            "— see quarantine.jsonl; --exclude leaves them out",
            err=True,
        )
