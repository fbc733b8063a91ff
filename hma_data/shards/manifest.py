"""Derive the manifest, episodes.parquet and quarantine.jsonl of a shard set from the shards' footers.

They are written last, so a shard set without a manifest is one whose job has not finished.
"""

import hashlib
import json
import re
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from shlex import quote
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from hma_data.cpu import in_order
from hma_data.errors import ShardError
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.schema import (
    MALFORMED,
    SCHEMA_VERSION,
    EpisodeRow,
    Footer,
    Refused,
    RowLayout,
    check_version,
    group_rows,
    read_metadata,
    to_numpy,
)
from hma_data.shards.stats import Stats
from hma_data.storage.files import atomic_path, file_sha256, parse_json, write_atomic
from hma_data.storage.kinds import misplaced
from hma_data.storage.locks import LOCK
from hma_data.storage.paths import StrPath
from hma_data.storage.records import schema_of
from hma_data.storage.remote import RemotePath, place
from hma_data.tokenizers.base import TokenizerSpec

MANIFEST, EPISODES = "manifest.json", "episodes.parquet"
QUARANTINE, EMBODIMENT = "quarantine.jsonl", "embodiment.yaml"
SPLITS = ("train", "val")
WORKING = (LOCK, ".journal", ".plan")  # names of what a conversion keeps in the folder begin with these
FINDER = ".DS_Store"  # macOS writes it into any folder that somebody looks at
FILES_BESIDE = {"README.md", ".gitattributes", FINDER}  # not of the set: a hub adds the first two
HASHERS = 4  # threads; hashing releases the interpreter lock
SHARD_NAME = re.compile(r"(train|val)/shard-([0-9]{5,9})\.parquet")
_SHA256 = re.compile(r"([0-9a-f]{64})?")  # a part of a LeRobotDataset has none
_SEAL = re.compile(rb'"manifest_sha256": "([0-9a-f]{64})"')
_UNSEALED = "0" * 64

_EPISODE_COLUMNS = (
    "episode_index", "id", "split", "shard", "row_start", "rows", "length", "instruction", "success",
    "source", "fingerprint", "skew_p50_ms", "skew_p95_ms", "skew_max_ms", "skew", "trimmed", "flags",
    "group", "content", "language",
)  # fmt: skip
_EPISODE_SCHEMA = pa.schema(
    [
        (name, pa.int32() if name == "episode_index" else schema_of(EpisodeRow).field(name).type)
        for name in _EPISODE_COLUMNS
    ]
)


@dataclass(frozen=True)
class ShardFile:
    """A shard as the manifest lists it.

    Attributes:
        row_groups: number of rows of each row group; a reader plans with it without opening the file.
    """

    path: str
    split: str
    rows: int
    episodes: int
    bytes: int
    sha256: str
    row_groups: tuple[int, ...]

    def __post_init__(self) -> None:
        named = SHARD_NAME.fullmatch(self.path)  # keeps paths inside the folder, even in a forged manifest
        if not named or named[1] != self.split:
            raise ValueError(f"{self.path!r} is not the name of a shard of split {self.split!r}")
        if not _SHA256.fullmatch(self.sha256):  # it names the shard's copy in this machine's cache
            raise ValueError(f"{self.sha256[:80]!r} is not the sha256 of a shard")


