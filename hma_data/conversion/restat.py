"""Write a shard set's manifest anew from its shards, with statistics recomputed from the rows."""

import json
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pyarrow as pa
import pyarrow.parquet as pq

from hma_data.conversion.output import locked
from hma_data.conversion.plan import digest
from hma_data.errors import HMAError, ShardError
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.manifest import (
    EMBODIMENT,
    EPISODES,
    MANIFEST,
    QUARANTINE,
    SHARD_NAME,
    SPLITS,
    Gathered,
    Manifest,
    derive,
    seal_problem,
    stored_embodiment,
)
from hma_data.shards.schema import Footer, read_footer
from hma_data.shards.verify import REMAKE, check_rows
from hma_data.storage.files import file_sha256
from hma_data.storage.paths import StrPath
from hma_data.storage.remote import parquet_input, place
from hma_data.tokenizers.base import TokenizerSpec

AGAIN = "run the same hma convert again"


def restat(
    folder: StrPath,
    *,
    workers: int | None = None,
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Manifest:
    """Write the manifest and the other derived files from the shards; do not change the shards.

    An undamaged manifest states which shards belong to the set and their hashes. Without one, the shards
    themselves must show that none is missing.

    Args:
        folder: str or path of the set, or its URI.

    Raises:
        ShardError: a shard is missing or damaged, or nothing shows whether all are there; nothing is written.
    """
    folder = place(folder)
    if not folder.is_dir():
        raise ShardError(folder, "is not a folder", "give the --out of an hma convert")
    with locked(folder):
        known = _whole_manifest(folder)
        names, plan, source, embodiment = _as_stated(folder, known) if known else _as_found(folder)
        spec = TokenizerSpec.from_json(plan["tokenizer"])
        derived = derive(folder, names, embodiment, spec, plan, source)
        manifest = derived.manifest
        problems, rows = check_rows(folder, manifest, workers, on_progress)
        if problems:
            more = f", and {len(problems) - 1} more problems" if len(problems) > 1 else ""
            raise ShardError("", problems[0] + more)
        if plan.get("frames") != "strided":  # footers of strided sets also count steps that are not rows
            stats = {name: merged.summary() for name, merged in rows.items()}
            derived = replace(derived, manifest=replace(manifest, stats=stats or manifest.stats))
        return derived.write(folder)


Found = tuple[list[str], dict[str, Any], str, Embodiment]


def _whole_manifest(folder: Path) -> Manifest | None:
    try:
        if seal_problem((folder / MANIFEST).read_bytes()):
            return None
        return Manifest.load(folder)
    except (HMAError, OSError):
        return None


def _as_stated(folder: Path, manifest: Manifest) -> Found:
    for shard in manifest.shards:
        path = folder / shard.path
        if not path.is_file():
            raise ShardError(path, "is missing", AGAIN)
        if file_sha256(path) != shard.sha256:
            raise ShardError(path, "its bytes changed since the manifest was written", REMAKE)
    return [shard.path for shard in manifest.shards], manifest.plan, manifest.source, manifest.embodiment


def _as_found(folder: Path) -> Found:
    """Return what the shards state if there is no manifest to trust."""
    named = [(path, SHARD_NAME.fullmatch(path.relative_to(folder).as_posix())) for path in folder.glob("*/*")]
    order = sorted((SPLITS.index(name[1]), int(name[2]), name[0]) for _, name in named if name)
    names = [name for _, _, name in order]
    if not names:
        raise ShardError(folder, "holds no shards", "give the --out of an hma convert")
    footers = [read_footer(folder / name, str(folder / name))[0] for name in names]
    plan = max((footer.plan for footer in footers), key=lambda plan: len(plan.get("extends", ())))
    belonging = {plan.get("hash"), *plan.get("extends", ())}
    for name, footer in zip(names, footers):
        if footer.plan.get("hash") not in belonging or footer.name != name:
            raise ShardError(folder / name, "is of another conversion than the shards beside it", REMAKE)
    source = _source(folder, footers)
    numbers = [[number for place, number, _ in order if SPLITS[place] == split] for split in SPLITS]
    gapless = all(found == list(range(len(found))) for found in numbers)
    if not gapless or not (_planned(names, footers, plan) or _listed(folder, footers, source)):
        raise ShardError(folder, "nothing tells whether all its shards are there", AGAIN)
    embodiment = stored_embodiment(folder)
    if embodiment.digest != plan.get("embodiment_hash"):
        raise ShardError(folder / EMBODIMENT, "is not the embodiment the shards were made with", AGAIN)
    return names, plan, source, embodiment


def _planned(names: list[str], footers: list[Footer], plan: dict[str, Any]) -> bool:
    """Check whether the episodes are cut into shards as planned; False if one is in quarantine."""
    cut = [(name, [row.episode_index for row in footer.episodes]) for name, footer in zip(names, footers)]
    return plan.get("shards") == digest(cut)


def _listed(folder: Path, footers: list[Footer], source: str) -> bool:
    """Check whether episodes.parquet lists these shards' episodes and no others."""
    gathered = Gathered(source)
    for footer in footers:
        gathered.add(footer)
    try:
        return bool(pq.read_table(parquet_input(folder / EPISODES)).equals(gathered.episodes()))
    except (OSError, pa.ArrowException):
        return False


def _source(folder: Path, footers: list[Footer]) -> str:
    """Return the URI the recordings came from, read from files beside the shards; shards do not state it."""
    own = {row.episode_index for footer in footers for row in footer.episodes if not row.source}
    try:
        for row in pq.read_table(
            parquet_input(folder / EPISODES), columns=["episode_index", "source"]
        ).to_pylist():
            if row["episode_index"] in own:
                return str(row["source"])
    except (OSError, pa.ArrowException):
        pass
    try:
        for line in (folder / QUARANTINE).read_text(encoding="utf-8").splitlines():
            return str(json.loads(line)["uri"])
    except (OSError, ValueError, KeyError, TypeError):
        pass
    return "unknown"
