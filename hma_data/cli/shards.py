"""Run `hma shards`: look at shard sets, verify them, and make new sets from them."""

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

import typer
from typer import Argument, Option

from hma_data.cli.options import Folder, Json, Weights, choice_option
from hma_data.console import (
    CONTINUE,
    Update,
    human_bytes,
    human_count,
    human_seconds,
    interruptible,
    print_json,
    print_table,
    progress,
    say,
)
from hma_data.errors import UsageError

if TYPE_CHECKING:
    from hma_data.shards.manifest import Manifest

shards_app = typer.Typer(no_args_is_help=True, help="Inspect, verify, merge, split and export shard sets.")

Workers = Annotated[int | None, Option(min=1, help="Threads; default: one per core.")]
Out = Annotated[Path, Option(help="Folder of the new shard set.")]


def _in(update: Update) -> Callable[[int, int], None]:
    """Return a callback of (done, total) that updates a progress display."""
    return lambda done, total: update(done, total=total)


def refuse_early(folders: Iterable[str]) -> None:
    """Refuse folders of this machine without shards, before torch is imported for the rest of a verb."""
    from hma_data.shards.reader import ShardSet
    from hma_data.storage.remote import is_remote, place

    for folder in map(place, folders):
        if not is_remote(folder):
            ShardSet(folder)


@shards_app.command("info")
def shards_info(folder: Folder, json: Json = False) -> None:
    """Show the totals of a shard set.

    Example: hma shards info shards/my_arm
    """
    from hma_data.shards.preview import describe

    facts = describe(folder)
    if json:
        print_json(facts)
    else:
        _print_info(facts)


def _print_info(facts: dict[str, Any]) -> None:
    from hma_data.shards.schema import flag_words

    robot, totals, episodes = facts["embodiment"], facts["totals"], facts["episodes"]
    say(f"{facts['folder']}: {robot['id']} × {facts['tokenizer']['name']}, from {facts['source']}")
    lasting = human_seconds(totals["hours"] * 3600)
    say(
        f"{human_count(totals['episodes'], 'episode')}, {totals['frames']:,} frames at "
        f"{robot['rows_hz']:g} Hz ({lasting}), {human_bytes(totals['bytes'])} in "
        f"{human_count(facts['shards'], 'shard')} ({facts['bytes_per_frame']:.0f} bytes per frame)"
    )
    say(f"cameras: {robot['cameras_line']}")
    say(
        f"{robot['action_dim']} action and {robot['state_dim']} state values; stride {robot['stride']}, "
        f"so the model sees {robot['effective_hz']:g} Hz"
    )
    say(
        f"episodes of {episodes['shortest']:,} to {episodes['longest']:,} frames, median "
        f"{episodes['median']:,.0f}; {_instructions(episodes)}; "
        f"{_successes(episodes)}; skew up to {episodes['worst_skew_ms']:.1f} ms"
    )
    for label in ("flags", "quarantine"):
        for name, count in episodes[label].items():
            say(f"{label}: {count:,} × {flag_words(name) if label == 'flags' else name}")
    print_table(
        ["split", "episodes", "frames", "rows", "shards", "windows of 12", "episodes too short"],
        [
            [name, *(split[key] for key in ("episodes", "frames", "rows", "shards")), *windows.values()]
            for (name, split), windows in zip(facts["splits"].items(), facts["windows"].values())
        ],
    )
    for vector, stats in facts["stats"].items():
        names = facts["names"][vector]
        ends = (stats["quantiles"][q] for q in ("q01", "q50", "q99"))
        columns = [*(stats[key] for key in ("mean", "std", "min", "max")), *ends]
        print_table(
            [vector, "mean", "std", "min", "max", "q01", "q50", "q99"],
            [[name, *(column[i] for column in columns)] for i, name in enumerate(names)],
        )


def _instructions(episodes: dict[str, Any]) -> str:
    """Return how many episodes have an instruction, and how many different ones there are."""
    if not episodes["with_instruction"]:
        return "no instructions"
    return f"{episodes['with_instruction']:,} with an instruction ({episodes['instructions']:,} different)"


def _successes(episodes: dict[str, Any]) -> str:
    """Return how many episodes succeed, in words."""
    if not episodes["success"] and not episodes["failure"]:
        return "success not recorded"
    parts = [f"{episodes['success']:,} succeed, {episodes['failure']:,} fail"]
    return ", ".join(parts + ([f"{episodes['not_told']:,} unknown"] if episodes["not_told"] else []))


@shards_app.command("verify")
def shards_verify(
    folders: Annotated[list[Path], Argument(help="Shard sets.")],
    workers: Workers = None,
    quick: Annotated[bool, Option("--quick", help="Check only sizes and footers.")] = False,
    json: Json = False,
) -> None:
    """Check every hash, row count and invariant of shard sets.

    Example: hma shards verify shards/my_arm
    """
    from hma_data.errors import ShardError
    from hma_data.shards.verify import verify
    from hma_data.storage.remote import is_remote, place

    for folder in map(place, folders):
        if not is_remote(folder) and not folder.is_dir():
            raise ShardError(folder, "is not a folder", "name the --out folder of an hma convert")
    found = {}
    with progress("verify", unit="bytes") as update:
        for folder in folders:
            problems = verify(folder, workers=workers, quick=quick, on_progress=_in(update))
            found[str(place(folder))] = problems
    if json:
        print_json(found)
    else:
        for folder_name, problems in found.items():
            for problem in problems:
                say(problem)
            say(f"{folder_name}: {human_count(len(problems), 'problem') if problems else 'no problems'}")
    raise typer.Exit(1 if any(found.values()) else 0)


