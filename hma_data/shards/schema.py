"""Define the columns and the footer of a shard.

S = h·w tokens a frame, c channels, A values of an action. docs/format.md specifies all of this.
"""

import json
import math
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from hma_data.arrays import Array, Ints
from hma_data.errors import ShardError
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.stats import Stats
from hma_data.storage.files import parse_json
from hma_data.storage.records import Records
from hma_data.storage.remote import parquet_input
from hma_data.tokenizers.base import TokenizerSpec

SCHEMA_VERSION = 1
ROW_GROUP = 2048
GROUP_VALUES = 1 << 24  # tokens of a row group; Parquet's writer holds small integers in four bytes each
MALFORMED = (KeyError, TypeError, ValueError, AttributeError, RecursionError)  # what wrong JSON raises
FOOTER_KEY = b"hma"  # of the footer's JSON in the metadata of a file
# flags that measure an episode and count no frames: a sum of them means nothing
MEASURES = {"millinats", "millilatents"}
PAUSES = "pauses="  # begins the word of an episode's flags that states its pauses
PLAN_HASH = b"hma.plan_hash"  # states the plan beside the footer's JSON, for those who need no more


@dataclass(frozen=True)
class EpisodeRow:
    """One row of episodes.parquet.

    Attributes:
        episode_index: place in the plan; the same number is in the shard's rows.
        id: id of the episode in its source.
        split: train or val.
        shard: path of its shard below the shard set.
        row_start: number of its first row in the shard.
        rows: its rows in the shard.
        length: frames.
        skew_p50_ms, skew_p95_ms, skew_max_ms: skew of the stream that was moved furthest.
        skew: stream -> [p50, p95, max] in ms, as JSON.
        trimmed: frames cut at the ends, where some streams had no data.
        flags: remarks, comma separated, counts as `masked_actions=12`, pauses; see `flags_text`.
        group: shared by the episodes of one recording, which belong in one split; empty for an episode
            that has a recording of its own.
        source: source of the episode if it differs from the set's.
        content: hash over what was read of it, see `hma_data.conversion.extend`; empty if it was not
            recorded.
        language: what is said in words about moments of the episode, as JSON; empty where nothing is.
    """

    episode_index: int
    id: str
    split: str
    shard: str
    row_start: int
    rows: int
    length: int
    instruction: str
    success: bool | None
    fingerprint: str
    skew_p50_ms: float
    skew_p95_ms: float
    skew_max_ms: float
    skew: str
    trimmed: int
    flags: str
    group: str = ""
    source: str = ""
    content: str = ""
    language: str = ""

    def to_json(self) -> dict[str, Any]:
        """Return the fields, without an empty `language`: few recordings have one."""
        return {name: value for name, value in vars(self).items() if value or name != "language"}


@dataclass(frozen=True)
class Refused:
    """An episode in quarantine: one line of quarantine.jsonl."""

    id: str
    type: str
    message: str


