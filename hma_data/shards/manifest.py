"""The manifest, episodes.parquet and quarantine.jsonl of a shard set: all derived from the shards' footers.

They are written last, so a shard set without a manifest is one whose job has not finished.
"""

import json
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from hma_data.embodiment import Embodiment
from hma_data.errors import ShardError
from hma_data.files import atomic_path, file_sha256, write_atomic
from hma_data.shards.schema import SCHEMA_VERSION, Footer, read_footer
from hma_data.stats import Stats
from hma_data.tokenizers.base import TokenizerSpec

MANIFEST, EPISODES, QUARANTINE, EMBODIMENT = (
    "manifest.json",
    "episodes.parquet",
    "quarantine.jsonl",
    "embodiment.yaml",
)

_EPISODE_SCHEMA = pa.schema(
    [
        ("episode_index", pa.int32()),
        ("id", pa.string()),
        ("split", pa.string()),
        ("shard", pa.string()),
        ("row_start", pa.int64()),
        ("rows", pa.int64()),
        ("length", pa.int64()),
        ("instruction", pa.string()),
        ("success", pa.bool_()),
        ("source", pa.string()),
        ("fingerprint", pa.string()),
        ("skew_p50_ms", pa.float64()),
        ("skew_p95_ms", pa.float64()),
        ("skew_max_ms", pa.float64()),
        ("skew", pa.string()),
        ("trimmed", pa.int64()),
        ("flags", pa.string()),
    ]
)


@dataclass(frozen=True)
class ShardFile:
    """A shard as the manifest lists it.

    Attributes:
        row_groups: rows of each; a reader plans with them without opening the file.
    """

    path: str
    split: str
    rows: int
    episodes: int
    bytes: int
    sha256: str
    row_groups: tuple[int, ...]


@dataclass(frozen=True)
class Manifest:
    """What a shard set holds.

    Attributes:
        plan: what it was made from; the same in every footer.
        embodiment, tokenizer: snapshots.
        shards: in plan order.
        splits: split -> {episodes, frames, rows, shards}.
        stats: "action", "state" -> summary over train (see Stats.summary).
        quarantined: refused episodes.
    """

    plan: dict[str, Any]
    embodiment: Embodiment
    tokenizer: TokenizerSpec
    shards: tuple[ShardFile, ...]
    splits: dict[str, dict[str, int]]
    stats: dict[str, dict[str, Any]]
    quarantined: int
    source: str

    @property
    def frame_stride(self) -> int:
        """Recorded steps a row: 1, or the embodiment's stride when only the grid's frames are kept."""
        return int(self.plan["frame_stride"])

    @property
    def cameras(self) -> list[str]:
        """Cameras in the shards, in row order within an episode."""
        return list(self.plan["cameras"])

    def to_json(self) -> dict[str, Any]:
        """Plain values of manifest.json."""
        return {
            "schema_version": SCHEMA_VERSION,
            "plan": self.plan,
            "source": self.source,
            "embodiment": self.embodiment.to_dict(),
            "tokenizer": self.tokenizer.to_json(),
            "splits": self.splits,
            "totals": {
                "episodes": sum(split["episodes"] for split in self.splits.values()),
                "frames": sum(split["frames"] for split in self.splits.values()),
                "bytes": sum(shard.bytes for shard in self.shards),
                "quarantined": self.quarantined,
            },
            "stats": self.stats,
            "shards": [asdict(shard) for shard in self.shards],
        }

    @classmethod
    def load(cls, folder: Path) -> "Manifest":
        """The manifest of a shard set.

        Raises:
            ShardError: there is none, or it is damaged.
        """
        path = folder / MANIFEST
        if not path.is_file():
            raise ShardError(
                folder,
                f"has no {MANIFEST}",
                "its conversion has not finished: run the same hma convert again",
            )
        try:
            values = json.loads(path.read_bytes())
            if values["schema_version"] != SCHEMA_VERSION:
                raise ShardError(
                    path,
                    f"has schema version {values['schema_version']}, this release reads {SCHEMA_VERSION}",
                )
            return cls(
                plan=values["plan"],
                embodiment=Embodiment.from_values(values["embodiment"], str(path)),
                tokenizer=TokenizerSpec.from_json(values["tokenizer"]),
                shards=tuple(
                    ShardFile(**{**s, "row_groups": tuple(s["row_groups"])}) for s in values["shards"]
                ),
                splits=values["splits"],
                stats=values["stats"],
                quarantined=values["totals"]["quarantined"],
                source=values["source"],
            )
        except (KeyError, TypeError, ValueError) as fault:
            raise ShardError(
                path, f"is damaged: {fault}", "delete it and run the same hma convert again"
            ) from fault


