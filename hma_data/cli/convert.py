"""Run `hma convert`: a conversion, a share of one, or only its plan."""

import shlex
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer
from typer import Argument, Option

from hma_data.cli.options import Json, Weights, robot_option, tokenizers, with_settings
from hma_data.console import (
    human_bytes,
    human_count,
    human_seconds,
    interruptible,
    print_json,
    print_table,
    progress,
    say,
)
from hma_data.conversion.settings import Options, Settings
from hma_data.errors import UsageError

if TYPE_CHECKING:
    from hma_data.conversion.job import Conversion
    from hma_data.conversion.output import Share
    from hma_data.conversion.plan import Plan
    from hma_data.conversion.report import Progress, Summary, UnfinishedShare
    from hma_data.registry.embodiment import Embodiment
    from hma_data.sources.common.checks import Finding

TOKENIZER = "fsq-16"  # by default
KEPT_UNREAD = "of the shards that were there only the footers were checked; this checks every byte"
REASONS_PRINTED = 20  # of quarantine, the most frequent first
# Options that few people need stand in panels of their own below the others in --help.
_jobs = partial(Option, rich_help_panel="Several machines")


@with_settings
def convert(
    *,
    data: Annotated[
        str | None, Argument(help="Recording: file, folder or URI; default: source.uri of the YAML.")
    ] = None,
    embodiment: Annotated[str, robot_option("The robot: an id of the registry, or a YAML file.")],
    out: Annotated[Path, Option(help="Folder of the shard set, or of the LeRobotDataset.")],
    options: Options,
    lerobot: Annotated[
        Path | None,
        Option(help="Also write a LeRobotDataset to this folder, with the shards' cameras and split."),
    ] = None,
    source: Annotated[str | None, Option(help="Same as DATA.")] = None,
    tokenizer: Annotated[
        str, Option(help="Name of the tokenizer; see hma tokenizer list.", autocompletion=tokenizers)
    ] = TOKENIZER,
    weights: Weights = None,
    workers: Annotated[int, Option(min=0, help="Worker processes; with 0, a crash ends the command.")] = 1,
    settings: Settings,
    frequency_hz: Annotated[
        float | None,
        Option(help="Rate of the recording, if the YAML states none.", rich_help_panel="Selection and split"),
    ] = None,
    episode_timeout: Annotated[
        float,
        Option(
            min=0,
            help="Refuse an episode after this many seconds without progress; 0: never.",
            rich_help_panel="Bad episodes",
        ),
    ] = 300.0,
    shard_index: Annotated[
        int | None, _jobs(min=0, help="Index of this job among --shard-count jobs.")
    ] = None,
    shard_count: Annotated[
        int | None, _jobs(min=1, help="Number of jobs that share the work, such as a Slurm array.")
    ] = None,
    dry_run: Annotated[
        bool, Option("--dry-run", help="Print the plan, the output size and the time; write nothing.")
    ] = False,
    json: Json = False,
) -> None:
    """Convert recordings to tokenized shards or a LeRobotDataset; run it again to continue.

    Example: hma convert ./demo.hdf5 -e my_arm.yaml --out shards/my_arm
    """
    from hma_data.conversion.output import Share

    if data is not None and source is not None:
        raise UsageError("--source", f"says {source}, DATA says {data}", "name the recording once")
    source = data if source is None else source
    if options.extend and options.overwrite:
        raise UsageError("hma convert", "--extend keeps the set, --overwrite deletes it", "give one of them")
    if options.to == "lerobot" and (tokenizer != TOKENIZER or weights):
        fault = "a LeRobotDataset holds frames as recorded, not tokens"
        raise UsageError("--to lerobot", fault, "leave out --tokenizer and --weights")
    share = None
    if shard_index is not None and shard_count is not None:
        share = Share(shard_index, shard_count)
        if shard_index >= shard_count:
            raise UsageError("--shard-index", f"must be below --shard-count {shard_count}, is {shard_index}")
        if options.overwrite or options.engine == "ray":
            raise UsageError("--shard-index", "cannot be combined with --overwrite or --engine ray")
    elif shard_index is not None or shard_count is not None:
        raise UsageError("hma convert", "--shard-index and --shard-count belong together", "give both")
    robot = _robot(embodiment, source, tokenizer, frequency_hz)
    from hma_data.conversion.engines import Limits
    from hma_data.conversion.job import Conversion
    from hma_data.conversion.report import UnfinishedShare

    conversion = Conversion(
        robot,
        source,
        tokenizer,
        out,
        settings,
        workers=workers,
        weights=weights,
        limits=Limits(quiet_s=episode_timeout or None),
        lerobot=lerobot,
        **vars(options),
    )
    if dry_run:
        if options.to == "lerobot":
            _print_dataset_plan(conversion, json)
        else:
            _print_plan(conversion, share, json)
        return
    with interruptible(lambda: _kept(conversion)), _shown(robot.id) as on_progress:
        summary = conversion.run_share(share, on_progress) if share else conversion.run(on_progress)
    if isinstance(summary, UnfinishedShare):
        _report_share(summary, json)
        return
    from hma_data.inspection.shard_findings import kept_findings
    from hma_data.shards.reader import ShardSet

    lasting: list[Finding] = []
    if summary.made_shards and options.to == "shards":
        lasting = list(kept_findings(ShardSet(summary.out), weights, options.device))
    _report(summary, lasting, options.max_quarantine, json)
    raise typer.Exit(1 if any(one.too_many for one in summary.outputs) else 0)