@dataclass(frozen=True)
class Footer:
    """The facts that a shard states about itself; the manifest is derived from the footers alone.

    Attributes:
        plan: what the shard was made from, see `hma_data.conversion.plan.Plan.facts`.
        name: its path below the shard set.
        split: train or val.
        episodes: its episodes, in row order; `Records` where the footer was read.
        quarantine: episodes planned for it that were refused.
        stats: "action" and, if recorded, "state" -> Stats, per raw dim.
    """

    plan: dict[str, Any]
    name: str
    split: str
    episodes: Sequence[EpisodeRow]
    quarantine: tuple[Refused, ...]
    stats: dict[str, Stats]

    @property
    def table(self) -> pa.Table:
        """Return its episodes as a table, a column for each field of `EpisodeRow`."""
        return Records.of(EpisodeRow, self.episodes).table

    def to_metadata(self) -> dict[bytes, bytes]:
        """Return the key-value metadata of the parquet footer."""
        values = {
            "schema_version": SCHEMA_VERSION,
            "plan": self.plan,
            "name": self.name,
            "split": self.split,
            "episodes": [row.to_json() for row in self.episodes],
            "quarantine": [vars(item) for item in self.quarantine],
            "stats": {name: stats.to_json() for name, stats in self.stats.items()},
        }
        facts = {
            "hma.embodiment": self.plan["embodiment"],
            "hma.embodiment_hash": self.plan["embodiment_hash"],
            "hma.tokenizer": self.plan["tokenizer"]["name"],
            "hma.tokenizer_sha256": self.plan["tokenizer"]["weights_sha256"],
        }
        return {
            FOOTER_KEY: json.dumps(values).encode(),
            **{k.encode(): v.encode() for k, v in facts.items()},
            PLAN_HASH: self.plan["hash"].encode(),
        }

    @classmethod
    def from_metadata(cls, metadata: dict[bytes, bytes] | None, where: str) -> "Footer":
        """Read the footer of a shard from the metadata of its file.

        Raises:
            ShardError: the file is no shard, its version is not read here, or its footer is damaged.
        """
        if not metadata or FOOTER_KEY not in metadata:
            raise ShardError(where, "is a parquet file but not a shard: its footer has no 'hma' entry")
        try:
            values = parse_json(metadata[FOOTER_KEY])
            check_version(values, where)
            return cls(
                plan=values["plan"],
                name=values["name"],
                split=values["split"],
                episodes=Records.of_json(EpisodeRow, values["episodes"]),
                quarantine=tuple(Refused(**item) for item in values["quarantine"]),
                stats={name: Stats.from_json(stats) for name, stats in values["stats"].items()},
            )
        except MALFORMED as fault:
            said = f"has a damaged footer: {fault!r}"
            raise ShardError(where, said, "delete it and convert again") from fault


def check_version(values: dict[str, Any], where: object) -> None:
    """Raise ShardError unless a footer or manifest has the schema version that this release reads."""
    if values["schema_version"] != SCHEMA_VERSION:
        fault = f"has schema version {values['schema_version']}, and this release reads {SCHEMA_VERSION}"
        raise ShardError(where, fault, "read it with the release that wrote it")


def flags_text(trimmed: int, counts: Mapping[str, int], pauses: Mapping[int, int] | None = None) -> str:
    """Return the flags of an episode: trimmed, each count as name=count, then the pauses.

    Args:
        pauses: frame -> recorded steps to the next frame, written as `pauses=frame:steps;frame:steps`.
    """
    words = ["trimmed"] if trimmed else []
    words += [f"{name}={count}" for name, count in sorted(counts.items())]
    if pauses:
        words.append(PAUSES + ";".join(f"{frame}:{steps}" for frame, steps in pauses.items()))
    return ",".join(words)


def flag_pauses(flags: str) -> dict[int, int]:
    """Return the pauses that `flags_text` wrote."""
    if PAUSES not in flags:
        return {}
    found = re.search(rf"(?:^|,){PAUSES}(\d+:\d+(?:;\d+:\d+)*)", flags)
    pairs = (pair.split(":") for pair in found[1].split(";")) if found else ()
    return {int(frame): int(steps) for frame, steps in pairs}


def flag_counts(flags: str) -> dict[str, int]:
    """Return the counts that `flags_text` wrote; leave out words without a count."""
    pairs = (word.partition("=") for word in flags.split(","))
    return {name.strip(): int(count) for name, _, count in pairs if count.strip().isdecimal()}


def flag_words(name: str) -> str:
    """Return the name of a flag in words: `blank_pictures:top` is blank pictures of top."""
    kind, _, camera = name.partition(":")
    return kind.replace("_", " ") + (f" of {camera}" if camera else "")