@dataclass(frozen=True)
class Manifest:
    """The content of a shard set.

    Attributes:
        plan: what it was made from; the same in every footer.
        embodiment, tokenizer: copies from the time of the conversion.
        shards: in plan order.
        splits: split -> {episodes, frames, rows, shards}.
        stats: "action", "state" -> summary over train (see Stats.summary).
        quarantined: number of refused episodes.
        files: name -> sha256 of the other files of the set.
    """

    plan: dict[str, Any]
    embodiment: Embodiment
    tokenizer: TokenizerSpec
    shards: tuple[ShardFile, ...]
    splits: dict[str, dict[str, int]]
    stats: dict[str, dict[str, Any]]
    quarantined: int
    source: str
    files: dict[str, str] = field(default_factory=dict)

    @cached_property
    def layout(self) -> RowLayout:
        """Return which recorded frames the rows hold, and in which columns."""
        return RowLayout.of_plan(self.plan, self.embodiment)

    @property
    def episodes(self) -> int:
        """Return the number of episodes in all splits."""
        return sum(split["episodes"] for split in self.splits.values())

    @property
    def frame_stride(self) -> int:
        """Return the recorded steps a row: 1, or the embodiment's stride if only grid frames are kept."""
        return self.layout.frame_stride

    @property
    def cameras(self) -> list[str]:
        """Return the cameras in the shards, in order."""
        return list(self.layout.cameras)

    @property
    def cameras_line(self) -> str:
        """Return which cameras of the YAML are stored and which are not, in one line."""
        return cameras_line(self.cameras, self.embodiment)

    def to_json(self) -> dict[str, Any]:
        """Return the plain values of manifest.json."""
        several = len(self.embodiment.cameras) > 1
        return {
            "schema_version": SCHEMA_VERSION,
            "plan": self.plan,
            "source": self.source,
            **({"cameras": self.cameras_line} if several else {}),
            "embodiment": self.embodiment.to_dict(),
            "tokenizer": self.tokenizer.to_json(),
            "splits": self.splits,
            "totals": {
                "episodes": self.episodes,
                "frames": sum(split["frames"] for split in self.splits.values()),
                "bytes": sum(shard.bytes for shard in self.shards),
                "quarantined": self.quarantined,
            },
            "stats": self.stats,
            "files": self.files,
            "shards": [asdict(shard) for shard in self.shards],
        }

    def to_text(self) -> str:
        """Return manifest.json, sealed by the sha256 of its text with zeros in place of the seal."""
        values = self.to_json()
        shards = [f"  {json.dumps(shard)}" for shard in values.pop("shards")]
        sealed = {"schema_version": values.pop("schema_version"), "manifest_sha256": _UNSEALED, **values}
        head = json.dumps(sealed, indent=1).removesuffix("\n}")
        text = head + ',\n "shards": [\n' + ",\n".join(shards) + "\n ]\n}\n"
        return text.replace(_UNSEALED, hashlib.sha256(text.encode()).hexdigest(), 1)

    @classmethod
    def load(cls, folder: StrPath) -> "Manifest":
        """Read the manifest of a shard set.

        Args:
            folder: str or path of the set, or its URI.

        Raises:
            ShardError: there is no manifest, or it is damaged.
        """
        folder = place(folder)
        path = folder / MANIFEST
        restat = restat_remedy(folder)
        if not path.is_file():
            if not isinstance(folder, RemotePath) and (found := misplaced(folder, "a shard set")):
                raise ShardError(folder, *found)
            if not folder.is_dir():
                raise ShardError(folder, "is not a folder", "name the --out folder of an hma convert")
            remedy = f"run the same hma convert again to finish it; if the manifest was lost, {restat}"
            raise ShardError(folder, f"has no {MANIFEST}: its conversion has not finished", remedy)
        return cls.from_text(path.read_bytes(), path, restat)

    @classmethod
    def from_text(cls, text: bytes, path: Path, remedy: str) -> "Manifest":
        """Return the manifest of the text that `to_text` wrote.

        Args:
            path, remedy: for the ShardError of a damaged one.
        """
        try:
            values = parse_json(text)
            check_version(values, path)
            manifest = cls(
                plan=values["plan"],
                embodiment=Embodiment.from_values(values["embodiment"], str(path)),
                tokenizer=TokenizerSpec.from_json(values["tokenizer"]),
                shards=tuple(
                    ShardFile(**{**s, "row_groups": tuple(s["row_groups"])}) for s in values["shards"]
                ),
                splits={split: dict(values["splits"][split]) for split in SPLITS},
                stats=values["stats"],
                quarantined=int(values["totals"]["quarantined"]),
                source=str(values["source"]),
                files=dict(values.get("files", {})),
            )
            _ = manifest.layout  # raises if the plan lacks it
            return manifest
        except MALFORMED as fault:
            said = f"it lacks {fault}" if isinstance(fault, KeyError) else str(fault)
            raise ShardError(path, f"is damaged: {said}", remedy) from fault


def cameras_line(stored: Sequence[str], embodiment: Embodiment) -> str:
    """Return such a line: `top; not stored: wrist (use --cameras all)`."""
    left = [camera.name for camera in embodiment.cameras if camera.name not in stored]
    text = ", ".join(stored)
    return f"{text}; not stored: {', '.join(left)} (use --cameras all)" if left else text