def _robot(embodiment: str, source: str | None, tokenizer: str, frequency_hz: float | None) -> "Embodiment":
    """Return the robot; refuse what can be seen from the command line before torch is imported."""
    from hma_data.registry.embodiment import find
    from hma_data.sources.detect import require_there
    from hma_data.tokenizers.catalog import find_entry

    robot = find(embodiment)
    find_entry(tokenizer)
    require_there(source or robot.source.uri or "")
    return robot if frequency_hz is None else robot.with_rate(frequency_hz)


def _kept(conversion: "Conversion") -> str:
    """Return what a Ctrl-C leaves, and how to go on."""
    from hma_data.storage.remote import is_remote, place

    if conversion.to == "lerobot":
        return f"finished parts of {conversion.out} kept beside it; run the same command again to continue"
    out = place(conversion.out)
    again = "run the same command again"
    if conversion.overwrite:
        again += ", without --overwrite,"
    kept = "finished shards"
    if not is_remote(out):
        kept = human_count(sum(1 for _ in out.glob("*/shard-*.parquet")), "finished shard")
    return f"{kept} in {conversion.out} kept; {again} to continue"


@contextmanager
def _shown(name: str) -> "Iterator[Callable[[Progress], None]]":
    """Show the progress of a conversion, and each new notice and retry as a line."""
    with progress(f"convert {name}") as update:
        notices = retries = 0  # lines that are printed already

        def show(state: "Progress") -> None:
            nonlocal notices, retries
            for line in state.notices[notices:]:
                say(line, err=True)
            for reason in state.retries[retries:]:
                say(f"retrying: a worker {reason}", err=True)
            notices, retries = len(state.notices), len(state.retries)
            words = f"{state.episodes:,}/{state.total_episodes:,} episodes, {human_bytes(state.bytes)}"
            if state.quarantined:
                words += f", {state.quarantined:,} in quarantine"
            update(state.frames, words, state.total_frames)

        yield show


# -- the plan


