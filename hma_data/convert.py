"""Recordings to tokenized shards: plan, run, finish; run again to continue.

A shard is made whole or not at all, and says in its footer what it was made from. So a job
that was killed is continued by the same command: finished shards are recognised and kept, and
the manifest is derived from footers at the end. An episode that cannot be used goes to
quarantine with its reason; the rest goes on.
"""

import errno
import fcntl
import json
import os
import re
import shutil
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.align import to_clip
from hma_data.embodiment import Embodiment
from hma_data.engines.base import FIRST, LIMITS, Attempt, Limits, Report, Retry, Step, Work
from hma_data.engines.local import run, usable_cores
from hma_data.episode import Clip
from hma_data.errors import (
    EpisodeError,
    HMAError,
    MissingDependencyError,
    OutputError,
    RegistryError,
    ShardError,
    SourceError,
    TokenizerError,
)
from hma_data.files import remove_parts
from hma_data.plan import Plan, Settings, ShardUnit, differences, make_plan
from hma_data.prefetch import prefetch
from hma_data.shards.manifest import EPISODES, MANIFEST, Manifest, finish
from hma_data.shards.schema import EpisodeRow, Footer, Refused, arrow_schema, read_footer
from hma_data.shards.writer import EpisodeRows, ShardWriter
from hma_data.sources.base import EpisodeRef, open_source
from hma_data.stats import Stats
from hma_data.tokenizers.base import Tokenizer, get_tokenizer
from hma_data.video import prepare

BATCH = 32  # frames decoded and tokenized together
LOCK = ".lock"
FATAL = (
    TokenizerError,
    OutputError,
    ShardError,
    RegistryError,
    MissingDependencyError,
)  # not one episode's fault