def damaged_files(folder: Path, manifest: Manifest) -> list[Path]:
    """Return the derived files that are missing, or whose sha256 is not the one in the manifest."""

    def is_whole(path: Path) -> bool:
        return path.is_file() and file_sha256(path) == manifest.files.get(path.name)

    return [path for name in (EPISODES, QUARANTINE, EMBODIMENT) if not is_whole(path := folder / name)]


def shard_sizes(folder: Path) -> dict[str, int]:
    """Return the bytes of each file in the folders of the splits, by name; leave out unfinished files."""
    if isinstance(folder, RemotePath):
        listed = folder.listing()
    else:
        paths = [path for split in SPLITS for path in folder.glob(f"{split}/[!.]*")]
        listed = {path.relative_to(folder).as_posix(): path.stat().st_size for path in paths}
    return {name: size for name, size in listed.items() if re.match(r"(train|val)/[^.]", name)}


def stored_embodiment(folder: Path) -> Embodiment:
    """Read the embodiment.yaml of a shard set.

    Raises:
        ShardError: it cannot be read.
        RegistryError: it is damaged.
    """
    path = folder / EMBODIMENT
    try:
        text = path.read_text(encoding="utf-8", errors="replace")
    except OSError as fault:
        remedy = "the same hma convert writes it again"
        raise ShardError(path, f"cannot be read: {fault.strerror or fault}", remedy) from fault
    return Embodiment.from_yaml(text, str(path))


def restat_remedy(folder: Path) -> str:
    """Return the command that rebuilds a derived file of a shard set, as a sentence for an error."""
    return f"hma shards restat {quote(str(folder))} rebuilds it from the shards"


def seal_problem(text: bytes) -> str:
    """Return what is wrong with the seal of a manifest's bytes; empty if the seal is right."""
    found = _SEAL.search(text)
    if not found:
        return "it carries no manifest_sha256"
    start, end = found.span(1)
    unsealed = text[:start] + _UNSEALED.encode() + text[end:]
    if hashlib.sha256(unsealed).hexdigest().encode() != found[1]:
        return "its bytes changed since it was written (manifest_sha256 differs)"
    return ""


def digest(value: Any) -> str:
    """Return sixteen hex digits of the SHA-256 of plain values."""
    return digest_of_texts([json.dumps(value, sort_keys=True)])


def digest_of_texts(texts: Iterable[str]) -> str:
    """Return the digest of plain values whose JSON is given in pieces."""
    hashed = hashlib.sha256()
    for text in texts:
        hashed.update(text.encode())
    return hashed.hexdigest()[:16]


def json_list(parts: Iterable[Sequence[Any]]) -> Iterator[str]:
    """Yield the JSON of a long list in pieces; `parts` are lists that follow one another in it."""
    yield "["
    for number, part in enumerate(parts):
        yield ", " * (number > 0) + json.dumps(part)[1:-1]
    yield "]"


def plan_hash(plan: dict[str, Any]) -> str:
    """Return the digest of everything in a plan except its hash."""
    return digest({key: value for key, value in plan.items() if key != "hash"})


def plan_hashes(plan: dict[str, Any]) -> set[str]:
    """Return the hashes of the plans whose shards belong to a set: its own, and those it extends."""
    return {plan["hash"], *plan.get("extends", ())}