def _print_plan(conversion: "Conversion", share: "Share | None", json: bool) -> None:
    from hma_data.conversion.lerobot import dataset_plan
    from hma_data.conversion.plan import estimate, idle_workers
    from hma_data.shards.manifest import cameras_line
    from hma_data.storage.remote import place
    from hma_data.tokenizers.base import get_tokenizer

    robot, workers = conversion.embodiment, conversion.workers
    opened = get_tokenizer(str(conversion.tokenizer), weights=conversion.weights, device=conversion.device)
    plan, uri = conversion.plan(opened.spec)
    tasks = share.count if share else 1
    cost = estimate(plan, uri, robot, opened, workers, tasks)
    dataset = None
    if conversion.lerobot:
        dataset = dataset_plan(plan, uri, robot).facts["dataset"]
    units = [{"shard": unit.name, "episodes": len(unit), "frames": unit.frames} for unit in plan.units]
    if json:
        print_json(
            {
                "source": uri,
                "out": str(place(conversion.out)),
                "episodes": plan.episodes,
                "left_out": plan.left_out,
                "frames_in_no_episode": plan.outside,
                "frames": plan.frames,
                "bytes": cost.bytes,
                "frames_per_second": cost.frames_per_second,
                "seconds": cost.seconds,
                "cameras": plan.facts["cameras"],
                "pictures": cost.frame_sizes,
                "shards": units,
                **({"dataset": dataset} if dataset else {}),
            }
        )
        return
    print_table(["shard", "episodes", "recorded frames, about"], [list(unit.values()) for unit in units])
    say(f"{_read(plan, uri)} into {human_count(len(units), 'shard')}, about {human_bytes(cost.bytes)}")
    if dataset:
        say(f"and into a LeRobotDataset v3.0 of {dataset['fps']} fps, {conversion.lerobot}")
    _print_cameras(
        cameras_line(plan.facts["cameras"], robot), cost.frame_sizes, robot, opened.spec.image_size
    )
    _print_left_out(plan)
    if cost.seconds is None:
        say(f"time unknown, no episode could be read: {cost.fault}")
    else:
        each = f" in each of {tasks} tasks" if tasks > 1 else ""
        say(
            f"about {human_seconds(cost.seconds)} with --workers {workers}{each}: one worker converts "
            f"{cost.frames_per_second:,.0f} frames/s, measured on one episode"
        )
    mine = units[share.index :: tasks] if share else units
    if idle := idle_workers(plan, len(mine), workers, tasks):
        print(idle)


def _print_dataset_plan(conversion: "Conversion", json: bool) -> None:
    """Print what a LeRobotDataset would hold; its size depends on its videos, and is not estimated."""
    from hma_data.conversion.lerobot import AS_RECORDED

    plan, uri = conversion.plan(AS_RECORDED)
    facts = plan.facts["dataset"]
    if json:
        totals = {
            "episodes": plan.episodes,
            "left_out": plan.left_out,
            "frames_in_no_episode": plan.outside,
            "frames": plan.frames,
        }
        print_json({"source": uri, "out": str(conversion.out), **totals, **facts, "parts": len(plan.units)})
        return
    parts = human_count(len(plan.units), "part")
    say(f"{_read(plan, uri)} into a LeRobotDataset v3.0 of {facts['fps']} fps, made in {parts}")
    _print_sizes(facts["sizes"])
    _print_left_out(plan)


def _read(plan: "Plan", uri: str) -> str:
    """Return how much the recording at a URI has, in words."""
    stride = plan.facts["frame_stride"]
    kept = f" (1 of {stride} is kept)" if stride > 1 else ""
    return f"{uri}: {human_count(plan.episodes, 'episode')}, about {plan.frames:,} recorded frames{kept}"


# -- the result


def _report_share(done: "UnfinishedShare", json: bool) -> None:
    facts = {
        "out": str(done.out),
        "shards_made": done.made_shards,
        "shards_kept": done.kept_shards,
        "shards_missing": done.missing,
        "seconds": done.seconds,
    }
    if json:
        print_json(facts)
        return
    missing, made = human_count(done.missing, "shard"), human_count(done.made_shards, "shard")
    say(
        f"{done.out}: share {done.name} made {made} ({done.kept_shards} existed already), "
        f"{human_seconds(done.seconds)}; {missing} left for other shares; the last one writes the manifest"
    )


