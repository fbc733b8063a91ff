"""Convert recordings to tokenized shards: plan, run, finish; run again to continue.

A shard is written whole or not at all, and its footer says what it was made from. The same command
therefore continues a job that was killed: it recognises finished shards and keeps them, and derives the
manifest from the footers at the end. An episode that cannot be used goes to quarantine with its reason, and
the job goes on.
"""

import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc

from hma_data.conversion.engines import LIMITS, Limits
from hma_data.conversion.engines.local import end_worker_that_starts_workers
from hma_data.conversion.engines.local import run as run_local
from hma_data.conversion.extend import content_of, extended
from hma_data.conversion.lerobot import AS_RECORDED, LeRobotHolder, as_dataset, dataset_plan, with_dataset
from hma_data.conversion.output import Made, ShardHolder, Share, known_hashes, refuse_other
from hma_data.conversion.plan import Plan, ShardUnit, idle_workers, make_plan
from hma_data.conversion.publish import HubOutput
from hma_data.conversion.reading import Job
from hma_data.conversion.report import (
    Counter,
    Progress,
    Summary,
    UnfinishedShare,
    held_out_line,
    refusal_reasons,
    training_notes,
)
from hma_data.conversion.settings import Options, Settings
from hma_data.conversion.worker import MakeWork
from hma_data.errors import (
    OtherPlanError,
    OutputError,
    RegistryError,
    SourceError,
    StorageAwayError,
    UsageError,
)
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.manifest import Manifest, shard_sizes
from hma_data.shards.schema import RowLayout, to_numpy
from hma_data.sources.base import EpisodeRef, open_source
from hma_data.sources.common.choice import chosen_ids, ids_for_robot
from hma_data.sources.detect import of_another_format, require_utf8
from hma_data.sources.lerobot.metadata import Folder
from hma_data.sources.lerobot.writer import origin_of
from hma_data.storage.locks import locked
from hma_data.storage.paths import StrPath, as_text
from hma_data.storage.records import Records, with_columns
from hma_data.storage.remote import place
from hma_data.tokenizers.base import Tokenizer, TokenizerSpec, get_tokenizer
from hma_data.tokenizers.shapes import get_spec

MERGE = "convert some episodes (--only) into a dataset of their own; lerobot-edit-dataset merges datasets"
BOTH_ANEW = "choose another --out and another --lerobot, or --overwrite to start both over"
MAX_FRAMES = 1_000_000_000  # of an episode; damage that states more is found when it is read
OnProgress = Callable[[Progress], None]


def convert(
    embodiment: Embodiment,
    source: StrPath | None,
    tokenizer: str | Tokenizer,
    out: StrPath,
    *,
    on_progress: OnProgress = lambda progress: None,
    **options: Any,
) -> Summary:
    """Convert a recording into the shard set `out`; running it again continues.

    The arguments are the fields of `Conversion`; `on_progress` is that of `Conversion.run`.
    """
    return Conversion(embodiment, source, tokenizer, out, **options).run(on_progress)


