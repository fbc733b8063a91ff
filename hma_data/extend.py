"""Adding episodes to a finished shard set: its shards stay as they are, the new ones come after them.

The extended plan knows the hashes of the plans before it (`extends`), and new shards carry its own.
"""

import json
from pathlib import Path
from typing import Any

import pyarrow.parquet as pq

from hma_data.errors import OutputError
from hma_data.plan import Plan, ShardUnit, differences, digest, pack, shard_size
from hma_data.shards.manifest import EPISODES, QUARANTINE, Manifest
from hma_data.sources.base import EpisodeRef
from hma_data.store import parquet_input

_OF_THE_CUT = ("recording", "shards", "hash", "extends")


def hashes(facts: dict[str, Any]) -> set[str]:
    """The plans whose shards belong to a set: its own, and those it extends."""
    return {facts["hash"], *facts.get("extends", ())}


def extended(out: Path, base: Manifest, plan: Plan, shard_frames: int | None) -> Plan:
    """The plan of `base` with the episodes that are new in `plan`.

    Args:
        out: the shard set.
        base: its manifest.
        plan: of the recordings as they are now, made as for an empty folder.
        shard_frames: about how many frames a shard.

    Returns:
        a plan whose units are the new shards alone; without any, its facts are those of `base`.

    Raises:
        OutputError: the set was made in another way, or an episode of it has changed since.
    """
    here, there = ways(plan.facts), ways(base.plan)
    if here != there:
        raise OutputError(
            out,
            f"cannot be extended; different: {differences(plan.facts, base.plan)}",
            "convert with the same settings, or choose another --out",
        )
    known = pq.read_table(parquet_input(out / EPISODES), columns=["id", "fingerprint", "split"]).to_pydict()
    fingerprints = dict(zip(known["id"], known["fingerprint"], strict=True))
    refused = {json.loads(line)["id"] for line in (out / QUARANTINE).read_text("utf-8").splitlines()}
    placed = ((index, ref, unit.split) for unit in plan.units for index, ref in unit.episodes)
    now = [(ref, split) for _, ref, split in sorted(placed, key=lambda item: item[0])]
    changed = [ref.id for ref, _ in now if fingerprints.get(ref.id, ref.fingerprint) != ref.fingerprint]
    if changed:
        raise OutputError(
            out,
            f"cannot be extended: {len(changed):,} of its episodes were recorded anew, first {changed[0]!r}",
            "--overwrite to start anew, or give the new episodes other names",
        )
    new = [(ref, split) for ref, split in now if ref.id not in fingerprints and ref.id not in refused]
    if not new:
        return Plan((), base.plan)
    return _with(base, new, len(fingerprints) + len(refused), shard_frames)


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
    """What must not differ between a set and what extends it; --limit and the like may."""
    ways = {key: value for key, value in facts.items() if key not in _OF_THE_CUT}
    settings = ways["settings"]
    free = ("limit", "shard_frames")
    return ways | {"settings": {key: value for key, value in settings.items() if key not in free}}