def _report(summary: "Summary", lasting: "list[Finding]", max_quarantine: float, json: bool) -> None:
    from hma_data.shards.schema import flag_words

    if json:
        print_json(_facts(summary, lasting))
    else:
        for one in summary.outputs:
            _print_made(one)
        _print_left_out(summary)
        if summary.held_out:
            print(summary.held_out)
        if summary.flags:
            counts = [f"{count:,} {flag_words(name)}" for name, count in summary.flags.items()]
            say(f"flags: {', '.join(counts)}")
        if summary.changed:
            print(summary.changed)
        for note in filter(None, (summary.warning, *summary.notes)):
            say(f"warning: {note}", err=True)
        for finding in lasting:
            warns = finding.severity == "warn"
            say(f"{'warning: ' * warns}{finding}", err=warns)
    reasons = {reason: count for one in summary.outputs for reason, count in one.reasons.items()}
    for reason, count in sorted(reasons.items(), key=lambda item: -item[1])[:REASONS_PRINTED]:
        say(f"quarantine: {count:,} × {reason}", err=True)
    for one in summary.outputs:
        if one.too_many:
            say(
                f"error: {one.out}: {human_count(one.manifest.quarantined, 'episode')} in quarantine, more "
                f"than --max-quarantine {max_quarantine:g} allows; what was converted is kept "
                "— see quarantine.jsonl; --exclude leaves them out",
                err=True,
            )


def _facts(summary: "Summary", lasting: "list[Finding]") -> dict[str, Any]:
    """Return the result for --json."""
    manifest = summary.manifest
    facts = {
        "out": str(summary.out),
        **manifest.to_json()["totals"],
        "bytes": summary.bytes,
        "splits": manifest.splits,
        "shards_made": summary.made_shards,
        "shards_kept": summary.kept_shards,
        "shards_missing": 0,
        "seconds": summary.seconds,
        "cameras": manifest.cameras,
        "pictures": summary.frame_sizes,
        "flags": summary.flags,
        "left_out": summary.left_out,
        "frames_in_no_episode": summary.outside,
        "changed": summary.changed,
        "warning": summary.warning,
        "held_out": summary.held_out,
        "notes": list(summary.notes),
        "kept": [finding.to_json() for finding in lasting],
        "reasons": summary.reasons,
        "too_many_quarantined": summary.too_many,
    }
    return facts | ({"dataset": _facts(summary.dataset, [])} if summary.dataset else {})


def _print_made(summary: "Summary") -> None:
    from hma_data.cli.shards import totals_line

    manifest = summary.manifest
    if manifest.plan.get("to") == "lerobot":
        totals, facts = manifest.to_json()["totals"], manifest.plan["dataset"]
        say(
            f"{summary.out}: LeRobotDataset v3.0, {human_count(totals['episodes'], 'episode')}, "
            f"{totals['frames']:,} frames at {facts['fps']} fps, {human_bytes(summary.bytes)}, "
            f"{human_seconds(summary.seconds)}"
        )
        _print_sizes(facts["sizes"])
        return
    kept = f" ({summary.kept_shards} existed already)" if summary.kept_shards else ""
    say(f"{totals_line(summary.out, manifest)}{kept}, {human_seconds(summary.seconds)}")
    if summary.kept_shards:
        say(f"{KEPT_UNREAD}: hma shards verify {shlex.quote(str(summary.out))}")
    robot, size = manifest.embodiment, manifest.tokenizer.image_size
    _print_cameras(manifest.cameras_line, summary.frame_sizes, robot, size)


def _print_sizes(sizes: dict[str, list[int]]) -> None:
    named = [f"{name} {width}×{height}" for name, (height, width) in sizes.items()]
    say(f"cameras: {', '.join(named)}")


def _print_cameras(line: str, sizes: dict[str, tuple[int, int]], robot: Any, size: int) -> None:
    """Print which cameras are stored, and what becomes of their frames."""
    from hma_data.episodes.images import describe_resize

    say(f"cameras: {line}")
    for name, (height, width) in sizes.items():
        print(describe_resize(robot.camera(name), height, width, size))


def _print_left_out(found: "Plan | Summary") -> None:
    if found.left_out:
        say(f"left out by only and exclude: {human_count(found.left_out, 'episode')}")
    if found.outside:
        say(f"in no episode: {human_count(found.outside, 'recorded frame')}")
