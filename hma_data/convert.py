"""Recordings to tokenized shards: plan, run, finish; run again to continue.

A shard is made whole or not at all, and says in its footer what it was made from. So a job
that was killed is continued by the same command: finished shards are recognised and kept, and
the manifest is derived from footers at the end. An episode that cannot be used goes to
quarantine with its reason; the rest goes on.
"""

import json
import re
import time
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path

import pyarrow.parquet as pq

from hma_data.embodiment import Embodiment
from hma_data.engines.base import LIMITS, Limits, Retry
from hma_data.engines.local import run
from hma_data.errors import RegistryError, SourceError
from hma_data.output import clear, finished_shards, locked
from hma_data.plan import Plan, Settings, make_plan
from hma_data.shard_work import Job, MakeWork, Tick
from hma_data.shards.manifest import EPISODES, MANIFEST, Manifest, finish
from hma_data.shards.schema import flag_counts
from hma_data.sources.base import open_source
from hma_data.tokenizers.base import Tokenizer, get_tokenizer


@dataclass
class Progress:
    """Where a conversion stands; what the console shows."""

    episodes: int = 0
    frames: int = 0
    bytes: int = 0
    quarantined: int = 0
    kept_shards: int = 0
    total_episodes: int = 0
    total_frames: int = 0
    retries: list[str] = field(default_factory=list)
    started: float = field(default_factory=time.monotonic)


@dataclass(frozen=True)
class Summary:
    """What a conversion did.

    Attributes:
        reasons: error type and message (without the episode's id) -> episodes refused for it.
        flags: name -> count over all episodes, such as masked_actions; see docs/format.md.
        too_many: more than `max_quarantine` was refused; the command ends with exit code 1.
    """

    out: Path
    manifest: Manifest
    kept_shards: int
    made_shards: int
    seconds: float
    reasons: dict[str, int]
    flags: dict[str, int]
    too_many: bool


def plan_conversion(
    embodiment: Embodiment, source: str | None, tokenizer: Tokenizer, settings: Settings
) -> tuple[Plan, str]:
    """The plan of a conversion and the URI it reads; see `convert`."""
    uri = source or embodiment.source.uri
    if not uri:
        raise RegistryError(f"embodiment {embodiment.id}", "names no source.uri", "give --source URI")
    if embodiment.frequency_hz == "unknown":
        _ = embodiment.rate_hz  # raises, and says what to do
    refs = open_source(embodiment.source.format).index(uri, embodiment)
    return make_plan(refs, embodiment, tokenizer.spec, settings, uri), uri


def convert(
    embodiment: Embodiment,
    source: str | None,
    tokenizer: str | Tokenizer,
    out: Path,
    *,
    settings: Settings | None = None,
    workers: int = 0,
    weights: str | None = None,
    device: str = "cpu",
    limits: Limits = LIMITS,
    max_quarantine: float = 0.01,
    overwrite: bool = False,
    on_progress: Callable[[Progress], None] = lambda progress: None,
) -> Summary:
    """Convert a recording into the shard set `out`; running it again continues.

    Args:
        embodiment: the robot.
        source: URI of the recording; None takes the one in the embodiment's YAML.
        tokenizer: name, see `get_tokenizer`; or one that is open already, for work in this process.
        workers: processes, which may crash or hang without ending the job; 0 works in this one.
        weights, device: of the tokenizer.
        limits: when a worker counts as hanging, and how often it may be lost.
        max_quarantine: fraction of episodes that may be refused.
        overwrite: throw away what `out` holds, if it is a shard set.
        on_progress: called after every batch of frames or so.

    Raises:
        OutputError: `out` holds something else, or another job is writing it.
        SourceError: the recording cannot be read, or not one of its episodes can be used.
        HMAError: the embodiment or the tokenizer cannot be used.
    """
    begun = time.monotonic()
    opened = (
        get_tokenizer(tokenizer, weights=weights, device=device) if isinstance(tokenizer, str) else tokenizer
    )
    plan, uri = plan_conversion(embodiment, source, opened, settings or Settings())
    with locked(out):
        if overwrite:
            clear(out)
        done = finished_shards(out, plan)
        todo = [unit for unit in plan.units if unit.name not in done]
        progress = Progress(total_episodes=plan.episodes, total_frames=plan.frames, kept_shards=len(done))
        for unit in plan.units:
            if unit.name in done:
                progress.episodes += len(unit.episodes)
                progress.frames += unit.frames
        on_progress(progress)

        job = Job(uri, embodiment, opened.spec.name, weights, device, out.absolute(), plan.facts)
        processes = workers if isinstance(tokenizer, str) else 0
        make_work = MakeWork(job, None if processes else opened)
        for _ in run(todo, make_work, processes, _Counter(progress, on_progress), limits):
            on_progress(progress)
        manifest = _finish(out, plan, embodiment, opened, uri, bool(todo))
        reasons = _reasons(out)
        if not any(split["episodes"] for split in manifest.splits.values()):
            clear(out)
            worst = sorted(reasons.items(), key=lambda item: -item[1])[:3]
            told = "; ".join(f"{count} × {reason}" for reason, count in worst)
            raise SourceError(uri, f"gave no usable episode, so nothing was written: {told}")
    too_many = manifest.quarantined > max_quarantine * plan.episodes
    seconds = time.monotonic() - begun
    return Summary(out, manifest, len(done), len(todo), seconds, reasons, _flags(out), too_many)


def _finish(
    out: Path, plan: Plan, embodiment: Embodiment, tokenizer: Tokenizer, uri: str, changed: bool
) -> Manifest:
    names = [unit.name for unit in plan.units]
    if not changed and (out / MANIFEST).is_file() and (out / EPISODES).is_file():
        return Manifest.load(out)
    return finish(out, names, embodiment, tokenizer.spec, plan.facts, uri)


def _reasons(out: Path) -> dict[str, int]:
    reasons: dict[str, int] = {}
    for line in (out / "quarantine.jsonl").read_text().splitlines():
        item = json.loads(line)
        text = f"{item['type']}: {item['message']}"
        if any(letter.isdigit() for letter in item["id"]):  # a numbered id would keep equal reasons apart
            text = re.sub(rf"(?<!\w){re.escape(item['id'])}(?!\w)", "<episode>", text)
        reasons[text] = reasons.get(text, 0) + 1
    return reasons


def _flags(out: Path) -> dict[str, int]:
    """Counts of the episodes' flags, added up."""
    totals: Counter[str] = Counter()
    for item in pq.read_table(out / EPISODES, columns=["flags"])["flags"].value_counts().to_pylist():
        for name, count in flag_counts(item["values"] or "").items():
            totals[name] += count * item["counts"]
    return dict(sorted(totals.items()))


_COUNTED = ("frames", "episodes", "quarantined", "bytes")


class _Counter:
    """Adds up what units report; what a unit had counted is taken back when it is done again."""

    def __init__(self, progress: Progress, on_progress: Callable[[Progress], None]) -> None:
        self._progress, self._on_progress = progress, on_progress
        self._by_unit: dict[int, list[int]] = {}

    def __call__(self, unit: int, event: Tick | Retry) -> None:
        mine = self._by_unit.setdefault(unit, [0] * len(_COUNTED))
        if isinstance(event, Retry):
            self._progress.retries.append(event.reason)
            change = [-count for count in mine]
        else:
            change = [getattr(event, name) for name in _COUNTED]
        for i, name in enumerate(_COUNTED):
            mine[i] += change[i]
            setattr(self._progress, name, getattr(self._progress, name) + change[i])
        self._on_progress(self._progress)
