"""Add episodes to a finished shard set: its shards stay as they are, new shards come after them.

The extended plan lists the hashes of the plans before it (`extends`). New shards carry the hash of the
extended plan.
"""

import json
import logging
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

from hma_data.conversion.plan import Plan, ShardUnit, differences, digest, pack, shard_size
from hma_data.errors import EpisodeError, OutputError
from hma_data.shards.manifest import EPISODES, QUARANTINE, Manifest, damaged_files
from hma_data.sources.base import EpisodeRef
from hma_data.storage.remote import RemotePath, parquet_file

log = logging.getLogger(__name__)

_OF_THE_CUT = ("recording", "shards", "hash", "extends")


def hashes(facts: dict[str, Any]) -> set[str]:
    """Return the hashes of the plans whose shards belong to a set: its own, and those it extends."""
    return {facts["hash"], *facts.get("extends", ())}


def extended(
    out: Path,
    base: Manifest,
    plan: Plan,
    shard_frames: int | None,
    content: Callable[[EpisodeRef], str],
) -> Plan:
    """Return the plan of `base` with the episodes that are new in `plan`.

    Args:
        out: the shard set.
        base: its manifest.
        plan: of the recordings as they are now, made as for an empty folder.
        shard_frames: frames a shard, about.
        content: returns the hash of an episode as it is recorded now; see
            `hma_data.conversion.episode_hash`. It is called where the fingerprint differs, as when a
            file has grown.

    Returns:
        a plan whose units are the new shards alone; where there are none, its facts are those of `base`.

    Raises:
        OutputError: the set was made in another way or lacks something, or one of its episodes has changed.
    """
    _refuse_damaged(out, base)
    here, there = ways(plan.facts), ways(base.plan)
    if here != there:
        raise OutputError(
            out,
            f"cannot be extended; different: {differences(plan.facts, base.plan)}",
            "convert with the same settings, or choose another --out",
        )
    fingerprints, contents = _known(out)
    refused = {json.loads(line)["id"] for line in (out / QUARANTINE).read_text("utf-8").splitlines()}
    placed = ((index, ref, unit.split) for unit in plan.units for index, ref in unit.episodes)
    now = [(ref, split) for _, ref, split in sorted(placed, key=lambda item: item[0])]
    other = [ref for ref, _ in now if fingerprints.get(ref.id, ref.fingerprint) != ref.fingerprint]
    _refuse_changed(out, other, contents, content)
    new = [(ref, split) for ref, split in now if ref.id not in fingerprints and ref.id not in refused]
    if not new:
        return Plan((), base.plan)
    return _with(base, new, len(fingerprints) + len(refused), shard_frames)


def _refuse_damaged(out: Path, base: Manifest) -> None:
    """Raise OutputError unless all shards have their size and the derived files have their bytes."""
    sizes = out.listing() if isinstance(out, RemotePath) else None
    for shard in base.shards:
        path = out / shard.path
        size = _size(path) if sizes is None else sizes.get(shard.path, -1)
        if size != shard.bytes:
            fault = "is missing" if size < 0 else f"has {size:,} bytes, the manifest says {shard.bytes:,}"
            remedy = "without --extend it is made again, if it is deleted and the recordings are as they were"
            if "extends" in base.plan:
                remedy = "put back a copy of it, or --overwrite to start anew"
            raise OutputError(path, fault, remedy)
    damaged = damaged_files(out, base)
    if damaged:
        remedy = f"hma shards restat {out} writes it anew from the shards"
        raise OutputError(damaged[0], "is missing, or changed since the manifest was written", remedy)


def _size(path: Path) -> int:
    """Return the bytes of a local file; -1 where there is none."""
    return path.stat().st_size if path.is_file() else -1


def _known(out: Path) -> tuple[dict[str, str], dict[str, str]]:
    """Return id -> fingerprint and id -> content of a set's episodes; older sets state no contents."""
    file = parquet_file(out / EPISODES)
    names = [name for name in ("id", "fingerprint", "content") if name in file.schema_arrow.names]
    known = file.read(columns=names).to_pydict()
    fingerprints = dict(zip(known["id"], known["fingerprint"], strict=True))
    return fingerprints, dict(zip(known["id"], known.get("content", ())))


def _refuse_changed(
    out: Path, refs: Sequence[EpisodeRef], contents: dict[str, str], content: Callable[[EpisodeRef], str]
) -> None:
    """Raise OutputError unless all episodes whose files have changed still have the same content."""

    def is_changed(ref: EpisodeRef) -> bool:
        try:
            return content(ref) != contents[ref.id]
        except EpisodeError as fault:
            log.info("%s", fault)
            return True

    unknown = [ref.id for ref in refs if not contents.get(ref.id)]
    if refs and not unknown:
        log.info("%s: a file has changed; %s known episodes are looked at", out, f"{len(refs):,}")
    changed = unknown or [ref.id for ref in refs if is_changed(ref)]
    if changed:
        what = "of its episodes were recorded anew"
        if unknown:
            what = "of its episodes lie in files that have changed, and it does not say what they held"
        raise OutputError(
            out,
            f"cannot be extended: {len(changed):,} {what}, first {changed[0]!r}",
            "--overwrite to start anew, or give the new episodes other names",
        )


def _with(base: Manifest, new: list[tuple[EpisodeRef, str]], first: int, shard_frames: int | None) -> Plan:
    target = shard_frames or shard_size(sum(ref.frames for ref, _ in new))
    numbered = [(first + i, ref, split) for i, (ref, split) in enumerate(new)]
    units: list[ShardUnit] = []
    for split in ("train", "val"):
        begun = sum(shard.split == split for shard in base.shards)
        mine = [(i, ref) for i, ref, its in numbered if its == split]
        units += pack(split, mine, target, begun)
    facts = {key: value for key, value in base.plan.items() if key not in ("hash", "extends")}
    facts |= {
        "extends": [*base.plan.get("extends", ()), base.plan["hash"]],
        "recording": digest([base.plan["recording"], [(ref.id, ref.fingerprint) for ref, _ in new]]),
        "shards": digest([base.plan["shards"], [(u.name, [i for i, _ in u.episodes]) for u in units]]),
    }
    return Plan(tuple(units), {**facts, "hash": digest(facts)})


def ways(facts: dict[str, Any]) -> dict[str, Any]:
    """Return the facts that a set and its extension must share; --limit and --shard-frames may differ."""
    ways = {key: value for key, value in facts.items() if key not in _OF_THE_CUT}
    settings = ways["settings"]
    free = ("limit", "shard_frames")
    return ways | {"settings": {key: value for key, value in settings.items() if key not in free}}