def flag_totals(flags: pa.ChunkedArray) -> dict[str, int]:
    """Return name -> count over all episodes, from the column `flags`; without MEASURES."""
    totals: Counter[str] = Counter()
    for item in flags.value_counts().to_pylist():
        for name, count in flag_counts(item["values"] or "").items():
            totals[name] += 0 if name in MEASURES else count * item["counts"]
    return dict(sorted((name, count) for name, count in totals.items() if count))


def token_column(spec: TokenizerSpec) -> tuple[str, int]:
    """Return the name of the column that holds a frame of the first camera, and its number of values a row.

    Each further camera has a column of its own, see `RowLayout.token_columns`.
    """
    return "tokens" if spec.kind == "discrete" else "latents", math.prod(spec.cells)


def _vector(values: pa.DataType, width: int) -> pa.DataType:
    return pa.list_(pa.field("element", values, nullable=False), width)


_STORED = {"uint8": pa.uint8(), "uint16": pa.uint16(), "uint32": pa.uint32(), "float16": pa.float16()}


def mask_columns(embodiment: Embodiment) -> tuple[str, ...]:
    """Return the columns that state which numbers are known, for embodiments with unknown numbers.

    Those embodiments have `sync.beyond: mask`, or are hand videos with `missing: mask`.
    """
    layout = embodiment.source.layout or {}
    hands = embodiment.source.format == "hands" and layout.get("missing") == "mask"
    if embodiment.sync.beyond != "mask" and not hands:
        return ()
    return ("action_known", "state_known") if embodiment.state else ("action_known",)


def arrow_schema(
    spec: TokenizerSpec,
    action_width: int,
    state_width: int,
    further: Sequence[str] = (),
    masks: Sequence[str] = (),
) -> pa.Schema:
    """Return the columns of a shard; no value is ever null.

    Args:
        further: names of the columns of the cameras after the first.
        masks: see `mask_columns`.
    """
    name, width = token_column(spec)
    columns = {
        "episode_index": pa.int32(),
        "frame_index": pa.int32(),
        "timestamp": pa.float64(),
        **{column: _vector(_STORED[spec.dtype], width) for column in (name, *further)},
        "action": _vector(pa.float32(), action_width),
        "state": _vector(pa.float32(), state_width) if state_width else None,
        **{mask: pa.bool_() for mask in masks},
    }
    return pa.schema([pa.field(column, kind, nullable=False) for column, kind in columns.items() if kind])