@dataclass(frozen=True)
class Conversion(Options):
    """A conversion of a recording into a shard set, with everything that the user chooses.

    Attributes:
        embodiment: the robot.
        source: str or path of the recording, or its URI; None takes the one in the embodiment's YAML.
        tokenizer: name, see `get_tokenizer`; or one that is open already, for work in this process.
        out: str or path of the folder, or its URI.
        settings: what the plan, and so every byte, depends on.
        workers: processes, which may crash or hang without ending the job; 0 works in this one. Each imports
            the script that calls this, so the call must stand under `if __name__ == "__main__":`.
        weights: of the tokenizer, as str or path.
        limits: when a worker counts as hanging, and how often it may be lost.
        lerobot: str or path of a LeRobotDataset that is made beside the shards, of the same cameras and
            split, in one pass over the recording.
    """

    embodiment: Embodiment
    source: StrPath | None
    tokenizer: str | Tokenizer
    out: StrPath
    settings: Settings = field(default_factory=Settings)
    workers: int = 0
    weights: StrPath | None = None
    limits: Limits = LIMITS
    lerobot: StrPath | None = None

    def __post_init__(self) -> None:
        if self.to == "lerobot" and self.lerobot is not None:
            raise UsageError("--lerobot", "writes a dataset in addition to shards", "leave out --to lerobot")
        if self.lerobot is not None:
            one, other = (Path(as_text(folder)).resolve() for folder in (self.out, self.lerobot))
            if one.is_relative_to(other) or other.is_relative_to(one):
                fault = f"is {self.lerobot}, --out {self.out}: one is inside the other"
                raise UsageError("--lerobot", fault, "give two separate folders")
        if self.extend and (self.to == "lerobot" or self.lerobot is not None):
            raise UsageError("--extend", "is for shards alone", MERGE)
        if self.to == "shards" and self.settings.drop_idle:
            fault = "is for --to lerobot: frames left out of shards would be pauses, which no window crosses"
            raise UsageError("--drop-idle", fault)

    def plan(self, tokenizer: TokenizerSpec) -> tuple[Plan, str]:
        """Return the plan of an empty folder, and the URI of the recording."""
        robot, settings, source = self.embodiment, self.settings, self.source
        if self.to == "lerobot":
            settings = as_dataset(settings)
        uri = robot.source.uri if source is None else as_text(source)
        if source is not None and not (uri or "").strip():
            raise UsageError("--source", "is empty", "name a recording, or leave it out to take the YAML's")
        if not uri:
            raise RegistryError(f"embodiment {robot.id}", "names no source.uri", "give --source URI")
        require_utf8(uri)
        if robot.frequency_hz == "unknown":
            _ = robot.rate_hz  # raises, and says what to do
        form = robot.source.format
        try:
            refs = open_source(form).index(uri, robot)
        except StorageAwayError:
            raise
        except SourceError as fault:
            raise of_another_format(uri, form, fault) from fault
        chosen = refs = _records(refs)
        if robot.source.only or robot.source.exclude or settings.only or settings.exclude:
            ids = ids_for_robot(refs.column("id").to_pylist(), robot)
            kept = pa.array(chosen_ids(ids, settings.only, settings.exclude), pa.string())
            chosen = refs.take(to_numpy(pc.is_in(refs.column("id"), kept)))
        plan = make_plan(chosen, robot, tokenizer, settings, uri)
        if form == "lerobot":
            plan = plan.with_origin(origin_of(Folder(uri).path))
        if self.to == "lerobot":
            plan = with_dataset(plan, uri, robot)
        own_split = any(chosen.column("split").unique().to_pylist())
        # the episodes of one recording all state what is outside of them
        outside = chosen.table.group_by("group").aggregate([("left_out", "max")]).column("left_out_max")
        frames = pc.sum(outside).as_py() or 0
        return replace(plan, left_out=len(refs) - len(chosen), outside=frames, own_split=own_split), uri

    def run(self, on_progress: OnProgress = lambda progress: None) -> Summary:
        """Make the shard set; running it again continues.

        Args:
            on_progress: called about once for every batch of frames.

        Raises:
            OutputError: `out` holds something else, or another job is writing it.
            SourceError: the recording cannot be read, or not one of its episodes can be used.
            HMAError: the embodiment or the tokenizer cannot be used; or a script converts with workers
                outside of `if __name__ == "__main__":`.
        """
        run = _Run(self)
        runs = [run] if run.beside is None else [run, run.beside]
        with ExitStack() as held:
            if run.beside:
                held.enter_context(_advice_for_both())
            for one in runs:
                held.enter_context(locked(one.folder))
            for one in runs:
                if self.overwrite:
                    one.holder.clear()
            plan, base = run.plan()
            if run.hub and run.hub.prepare() and not self.overwrite:
                refuse_other(run.out, plan)
            run.make(plan, base, None, on_progress)
            if run.beside:  # what is left, if the shards of some parts were there already
                run.beside.make(run.beside.whole, None, None, on_progress)
            summary = run.finish(plan, base, bool(run.made))
            if run.beside:
                dataset = run.beside.finish(run.beside.whole, None, True)
                summary = replace(summary, dataset=dataset)
            return summary

    def run_share(
        self, share: Share, on_progress: OnProgress = lambda progress: None
    ) -> Summary | UnfinishedShare:
        """Make one share of the shards, for an array of jobs that write one folder which all of them see.

        The bytes are those that `run` alone would write. The share that ends last finishes the set.
        """
        if self.to == "lerobot" or self.lerobot is not None:
            raise UsageError("--shard-index", "is for shards alone", MERGE)
        run = _Run(self)
        with locked(run.out, share.name):
            plan, base = run.plan()
            run.make(plan, base, share, on_progress)
        missing = len({unit.name for unit in plan.units} - shard_sizes(run.out).keys())
        if not missing:
            with (
                suppress(OutputError),
                locked(run.out),
            ):  # others are still writing: the last of them finishes
                missing = len(plan.units) - len(run.holder.finished(plan, base, False))
                if not missing:
                    # A journal shows that some share has made shards since the manifest was written.
                    return run.finish(plan, base, bool(run.made or known_hashes(run.out)))
        return UnfinishedShare(share.name, run.out, run.kept, run.made, missing, time.monotonic() - run.begun)