@dataclass
class Derived:
    """Everything of a set that is derived from its shards' footers; the footers themselves are not kept.

    Attributes:
        plan, embodiment, source: of the set, as in its manifest.
        shards: as the manifest lists them, in plan order.
        stats: "action" and, if recorded, "state", over train.
        refused: the episodes in quarantine.
    """

    plan: dict[str, Any]
    embodiment: Embodiment
    source: str
    shards: list[ShardFile] = field(default_factory=list)
    stats: dict[str, Stats] = field(default_factory=dict)
    refused: list[Refused] = field(default_factory=list)
    _tables: list[pa.Table] = field(default_factory=list)

    def add(self, shard: ShardFile, footer: Footer) -> None:
        """Add the next shard."""
        self.shards.append(shard)
        self._tables.append(footer.table)
        self.refused += footer.quarantine
        for name, stats in footer.stats.items():
            merged = self.stats.setdefault(name, Stats.empty(len(stats.mean)))
            if footer.split == "train":
                merged.merge(stats)

    @cached_property
    def episodes(self) -> pa.Table:
        """Return the table of episodes.parquet, in order of episode_index."""
        table = pa.concat_tables([schema_of(EpisodeRow).empty_table(), *self._tables])
        source = pc.if_else(pc.equal(table["source"], ""), self.source, table["source"])
        table = table.set_column(table.column_names.index("source"), "source", source)
        order = pa.array(np.argsort(to_numpy(table["episode_index"]), kind="stable"))
        columns = [  # one after the other: taking from many chunks is slow
            table[column.name].combine_chunks().take(order).cast(column.type) for column in _EPISODE_SCHEMA
        ]
        episodes = pa.table(columns, schema=_EPISODE_SCHEMA)
        has_language = pc.any(pc.not_equal(episodes["language"], "")).as_py()
        return episodes if has_language else episodes.drop_columns(["language"])

    @property
    def quarantine(self) -> str:
        """Return the text of quarantine.jsonl, in order of the ids."""
        lines = []
        for item in sorted(self.refused, key=lambda item: item.id):
            values = asdict(item)
            lines.append(json.dumps({"id": values.pop("id"), "uri": self.source, **values}) + "\n")
        return "".join(lines)

    @cached_property
    def manifest(self) -> Manifest:
        """Return the manifest; its `files` are filled in when the other files are written."""
        return Manifest(
            plan=self.plan,
            embodiment=self.embodiment,
            tokenizer=TokenizerSpec.from_json(self.plan["tokenizer"]),
            shards=tuple(self.shards),
            splits={split: self._totals(split) for split in SPLITS},
            stats={name: stats.summary() for name, stats in self.stats.items()},
            quarantined=len(self.refused),
            source=self.source,
        )

    def _totals(self, split: str) -> dict[str, int]:
        rows = self.episodes.filter(pc.equal(self.episodes["split"], split))
        return {
            "episodes": len(rows),
            "frames": pc.sum(rows["length"]).as_py() or 0,
            "rows": pc.sum(rows["rows"]).as_py() or 0,
            "shards": sum(shard.split == split for shard in self.shards),
        }

    def write(self, folder: Path) -> Manifest:
        """Write all files except the shards, the manifest last, and return the manifest."""
        with atomic_path(folder / EPISODES) as part:
            pq.write_table(self.episodes, part, compression="zstd")
        write_atomic(folder / QUARANTINE, self.quarantine)
        write_atomic(folder / EMBODIMENT, self.embodiment.to_yaml())
        files = {name: file_sha256(folder / name) for name in (EPISODES, QUARANTINE, EMBODIMENT)}
        manifest = replace(self.manifest, files=files)
        write_atomic(folder / MANIFEST, manifest.to_text())
        return manifest


def derive(
    folder: Path,
    names: Sequence[str],
    embodiment: Embodiment,
    plan: dict[str, Any],
    source: str,
    hashes: Mapping[str, str] | None = None,
) -> Derived:
    """Derive the other files of a set from its shards; write nothing.

    Args:
        folder: folder of the shard set.
        names: names of the shards, in plan order; all exist.
        source: URI that the recordings came from.
        hashes: sha256 of shards whose sha256 is known, by name; they are not computed again.
    """
    known = hashes or {}
    derived = Derived(plan, embodiment, source)

    def look(name: str) -> tuple[pq.FileMetaData, int, str]:
        path = folder / name
        return read_metadata(path), path.stat().st_size, known.get(name) or file_sha256(path)

    for name, (metadata, size, sha256) in in_order(look, names, HASHERS):
        footer = Footer.from_metadata(metadata.metadata, str(folder / name))
        if footer.plan["hash"] not in plan_hashes(plan):
            theirs = footer.plan["hash"]
            fault = f"was written under the plan {theirs}, the set under {plan['hash']}: two jobs wrote here"
            remedy = "restart one of them with --overwrite, the other with another --out"
            raise ShardError(folder / name, fault, remedy)
        rows = tuple(group_rows(metadata))
        shard = ShardFile(name, footer.split, sum(rows), len(footer.episodes), size, sha256, rows)
        derived.add(shard, footer)
    return derived