def finish(
    folder: Path,
    names: list[str],
    embodiment: Embodiment,
    tokenizer: TokenizerSpec,
    plan: dict[str, Any],
    source: str,
) -> Manifest:
    """Derive and write everything that is not a shard; the manifest comes last.

    Args:
        folder: of the shard set.
        names: of the shards, in plan order; all are there.
        source: URI the recordings came from.

    Raises:
        ShardError: a shard is damaged.
    """
    footers: list[Footer] = []
    files: list[ShardFile] = []
    for name in names:
        path = folder / name
        footer, row_groups = read_footer(path, str(path))
        footers.append(footer)
        files.append(
            ShardFile(
                path=name,
                split=footer.split,
                rows=sum(row_groups),
                episodes=len(footer.episodes),
                bytes=path.stat().st_size,
                sha256=file_sha256(path),
                row_groups=tuple(row_groups),
            )
        )
    manifest = Manifest(
        plan=plan,
        embodiment=embodiment,
        tokenizer=tokenizer,
        shards=tuple(files),
        splits={split: _split_totals(footers, split) for split in ("train", "val")},
        stats={name: stats.summary() for name, stats in merged_stats(footers).items()},
        quarantined=sum(len(footer.quarantine) for footer in footers),
        source=source,
    )
    with atomic_path(folder / EPISODES) as part:
        pq.write_table(episode_table(footers, source), part, compression="zstd")
    refused = sorted((item for footer in footers for item in footer.quarantine), key=lambda item: item.id)
    lines = [
        json.dumps({"id": item.id, "uri": source, "type": item.type, "message": item.message})
        for item in refused
    ]
    write_atomic(folder / QUARANTINE, "".join(f"{line}\n" for line in lines))
    write_atomic(folder / EMBODIMENT, embodiment.to_yaml())
    write_atomic(folder / MANIFEST, json.dumps(manifest.to_json(), indent=1) + "\n")
    return manifest


def merged_stats(footers: list[Footer]) -> dict[str, Stats]:
    """Statistics over the train shards, merged in plan order."""
    merged: dict[str, Stats] = {}
    for footer in footers:
        for name, stats in footer.stats.items():
            if name not in merged:
                merged[name] = Stats.empty(len(stats.mean))
            if footer.split == "train":
                merged[name].merge(stats)
    return merged


def episode_table(footers: list[Footer], source: str) -> pa.Table:
    """episodes.parquet, in order of episode_index."""
    rows = sorted((row for footer in footers for row in footer.episodes), key=lambda row: row.episode_index)
    columns = {
        name: [getattr(row, name) for row in rows] for name in _EPISODE_SCHEMA.names if name != "source"
    }
    columns["source"] = [source] * len(rows)
    return pa.table(columns, schema=_EPISODE_SCHEMA)


def _split_totals(footers: list[Footer], split: str) -> dict[str, int]:
    rows = [row for footer in footers if footer.split == split for row in footer.episodes]
    return {
        "episodes": len(rows),
        "frames": sum(row.length for row in rows),
        "rows": sum(row.rows for row in rows),
        "shards": sum(footer.split == split for footer in footers),
    }