@dataclass(frozen=True)
class Job:
    """Everything a worker needs to make any shard of a conversion."""

    source: str
    embodiment: Embodiment
    tokenizer: str
    weights: str | None
    device: str
    out: Path
    facts: dict[str, Any]


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
        too_many: more than `max_quarantine` was refused; the command ends with exit code 1.
    """

    out: Path
    manifest: Manifest
    kept_shards: int
    made_shards: int
    seconds: float
    reasons: dict[str, int]
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
    return Summary(out, manifest, len(done), len(todo), seconds, reasons, too_many)


def _finish(
    out: Path, plan: Plan, embodiment: Embodiment, tokenizer: Tokenizer, uri: str, changed: bool
) -> Manifest:
    names = [unit.name for unit in plan.units]
    if not changed and (out / MANIFEST).is_file() and (out / EPISODES).is_file():
        return Manifest.load(out)
    return finish(out, names, embodiment, tokenizer.spec, plan.facts, uri)


# -- the output folder


@contextmanager
def locked(out: Path) -> Iterator[None]:
    """Only one job writes a folder; the lock goes with the process, however it ends."""
    made = not out.exists()
    try:
        out.mkdir(parents=True, exist_ok=True)
        handle = os.open(out / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as fault:
        raise OutputError(out, f"cannot be written: {fault.strerror}", "choose another --out") from fault
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not (out / LOCK).exists():  # its last owner deleted it between our two calls
            raise OSError(errno.EAGAIN, "")
    except OSError as fault:
        os.close(handle)
        if fault.errno not in (errno.EACCES, errno.EAGAIN):
            raise
        raise OutputError(
            out, "is being written by another job", "wait for it, or choose another --out"
        ) from fault
    try:
        yield
    finally:
        (out / LOCK).unlink(missing_ok=True)
        os.close(handle)
        if made and not any(out.iterdir()):
            out.rmdir()


def clear(out: Path) -> None:
    """Empty a folder that holds a shard set.

    Raises:
        OutputError: it holds something else.
    """
    _refuse_foreign(out)
    for item in out.iterdir():
        if item.name != LOCK:
            shutil.rmtree(item) if item.is_dir() else item.unlink()


OURS = {"train", "val", MANIFEST, EPISODES, "embodiment.yaml", "quarantine.jsonl", LOCK}


def _refuse_foreign(out: Path) -> None:
    foreign = [
        item.name for item in out.iterdir() if item.name not in OURS and not item.name.endswith(".part")
    ]
    if foreign:
        raise OutputError(
            out,
            f"is not a shard set: it holds {', '.join(sorted(foreign)[:3])}",
            "choose an empty or new --out",
        )


def finished_shards(out: Path, plan: Plan) -> set[str]:
    """Names of the plan's shards that are there and whole.

    Raises:
        OutputError: the folder holds another conversion's shards, or something else.
    """
    _refuse_foreign(out)
    remove_parts(out)
    done: set[str] = set()
    planned = {unit.name for unit in plan.units}
    for path in sorted([*out.glob("train/*"), *out.glob("val/*")]):
        name = path.relative_to(out).as_posix()
        footer, _ = read_footer(path, str(path))
        if footer.plan["hash"] != plan.facts["hash"] or name not in planned:
            raise OutputError(
                out,
                f"belongs to another conversion; different: {differences(plan.facts, footer.plan)}",
                "choose another --out, or --overwrite to start anew",
            )
        done.add(name)
    if not done and (out / MANIFEST).is_file():
        theirs = Manifest.load(out).plan
        if theirs["hash"] != plan.facts["hash"]:
            raise OutputError(
                out,
                f"belongs to another conversion; different: {differences(plan.facts, theirs)}",
                "choose another --out, or --overwrite to start anew",
            )
    return done


def _reasons(out: Path) -> dict[str, int]:
    reasons: dict[str, int] = {}
    for line in (out / "quarantine.jsonl").read_text().splitlines():
        item = json.loads(line)
        text = f"{item['type']}: {item['message']}"
        if any(letter.isdigit() for letter in item["id"]):  # a numbered id would keep equal reasons apart
            text = re.sub(rf"(?<!\w){re.escape(item['id'])}(?!\w)", "<episode>", text)
        reasons[text] = reasons.get(text, 0) + 1
    return reasons


# -- the work


@dataclass(frozen=True)
class Tick:
    """What a worker tells the console."""

    frames: int = 0
    episodes: int = 0
    quarantined: int = 0
    bytes: int = 0


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


@dataclass(frozen=True)
class MakeWork:
    """Makes a worker's function; picklable, so that any engine can send it."""

    job: Job
    tokenizer: Tokenizer | None = None

    def __call__(self, workers: int) -> Work:
        """Open the tokenizer once for this worker."""
        tokenizer = self.tokenizer
        if tokenizer is None:
            tokenizer = get_tokenizer(self.job.tokenizer, weights=self.job.weights, device=self.job.device)
            if "torch" in sys.modules:
                sys.modules["torch"].set_num_threads(max(1, usable_cores() // workers))
        job = self.job

        def work(unit: ShardUnit, report: Report, attempt: Attempt) -> str:
            make_shard(job, unit, tokenizer, report, attempt)
            return unit.name

        return work


def make_shard(
    job: Job, unit: ShardUnit, tokenizer: Tokenizer, report: Report, attempt: Attempt = FIRST
) -> None:
    """Read, align, tokenize and write the episodes of one shard."""
    embodiment, strided = job.embodiment, job.facts["frames"] == "strided"
    cameras: list[str] = job.facts["cameras"]
    width = embodiment.chunk_dim if strided else embodiment.action_dim
    state_width = embodiment.state.dims if embodiment.state else 0
    schema = arrow_schema(tokenizer.spec, width, state_width, len(cameras))
    rows: list[EpisodeRow] = []
    refused: list[Refused] = []
    stats = {"action": Stats.empty(embodiment.action_dim)}
    if state_width:
        stats["state"] = Stats.empty(state_width)

    with ShardWriter(job.out / unit.name, schema, tokenizer.spec) as writer:
        decoded = _decoded(job, unit, tokenizer, report, attempt)
        ahead = prefetch(decoded) if not attempt.number else decoded  # one at a time shows whose fault it is
        for item in _tokenized(ahead, tokenizer, report):
            if isinstance(item, Refused):
                refused.append(item)
                report(Tick(episodes=1, quarantined=1))
                continue
            start = writer.rows
            for piece in _cut(item, cameras, embodiment.stride if strided else 1):
                writer.add(piece)
            stats["action"].merge(Stats.of(item.clip.actions))
            if item.clip.states is not None:
                stats["state"].merge(Stats.of(item.clip.states))
            rows.append(_row(item, unit, start, writer.rows - start, len(cameras)))
            report(Tick(episodes=1))
        writer.close(Footer(job.facts, unit.name, unit.split, tuple(rows), tuple(refused), stats))
    report(Tick(bytes=(job.out / unit.name).stat().st_size))


@dataclass
class _Begin:
    index: int
    ref: EpisodeRef
    clip: Clip


@dataclass
class _Frames:
    camera: str
    frames: NDArray[np.uint8]


@dataclass
class _Whole:
    index: int
    ref: EpisodeRef
    clip: Clip
    tokens: dict[str, NDArray[Any]]


def _decoded(
    job: Job, unit: ShardUnit, tokenizer: Tokenizer, report: Report, attempt: Attempt
) -> Iterator[_Begin | _Frames | Refused | None]:
    """Runs ahead in a thread: per episode a _Begin, its pictures in batches, then None; or a Refused."""
    source = open_source(job.embodiment.source.format)
    spec = tokenizer.spec
    strided = job.facts["frames"] == "strided"
    for index, ref in unit.episodes:
        if ref.id in attempt.refused:
            yield Refused(ref.id, "Fatal", f"{ref.id}: reading it {attempt.refused[ref.id]}")
            continue
        report(Step(ref.id))
        try:
            clip = to_clip(source.read(job.source, ref.id, job.embodiment), job.embodiment)
            stride = job.embodiment.stride if strided else 1
            if len(clip) < stride:
                raise EpisodeError(ref.id, f"has {len(clip)} frames, fewer than one stride of {stride}")
            yield _Begin(index, ref, clip)
            for name in job.facts["cameras"]:
                camera = job.embodiment.camera(name)
                kept = np.arange(0, len(clip) // stride * stride, stride)
                for start in range(0, len(kept), BATCH):
                    raw = clip.frames_at(name, kept[start : start + BATCH])
                    yield _Frames(name, prepare(raw, camera, spec.image_size, spec.resize_filter))
            yield None
        except FATAL:
            raise
        except MemoryError:
            raise
        except Exception as fault:  # whatever one recording does to a decoder must not end the job
            text = str(fault) if isinstance(fault, HMAError) else f"{type(fault).__name__}: {fault}"
            yield Refused(ref.id, type(fault).__name__, text)


def _tokenized(
    items: Iterator[_Begin | _Frames | Refused | None], tokenizer: Tokenizer, report: Report
) -> Iterator[_Whole | Refused]:
    begun: _Begin | None = None
    tokens: dict[str, list[NDArray[Any]]] = {}
    for item in items:
        if isinstance(item, Refused):
            yield item
        elif isinstance(item, _Begin):
            begun, tokens = item, {}
        elif isinstance(item, _Frames):
            tokens.setdefault(item.camera, []).append(tokenizer.encode(item.frames))
            report(Tick(frames=len(item.frames)))
        else:
            assert begun is not None
            whole = {camera: np.concatenate(parts) for camera, parts in tokens.items()}
            yield _Whole(begun.index, begun.ref, begun.clip, whole)


def _cut(item: _Whole, cameras: list[str], stride: int) -> Iterator[EpisodeRows]:
    """The episode's rows, camera after camera; strided rows carry the whole chunk of actions."""
    clip = item.clip
    kept = len(clip) // stride
    for camera in cameras:
        yield EpisodeRows(
            episode_index=item.index,
            timestamps=clip.timestamps[: kept * stride : stride],
            tokens=item.tokens[camera],
            actions=clip.actions[: kept * stride].reshape(kept, -1),
            states=None if clip.states is None else clip.states[: kept * stride : stride],
            camera=camera,
        )


def _row(item: _Whole, unit: ShardUnit, start: int, rows: int, cameras: int) -> EpisodeRow:
    clip = item.clip
    skew = {name: [float(v) for v in np.percentile(ms, [50, 95, 100])] for name, ms in clip.skew_ms.items()}
    worst = max(skew.values(), key=lambda values: values[2], default=[0.0, 0.0, 0.0])
    return EpisodeRow(
        episode_index=item.index,
        id=item.ref.id,
        split=unit.split,
        shard=unit.name,
        row_start=start,
        rows=rows,
        length=rows // cameras,
        instruction=clip.episode.instruction,
        success=clip.episode.success,
        fingerprint=item.ref.fingerprint,
        skew_p50_ms=worst[0],
        skew_p95_ms=worst[1],
        skew_max_ms=worst[2],
        skew=json.dumps(skew),
        trimmed=clip.trimmed,
        flags="trimmed" if clip.trimmed else "",
    )
