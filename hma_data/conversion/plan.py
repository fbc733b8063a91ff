"""Plan which episode goes into which shard, and with which cameras, before anything is decoded.

The plan depends on the recording, the embodiment, the tokenizer and the settings alone, never
on the number of workers, so that every run and every machine makes the same files. `estimate` says what the
work will cost.

Without a choice of cameras, only the primary one is stored. All cameras of the YAML are read even then: a
stream that is not stored still limits the time at which every stream runs.
"""

import hashlib
import heapq
import json
import math
import time
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from itertools import islice
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hma_data.arrays import Ints
from hma_data.conversion.settings import Settings
from hma_data.episodes.align import to_clip
from hma_data.episodes.episode import Clip
from hma_data.episodes.images import prepare
from hma_data.errors import EpisodeError, HMAError, SourceError, StorageAwayError
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.manifest import SPLITS, digest_of_texts, json_list, plan_hash
from hma_data.shards.schema import RowLayout, to_numpy
from hma_data.sources.base import EpisodeRef, Source, open_source
from hma_data.storage.paths import StrPath, as_text
from hma_data.storage.records import BATCH_RECORDS, Records, schema_of, values_of, with_columns
from hma_data.tokenizers.base import Tokenizer, TokenizerSpec

FRAMES_TOKENIZED, EPISODES_TRIED = 64, 5  # of an estimate
SHARDS_A_WORKER = 4  # so that the last shards of a job do not leave most workers waiting
VAL_FRACTION = 0.05
HELD_OUT = 5  # episodes of a small set: fewer give a verdict on a model no interval to speak of
SMALLEST_SHARD, LARGEST_SHARD, SHARDS_WANTED = 4_096, 170_000, 32  # frames; 170,000 are about 100 MB


@dataclass(frozen=True)
class ShardUnit:
    """A shard to make: the unit of work and of commit.

    Attributes:
        numbers: of its episodes, in the plan.
        refs: its episodes.
    """

    name: str
    split: str
    numbers: pa.Int64Array
    refs: Records[EpisodeRef]

    def __len__(self) -> int:
        return len(self.numbers)

    @property
    def episodes(self) -> list[tuple[int, EpisodeRef]]:
        """Return its episodes, each with its number; they are made anew on every call."""
        return list(zip(self.numbers.to_pylist(), self.refs))

    @property
    def frames(self) -> int:
        """Return the number of frames, as the source estimates it."""
        return int(to_numpy(self.refs.column("frames")).sum())


@dataclass(frozen=True)
class Plan:
    """All shards of a conversion, and the facts that distinguish it from others.

    Attributes:
        left_out: number of the recording's episodes that `only` and `exclude` leave out.
        outside: number of frames of the recordings that are in none of their episodes.
        own_split: whether the recording states which episodes are for validation.
    """

    units: tuple[ShardUnit, ...]
    facts: dict[str, Any]
    left_out: int = 0
    outside: int = 0
    own_split: bool = False

    @classmethod
    def of(cls, units: Sequence[ShardUnit], facts: dict[str, Any]) -> "Plan":
        """Return the plan of these units; its facts get their hash."""
        plain = json.loads(json.dumps(facts))  # as a footer gives them back
        return cls(tuple(units), {**plain, "hash": plan_hash(plain)})

    def with_origin(self, made_by: Mapping[str, Any]) -> "Plan":
        """Return the plan with what made its episodes, if that is no robot's recorder."""
        return self.with_facts({"made_by": dict(made_by)}) if made_by else self

    def with_facts(self, more: Mapping[str, Any]) -> "Plan":
        """Return the plan with more facts, and their hash."""
        facts = {key: value for key, value in self.facts.items() if key != "hash"}
        return replace(self, facts=Plan.of((), facts | dict(more)).facts)

    @property
    def episodes(self) -> int:
        """Return the number of episodes in all shards."""
        return sum(len(unit) for unit in self.units)

    @property
    def frames(self) -> int:
        """Return the number of frames in all shards, as the source estimates it."""
        return sum(unit.frames for unit in self.units)

    def table(self) -> pa.Table:
        """Return all episodes in the order of their numbers: the fields of EpisodeRef, `split` as planned."""
        if not self.units:
            return schema_of(EpisodeRef).empty_table()
        tables = [with_columns(u.refs.table, split=pa.repeat(u.split, len(u))) for u in self.units]
        numbers = np.concatenate([to_numpy(unit.numbers) for unit in self.units])
        return pa.concat_tables(tables).take(pa.array(np.argsort(numbers)))