@dataclass(frozen=True)
class RowLayout:
    """The layout of a shard set's rows: which recorded frames become rows, and which columns hold them.

    Attributes:
        embodiment, tokenizer: what the set was made with.
        cameras: names, the first one's frames in the first token column.
        frame_stride: recorded steps a row: 1, or the embodiment's stride where only the model's grid is kept.
    """

    embodiment: Embodiment
    tokenizer: TokenizerSpec
    cameras: tuple[str, ...]
    frame_stride: int

    @classmethod
    def of_plan(cls, plan: dict[str, Any], embodiment: Embodiment) -> "RowLayout":
        """Return the layout that the facts of a plan state."""
        tokenizer, cameras = TokenizerSpec.from_json(plan["tokenizer"]), tuple(plan["cameras"])
        return cls(embodiment, tokenizer, cameras, int(plan["frame_stride"]))

    @property
    def token_columns(self) -> dict[str, str]:
        """Return camera -> the column of its frames."""
        first = token_column(self.tokenizer)[0]
        return {name: f"{first}_{name}" if i else first for i, name in enumerate(self.cameras)}

    @property
    def widths(self) -> dict[str, int]:
        """Return "action" and, if there is one, "state" -> values of one recorded step."""
        state = self.embodiment.state
        return {"action": self.embodiment.action_dim} | ({"state": state.dims} if state else {})

    @property
    def schema(self) -> pa.Schema:
        """Return the columns of a shard."""
        return arrow_schema(
            self.tokenizer,
            self.widths["action"] * self.frame_stride,
            self.widths.get("state", 0),
            [*self.token_columns.values()][1:],
            mask_columns(self.embodiment),
        )

    def kept(self, length: int) -> Ints:
        """Return the frames (N,) of a clip of `length` frames that become rows."""
        return np.arange(0, length // self.frame_stride * self.frame_stride, self.frame_stride)

    def empty_stats(self) -> dict[str, Stats]:
        """Return the statistics of no rows, by vector."""
        return {name: Stats.empty(width) for name, width in self.widths.items()}

    def stats(self, columns: Mapping[str, Array], rows: slice) -> dict[str, Stats]:
        """Return the statistics of some rows of the columns (N, width), by vector; skip unknown values."""
        found = {}
        for name, width in self.widths.items():
            values, known = columns[name][rows], columns.get(f"{name}_known")
            found[name] = Stats.of((values if known is None else values[known[rows]]).reshape(-1, width))
        return found


def encodings(schema: pa.Schema) -> dict[str, str]:
    """Choose encodings: byte-stream split for values that look random, deltas for values that count up."""
    chosen: dict[str, str] = {}
    for column in schema:
        if pa.types.is_fixed_size_list(column.type):
            if column.type.value_type != pa.uint8():
                chosen[f"{column.name}.list.element"] = "BYTE_STREAM_SPLIT"
        elif pa.types.is_floating(column.type):
            chosen[column.name] = "BYTE_STREAM_SPLIT"
        elif pa.types.is_integer(column.type):
            chosen[column.name] = "DELTA_BINARY_PACKED"
    return chosen


def to_arrow(column: pa.Field, values: Array) -> pa.Array:
    """Convert a numpy array (N, …) to the arrow array of that column."""
    if pa.types.is_fixed_size_list(column.type):
        flat = pa.array(np.ascontiguousarray(values).reshape(-1), type=column.type.value_type)
        return pa.FixedSizeListArray.from_arrays(flat, type=column.type)
    return pa.array(values, type=column.type)


def to_numpy(column: pa.ChunkedArray) -> Array:
    """Convert a column to numpy (N,) or (N, width), without a copy if arrow allows it."""
    array = column.combine_chunks() if isinstance(column, pa.ChunkedArray) else column
    if pa.types.is_fixed_size_list(array.type):
        return _flat(array.flatten()).reshape(-1, array.type.list_size)
    return _flat(array)


def _flat(array: pa.Array) -> Array:
    """Convert like array.to_numpy, without its import of pandas, which takes a second and 50 MB a worker."""
    if pa.types.is_boolean(array.type):
        return _flat(array.cast(pa.uint8())).astype(np.bool_)
    plain = pa.types.is_integer(array.type) or pa.types.is_floating(array.type)
    if array.null_count or not plain:
        return array.to_numpy(zero_copy_only=False)
    return np.from_dlpack(array)


def joined(parts: Sequence[dict[str, Array]]) -> dict[str, Array]:
    """Return columns of rows that follow one another as one; a single part is not copied."""
    if len(parts) == 1:
        return parts[0]
    return {name: np.concatenate([part[name] for part in parts]) for name in parts[0]}


def read_metadata(path: Path) -> pq.FileMetaData:
    """Return the metadata of a shard's file."""
    try:
        return pq.read_metadata(parquet_input(path))
    except (pa.ArrowInvalid, OSError) as fault:
        remedy = "delete it and convert again"
        raise ShardError(path, f"is not a whole parquet file: {fault}", remedy) from fault


def group_rows(metadata: pq.FileMetaData) -> list[int]:
    """Return the number of rows of each row group of a file."""
    return [metadata.row_group(i).num_rows for i in range(metadata.num_row_groups)]


def read_footer(path: Path) -> tuple[Footer, list[int]]:
    """Return the footer and the number of rows of each row group of a shard."""
    metadata = read_metadata(path)
    return Footer.from_metadata(metadata.metadata, str(path)), group_rows(metadata)