@shards_app.command("preview")
def shards_preview(
    folder: Folder,
    out: Annotated[Path | None, Option(help="Folder for sheet.png and preview.mp4.")] = None,
    episodes: Annotated[int, Option(min=1, help="Number of episodes to show.")] = 4,
    camera: Annotated[str | None, Option(help="Camera to show; default: all of the set.")] = None,
    weights: Weights = None,
    only: Annotated[list[str] | None, choice_option("Show only this episode")] = None,
    exclude: Annotated[list[str] | None, choice_option("Do not show this episode")] = None,
) -> None:
    """Write a contact sheet and a video decoded from the tokens, with the actions drawn.

    Example: hma shards preview shards/my_arm
    """
    from hma_data.shards.preview import preview

    place = out or Path(f"{folder.resolve().name}-preview")
    with progress("preview") as update:
        shown = preview(
            folder,
            place,
            episodes=episodes,
            weights=weights,
            camera=camera,
            only=only or (),
            exclude=exclude or (),
            on_progress=_in(update),
        )
    say(f"wrote {shown.sheet} and {shown.video} ({human_count(len(shown.episodes), 'episode')})")
    for line in shown.resized:
        print(line)


def totals_line(out: Path, manifest: "Manifest") -> str:
    """Return one line of text about a new shard set: its episodes, frames, bytes and shards."""
    totals = manifest.to_json()["totals"]
    splits = ", ".join(f"{name} {split['episodes']:,}" for name, split in manifest.splits.items())
    return (
        f"{out}: {human_count(totals['episodes'], 'episode')} ({splits}), {totals['frames']:,} frames, "
        f"{human_bytes(totals['bytes'])} in {human_count(len(manifest.shards), 'shard')}"
    )


def _report(out: Path, manifest: "Manifest", json: bool) -> None:
    if json:
        print_json({"out": str(out), **manifest.to_json()["totals"], "splits": manifest.splits})
    else:
        print(totals_line(out, manifest))


@shards_app.command("merge")
@interruptible(lambda: CONTINUE)
def shards_merge(
    folders: Annotated[list[Path], Argument(help="Shard sets of one embodiment and tokenizer.")],
    out: Out,
    workers: Workers = None,
    json: Json = False,
) -> None:
    """Merge several shard sets into one; every episode keeps its split.

    Example: hma shards merge shards/monday shards/tuesday --out shards/week
    """
    from hma_data.conversion.rewrite import merge
    from hma_data.cpu import usable_cores

    places = [folder.resolve() for folder in folders]
    if twice := next((folder for folder, place in zip(folders, places) if places.count(place) > 1), None):
        raise UsageError(twice, "is given twice", "give each set once")
    with progress("merge") as update:
        manifest = merge(folders, out, workers or usable_cores(), _in(update))
    _report(out, manifest, json)


@shards_app.command("split")
@interruptible(lambda: CONTINUE)
def shards_split(
    folder: Folder,
    out: Out,
    val_fraction: Annotated[
        float | None, Option(help="Share of episodes for validation; default: as in hma convert.")
    ] = None,
    seed: Annotated[int, Option(help="Seed of the split.")] = 0,
    by: Annotated[
        Literal["episode", "instruction", "source"], Option(help="What is never divided between splits.")
    ] = "episode",
    workers: Workers = None,
    json: Json = False,
) -> None:
    """Write a copy of a shard set, divided differently into train and val.

    Example: hma shards split shards/my_arm --val-fraction 0.1 --out shards/my_arm_10
    """
    from hma_data.conversion.rewrite import split
    from hma_data.cpu import usable_cores

    options: dict[str, Any] = {"val_fraction": val_fraction, "seed": seed, "by": by}
    with progress("split") as update:
        manifest = split(folder, out, **options, workers=workers or usable_cores(), on_progress=_in(update))
    _report(out, manifest, json)


@shards_app.command("restat")
def shards_restat(folder: Folder, workers: Workers = None, json: Json = False) -> None:
    """Rebuild the manifest and the other derived files from the shards.

    Example: hma shards restat shards/my_arm
    """
    from hma_data.conversion.rewrite import restat

    with progress("restat", unit="bytes") as update:
        manifest = restat(folder, workers=workers, on_progress=_in(update))
    _report(folder, manifest, json)


@shards_app.command("export")
def shards_export(
    folder: Folder,
    out: Annotated[Path, Option(help="New folder, with a subfolder per split.")],
    to: Annotated[Literal["memmap"], Option(help="memmap: the layout of the paper's code.")] = "memmap",
    split: Annotated[str | None, Option(help="Only this split, directly into --out.")] = None,
    camera: Annotated[str | None, Option(help="Camera to export; default: the first.")] = None,
) -> None:
    """Export flat files for the paper's code: video.bin, actions, segment_ids.bin, metadata.json.

    Example: hma shards export shards/my_arm --to memmap --out flat/my_arm
    """
    from hma_data.shards.memmap import export

    with progress(f"export to {to}") as update:
        places = export(folder, out, split=split, camera=camera, on_progress=_in(update))
    for place in places:
        say(f"wrote {place}")