def make_plan(
    refs: Sequence[EpisodeRef],
    embodiment: Embodiment,
    tokenizer: TokenizerSpec,
    settings: Settings,
    source: str,
) -> Plan:
    """Plan shards of whole episodes, with train and val in different shards.

    Args:
        refs: every episode of the source, in its order.
        source: URI, for errors.

    Raises:
        SourceError: there are no episodes, or two with one id.
        RegistryError: the embodiment lacks a camera, or its stride is needed and unknown.
    """
    if not refs:
        raise SourceError(source, "has no episodes")
    known = Records.of(EpisodeRef, refs)[: settings.limit]
    if (name := repeated(known.column("id"))) is not None:
        raise SourceError(source, f"has two episodes with id {name!r}")
    cameras = chosen_cameras(embodiment, settings.cameras)
    splits = np.array(choose_splits(known, settings.val_fraction, settings.seed))
    target = settings.shard_frames or shard_size(int(to_numpy(known.column("frames")).sum()))
    units = [
        unit
        for split in SPLITS
        for mine in [np.flatnonzero(splits == split)]
        for unit in pack(split, mine, known.take(mine), target)
    ]
    facts: dict[str, Any] = {
        "embodiment": embodiment.id,
        "embodiment_hash": embodiment.digest,
        "tokenizer": tokenizer.to_json(),
        "cameras": cameras,
        **({"camera_columns": True} if len(cameras) > 1 else {}),
        "frames": settings.frames,
        "frame_stride": settings.frame_stride(embodiment),
        "settings": settings.facts(cameras),
        "recording": digest_of_texts(recording_json(known.table)),
        "shards": digest_of_texts(cut_json(units)),
    }
    return Plan.of(units, facts)


def repeated(ids: pa.ChunkedArray) -> str | None:
    """Return the id that occurs most often if it occurs twice; None if every id is alone."""
    counts = ids.value_counts()
    most = int(np.argmax(to_numpy(counts.field("counts"))))
    return str(counts.field("values")[most]) if len(counts) < len(ids) else None


def recording_json(table: pa.Table) -> Iterator[str]:
    """Yield the JSON of [[id, fingerprint], …] in pieces."""
    batches = table.select(["id", "fingerprint"]).to_batches(max_chunksize=BATCH_RECORDS)
    return json_list(list(zip(*(column.to_pylist() for column in batch.columns))) for batch in batches)


def cut_json(units: Sequence[ShardUnit]) -> Iterator[str]:
    """Yield the JSON of [[shard name, [number, …]], …] in pieces."""
    return json_list([(unit.name, unit.numbers.to_pylist())] for unit in units)