def _records(refs: Sequence[EpisodeRef]) -> Records[EpisodeRef]:
    """Return the episodes as records. One that is damaged may state more frames than the plan can count."""
    if not isinstance(refs, Records):
        refs = Records.of(EpisodeRef, [replace(ref, frames=min(ref.frames, MAX_FRAMES)) for ref in refs])
    frames = pc.min_element_wise(refs.column("frames"), MAX_FRAMES)
    return Records(EpisodeRef, with_columns(refs.table, frames=frames))


@contextmanager
def _advice_for_both() -> Iterator[None]:
    """Give the remedy for shards and a dataset that are made together: --extend is for shards alone."""
    try:
        yield
    except OtherPlanError as fault:
        raise OtherPlanError(fault.where, fault.fault, BOTH_ANEW) from fault


class _Run:
    """A conversion that runs: its folder, its tokenizer, its plan and what it has learned so far."""

    def __init__(self, given: Conversion, shards: "_Run | None" = None) -> None:
        end_worker_that_starts_workers(given.workers)
        self.given, self.begun, self.out = given, time.monotonic(), place(given.out)
        self.hub = HubOutput.of(self.out) if given.to == "shards" else None
        self.workers = given.workers
        if not isinstance(given.tokenizer, str) or str(self.out).startswith("memory:"):
            self.workers = 0  # no other process sees them
        self._opened: Tokenizer | None = None
        self._spec = self._tokenizer_spec()
        self.whole: Plan  # of an empty folder
        self.uri: str
        if shards:
            self.uri = shards.uri
            self.whole = dataset_plan(shards.whole, self.uri, given.embodiment)
        else:
            self.whole, self.uri = given.plan(self._spec)
        hold: type[ShardHolder | LeRobotHolder] = LeRobotHolder if given.to == "lerobot" else ShardHolder
        folder = self.hub.staging if self.hub else self.out
        self.holder = hold(folder, given.embodiment, self.uri)
        self.folder = self.holder.folder
        self.frame_sizes: dict[str, tuple[int, int]] = {}
        self.kept = self.made = 0  # units that were there, and that this run has made
        self.beside: _Run | None = None  # the run of the dataset that is made beside the shards
        if given.lerobot is not None:
            self.beside = _Run(replace(given, to="lerobot", out=given.lerobot, lerobot=None), self)

    def _tokenizer_spec(self) -> TokenizerSpec:
        given, tokenizer = self.given, self.given.tokenizer
        if given.to == "lerobot":
            return AS_RECORDED
        if not isinstance(tokenizer, str):
            self._opened = tokenizer
        elif not self.workers and given.engine == "local":
            self._opened = get_tokenizer(tokenizer, weights=given.weights, device=given.device)
        else:  # workers open it; this process stays light, and may have no such device
            return get_spec(tokenizer, weights=given.weights)
        return self._opened.spec

    def plan(self) -> tuple[Plan, Manifest | None]:
        """Return the plan, and the manifest it extends or None.

        A set that was extended before can be continued without `extend`.
        """
        given = self.given
        base = self.holder.base()
        if base is None or not (given.extend or "extends" in base.plan):
            return self.whole, None
        source = open_source(given.embodiment.source.format)

        def content(ref: EpisodeRef) -> str:
            return content_of(source, self.uri, ref.id, given.embodiment, self.whole.facts)

        plan = extended(self.folder, base, self.whole, given.settings.shard_frames, content)
        if plan.units and not given.extend:
            fault = f"lacks {plan.episodes:,} episodes that the recording has now"
            raise OtherPlanError(self.folder, fault, "--extend adds them")
        return plan, base

    def make(self, plan: Plan, base: Manifest | None, share: Share | None, on_progress: OnProgress) -> None:
        """Make the shards that are missing."""
        tasks = share.count if share else 1
        mine = plan.units[share.index :: tasks] if share else plan.units
        there = self.holder.finished(plan, base, share is not None)
        todo = [unit for unit in mine if unit.name not in there]
        kept = [unit for unit in mine if unit.name in there]
        layout = RowLayout.of_plan(plan.facts, self.given.embodiment)
        progress = Progress(
            episodes=sum(len(unit) for unit in kept),
            frames=_encoded(kept, layout),
            kept_shards=len(kept) + (len(base.shards) if base else 0),
            total_episodes=sum(len(unit) for unit in mine),
            total_frames=_encoded(mine, layout),
            frame_sizes=self.frame_sizes,
        )
        idle = idle_workers(plan, len(todo), self.workers, tasks, bool(there))
        has_none = bool(plan.units) and not mine  # a share may have no shard at all
        if idle and (todo or has_none):
            progress.notices.append(idle)
        on_progress(progress)
        if todo:
            with self.holder.noting(share) as note:
                for made in self._made(todo, plan, base, Counter(progress, on_progress)):
                    note(made)
                    on_progress(progress)
        self.kept, self.made = progress.kept_shards, len(todo)

    def _job(self, plan: Plan) -> Job:
        given = self.given
        weights = None if given.weights is None else as_text(given.weights)
        return Job(
            source=self.uri,
            embodiment=given.embodiment,
            tokenizer=self._spec.name,
            weights=weights,
            device=given.device,
            out=self.folder.absolute(),
            facts=plan.facts,
        )

    def _job_beside(self, base: Manifest | None) -> Job | None:
        """Return the job of the dataset whose parts are made with the shards; None where there are none."""
        beside = self.beside
        if beside is None or base is not None:  # an extended set has other shards
            return None
        there = beside.holder.finished(beside.whole, None, False)
        return beside._job(beside.whole) if len(there) < len(beside.whole.units) else None

    def _made(
        self, todo: list[ShardUnit], plan: Plan, base: Manifest | None, on_event: Counter
    ) -> Iterator[Made]:
        given = self.given
        work = MakeWork(self._job(plan), self._opened, self._job_beside(base))
        if given.engine == "ray":
            from hma_data.conversion.engines.ray import run as run_ray

            cpus, gpus = given.worker_cpus, given.worker_gpus
            if gpus is None:
                gpus = 1.0 if given.device.startswith("cuda") else 0.0
            return run_ray(todo, work, self.workers, on_event, given.limits, cpus, gpus)
        return run_local(todo, work, self.workers, on_event, given.limits)

    def finish(self, plan: Plan, base: Manifest | None, changed: bool) -> Summary:
        """Write what is derived from the shards, publish the set where it is made for a hub, and sum up.

        Args:
            changed: True where shards may have been made.
        """
        folder, out = self.folder, self.out
        done = self.holder.finish(plan, base, changed)
        manifest, reasons = done.manifest, refusal_reasons(done.refused)
        if not manifest.episodes:
            self.holder.clear()
            if self.beside:
                self.beside.holder.clear()
            worst = sorted(reasons.items(), key=lambda item: -item[1])[:3]
            told = "; ".join(f"{count} × {reason}" for reason, count in worst)
            fault = SourceError(self.uri, f"gave no usable episode, so nothing was written: {told}")
            raise of_another_format(self.uri, self.given.embodiment.source.format, fault)
        shards = self.given.to == "shards"
        warning, *notes = training_notes(folder, out, plan) if shards else [""]
        if self.hub:
            self.hub.upload()
        most = self.given.max_quarantine * (manifest.episodes + manifest.quarantined)
        return Summary(
            out=out,
            manifest=manifest,
            kept_shards=self.kept,
            made_shards=self.made,
            seconds=time.monotonic() - self.begun,
            reasons=reasons,
            flags=dict(done.flags),
            too_many=manifest.quarantined > most,
            frame_sizes=self.frame_sizes,
            left_out=self.whole.left_out,
            outside=self.whole.outside,
            changed=done.news,
            warning=warning,
            notes=tuple(notes),
            held_out=held_out_line(manifest, self.whole)
            if shards or manifest.splits["val"]["episodes"]
            else "",
            bytes=done.bytes,
        )


def _encoded(units: Sequence[ShardUnit], layout: RowLayout) -> int:
    """Return the number of frames to encode: of every camera, and with --frames strided only the grid's."""
    rows = sum(int((to_numpy(unit.refs.column("frames")) // layout.frame_stride).sum()) for unit in units)
    return rows * len(layout.cameras)