def choose_splits(refs: Sequence[EpisodeRef], val_fraction: float | None, seed: int) -> list[str]:
    """Return train or val for each episode: the source's own split, or else by hash of the group's id.

    An episode without a group is a group of its own. With two or more groups and a fraction above zero, at
    least one group is val and at least one is train. Without a fraction it is VAL_FRACTION, and at least
    HELD_OUT groups are val, or a quarter of the groups where that is fewer.
    """
    known = Records.of(EpisodeRef, refs)
    own, group = known.column("split"), known.column("group")
    if any(own.unique().to_pylist()):
        return [split or "train" for split in values_of(own)]
    groups = pc.if_else(pc.equal(group, ""), known.column("id"), group).combine_chunks().dictionary_encode()
    texts = pc.binary_join_element_wise(str(seed), groups.dictionary, "/")
    # the first eight bytes of each hash, big-endian, as a number in 0..1
    hashed = b"".join(hashlib.sha256(text).digest() for text in values_of(texts.cast(pa.binary())))
    draws = np.frombuffer(hashed, ">u8").reshape(-1, 4)[:, 0] / 2.0**64
    held = draws < (VAL_FRACTION if val_fraction is None else val_fraction)
    if len(draws) >= 2 and val_fraction != 0:
        least = 1 if val_fraction is not None else max(1, min(HELD_OUT, len(draws) // 4))
        held[np.argsort(draws, kind="stable")[:least]] = True
        held[draws.argmax()] = False
    return ["val" if is_held else "train" for is_held in held[to_numpy(groups.indices)]]


def shard_size(frames: int) -> int:
    """Return the frames a shard: few enough for many shards, and for at most about 100 MB a shard."""
    return min(LARGEST_SHARD, max(SMALLEST_SHARD, frames // SHARDS_WANTED))


def pack(
    split: str, numbers: Ints, refs: Records[EpisodeRef], target: int, begun: int = 0
) -> list[ShardUnit]:
    """Pack episodes (N,) into shards of about `target` frames; `begun` shards of the split exist already."""
    ends = np.cumsum(np.maximum(to_numpy(refs.column("frames")), 1))
    units: list[ShardUnit] = []
    start = filled = 0
    while start < len(ends):
        stop = min(int(np.searchsorted(ends, filled + target)) + 1, len(ends))
        name = f"{split}/shard-{begun + len(units):05d}.parquet"
        units.append(ShardUnit(name, split, pa.array(numbers[start:stop], pa.int64()), refs[start:stop]))
        start, filled = stop, int(ends[stop - 1])
    return units


def differences(mine: dict[str, Any], theirs: dict[str, Any]) -> str:
    """Return the differences of two plans in words."""
    words = {
        "embodiment": "embodiment",
        "embodiment_hash": "content of the embodiment's YAML",
        "tokenizer": "tokenizer",
        "cameras": "cameras",
        "camera_columns": "columns of the cameras",
        "frames": "--frames",
        "frame_stride": "recorded steps per row (with --frames strided, the YAML's stride)",
        "recording": "recordings",
    }
    found = []
    for key, word in words.items():
        if mine.get(key) != theirs.get(key):
            ours, other = _short(mine.get(key)), _short(theirs.get(key))
            found.append(f"{word} ({other} there, {ours} now)" if ours != other else word)
    ours, others = mine.get("settings", {}), theirs.get("settings", {})
    options = [
        f"--{name.replace('_', '-')} {_short(others.get(name))} there, {_short(ours.get(name))} now"
        for name in sorted((ours.keys() | others.keys()) - words.keys())
        if ours.get(name) != others.get(name)
    ]
    if options:
        found.append(f"settings ({'; '.join(options)})")
    return ", ".join(found) or "the cut into shards"


def _short(value: Any) -> str:
    if isinstance(value, dict):
        if "weights_sha256" not in value:  # not a tokenizer
            return ""
        return f"{value['name']} {TokenizerSpec.from_json(value).weights_digest}".strip()
    return ", ".join(map(str, value)) if isinstance(value, list) else str(value)


# -- cameras


def chosen_cameras(embodiment: Embodiment, cameras: Sequence[str]) -> list[str]:
    """Return the names of the cameras to store; the first one is that of the first token column.

    Args:
        cameras: names; ("all",) takes all of the YAML, the primary one first; none takes the primary one.

    Raises:
        RegistryError: the embodiment lacks a camera.
    """
    primary = embodiment.primary_camera.name
    if tuple(cameras) == ("all",):
        return [primary, *(camera.name for camera in embodiment.cameras if camera.name != primary)]
    return list(dict.fromkeys(embodiment.camera(name).name for name in cameras)) or [primary]


def read_clip(
    source: Source, uri: str, episode_id: str, embodiment: Embodiment, cameras: Sequence[str]
) -> Clip:
    """Return an episode with the cameras that are stored; the others neither refuse nor shorten it."""

    def read(names: Sequence[str]) -> Clip:
        robot = embodiment.with_cameras(names)
        return to_clip(source.read(uri, episode_id, robot), robot)

    def is_readable(names: Sequence[str]) -> bool:
        try:
            return bool(len(read(names)))
        except (EpisodeError, SourceError):
            return False

    try:
        return read(cameras)
    except StorageAwayError:
        raise
    except (EpisodeError, SourceError) as fault:
        for name in cameras if len(cameras) > 1 else ():
            if is_readable([other for other in cameras if other != name]):
                raise camera_fault(episode_id, name, cameras, fault) from fault
        raise


def camera_fault(episode_id: str, camera: str, cameras: Sequence[str], fault: Exception) -> EpisodeError:
    """Return the error of an episode in which one of several cameras cannot be read."""
    said = fault.fault if isinstance(fault, HMAError) else f"{type(fault).__name__}: {fault}"
    others = ",".join(name for name in cameras if name != camera)
    remedy = f"--cameras {others} leaves {camera} out"
    return EpisodeError(episode_id, f"camera {camera} cannot be read: {said}", remedy)


# -- the cost


@dataclass(frozen=True)
class Estimate:
    """The estimated size and time of a conversion.

    Attributes:
        bytes: of all shards.
        frames_per_second: of one worker, decoding included; None when no episode could be read.
        seconds: until the last worker ends; None when no episode could be read.
        fault: why no episode could be read.
        frame_sizes: camera -> [height, width] of its recorded frames.
    """

    bytes: int
    frames_per_second: float | None
    seconds: float | None
    fault: str = ""
    frame_sizes: dict[str, tuple[int, int]] = field(default_factory=dict)


def estimate(
    plan: Plan, uri: StrPath, embodiment: Embodiment, tokenizer: Tokenizer, workers: int, tasks: int = 1
) -> Estimate:
    """Estimate a conversion: tokenize some frames of the first readable episode, and scale up.

    Args:
        workers: of each task.
        tasks: jobs that share the shards, see `output.Share`; all run at the same time.
    """
    layout = RowLayout.of_plan(plan.facts, embodiment)
    rows = plan.frames // layout.frame_stride
    size = int(rows * bytes_a_row(layout))
    source = open_source(embodiment.source.format)
    fault = ""
    for _, ref in islice((item for unit in plan.units for item in unit.episodes), EPISODES_TRIED):
        try:
            begun = time.monotonic()
            clip = read_clip(source, as_text(uri), ref.id, embodiment, layout.cameras)
            kept, sizes = layout.kept(len(clip))[:FRAMES_TOKENIZED], {}
            for name in layout.cameras:
                raw, spec = clip.frames_at(name, kept), tokenizer.spec
                tokenizer.encode(prepare(raw, embodiment.camera(name), spec.image_size, spec.resize_filter))
                sizes[name] = (raw.shape[1], raw.shape[2])
            rate = len(kept) / (time.monotonic() - begun)
            slowest = longest_work([unit.frames for unit in plan.units], workers, tasks)
            return Estimate(size, rate, slowest / layout.frame_stride / rate, frame_sizes=sizes)
        except HMAError as refused:
            fault = str(refused)
    return Estimate(size, None, None, fault)


def longest_work(frames: Sequence[int], workers: int, tasks: int = 1) -> int:
    """Return the frames of the worker that has most, where each takes the next shard when it is free.

    Args:
        frames: of every shard, in the order of the plan.
        workers, tasks: see `estimate`.
    """
    longest = 0
    for task in range(min(tasks, len(frames))):
        mine = frames[task::tasks]
        busy = [0] * max(1, min(workers, len(mine)))
        for shard in mine:
            heapq.heapreplace(busy, busy[0] + shard)
        longest = max(longest, *busy)
    return longest


def idle_workers(plan: Plan, todo: int, workers: int, tasks: int = 1, begun: bool = False) -> str:
    """Return a line for the user where workers have no shard to make; empty where every worker has one.

    Args:
        todo: number of shards that this task has to make.
        workers, tasks: see `estimate`.
        begun: whether shards of the plan are there: then their size can no longer be chosen.
    """
    if todo >= workers:
        return ""
    line = f"{todo} of {workers} workers have work"
    shortest = min((int(to_numpy(unit.refs.column("frames")).min()) for unit in plan.units), default=0)
    size = max(plan.frames // (tasks * workers * SHARDS_A_WORKER), shortest, 1)
    if begun or not any(unit.frames > size for unit in plan.units if len(unit) > 1):
        return line  # a shard holds whole episodes
    return f"{line}; --shard-frames {size}{' in every task' if tasks > 1 else ''} gives more"


def bytes_a_row(layout: RowLayout) -> float:
    """Return the bytes of one row.

    Tokens count with log2 of the vocabulary's size, latents and pixels with the size of their dtype, and
    numbers with 4 bytes each.
    """
    spec = layout.tokenizer
    cell: float = np.dtype(spec.dtype).itemsize
    if spec.kind == "discrete":
        cell = math.ceil(math.log2(spec.vocab_size or 2)) / 8
    tokens = math.prod(spec.cells) * cell * len(layout.cameras)
    return tokens + 4 * (layout.frame_stride * layout.widths["action"] + layout.widths.get("state", 0))
