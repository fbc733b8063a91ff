"""Add episodes to a finished shard set: its shards stay as they are, new shards come after them.

The extended plan lists the hashes of the plans before it (`extends`). New shards carry the hash of the
extended plan.

A file that holds several episodes changes when one is added. That does not tell whether the other episodes
changed; the hash of each episode's content does. A worker notes it before it tokenizes the episode. It covers
all numbers, times and texts, and three frames a camera.
"""

import hashlib
import json
import logging
from collections.abc import Callable, Iterator, Sequence
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.compute as pc

from hma_data.arrays import Array, Images, Ints
from hma_data.conversion.plan import (
    Plan,
    ShardUnit,
    cut_json,
    differences,
    pack,
    read_clip,
    recording_json,
    shard_size,
)
from hma_data.episodes.episode import Clip
from hma_data.episodes.images import prepared
from hma_data.errors import EpisodeError, OutputError
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.manifest import (
    SPLITS,
    Manifest,
    derive,
    digest_of_texts,
    shard_sizes,
)
from hma_data.shards.schema import RowLayout, to_numpy
from hma_data.sources.base import EpisodeRef, Source
from hma_data.storage.records import Records, with_columns

log = logging.getLogger(__name__)

_OF_THE_CUT = ("recording", "shards", "hash", "extends")


def ways(facts: dict[str, Any]) -> dict[str, Any]:
    """Return the facts that a set and its extension share; the episodes and --shard-frames may differ."""
    ways = {key: value for key, value in facts.items() if key not in _OF_THE_CUT}
    free = ("limit", "shard_frames", "only", "exclude")
    return ways | {"settings": {key: value for key, value in ways["settings"].items() if key not in free}}


def extended(
    out: Path, base: Manifest, plan: Plan, shard_frames: int | None, content: Callable[[EpisodeRef], str]
) -> Plan:
    """Return the plan of `base` with the episodes that are new in `plan`.

    Args:
        out: the shard set.
        base: its manifest.
        plan: of the recordings as they are now, made as for an empty folder.
        shard_frames: frames a shard, about.
        content: returns the hash of an episode as it is recorded now, see `content_of`. It is called where
            the fingerprint differs, as when a file has grown.

    Returns:
        a plan whose units are the new shards alone; where there are none, its facts are those of `base`.
    """
    sizes = shard_sizes(out)
    for shard in base.shards:
        if sizes.get(shard.path) != shard.bytes:
            fault = f"is missing, or does not have the {shard.bytes:,} bytes of the manifest"
            remedy = "restore it from a copy, or start over with --overwrite"
            raise OutputError(out / shard.path, fault, remedy)
    if ways(plan.facts) != ways(base.plan):
        fault = f"cannot be extended; different: {differences(plan.facts, base.plan)}"
        raise OutputError(out, fault, "convert with the same settings, or choose another --out")
    hashes = {shard.path: shard.sha256 for shard in base.shards}
    there = derive(out, list(hashes), base.embodiment, base.plan, base.source, hashes)
    known = there.episodes.select(["id", "fingerprint", "content"])
    refused = pa.array([item.id for item in there.refused], pa.string())
    now = plan.table()
    place = pc.index_in(now["id"], known["id"])  # null for episodes that the set does not have
    other = now.filter(pc.not_equal(now["fingerprint"], known["fingerprint"].take(place)))
    before = known.filter(pc.is_in(known["id"], other["id"].combine_chunks()))
    contents = dict(zip(before["id"].to_pylist(), before["content"].to_pylist()))
    _refuse_changed(out, Records(EpisodeRef, other), contents, content)
    new = now.filter(pc.and_not(pc.is_null(place), pc.is_in(now["id"], refused)))
    if not len(new):
        return Plan((), base.plan)
    # The rest of a recording of which the set has a part, as with --limit, goes into the same split.
    parts = there.episodes.filter(pc.not_equal(there.episodes["group"], ""))
    theirs = parts["split"].take(pc.index_in(new["group"], parts["group"]))
    new = with_columns(new, split=pc.coalesce(theirs, new["split"]))
    return _with(base, Records(EpisodeRef, new), len(known) + len(refused), shard_frames)


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

    if refs:
        log.info("%s: a file has changed; rereading %s known episodes", out, f"{len(refs):,}")
    if changed := [ref.id for ref in refs if is_changed(ref)]:
        fault = f"cannot be extended: {len(changed):,} of its episodes were re-recorded, first {changed[0]!r}"
        raise OutputError(out, fault, "--overwrite to start over, or give the new episodes other names")


def _with(base: Manifest, new: Records[EpisodeRef], first: int, shard_frames: int | None) -> Plan:
    target = shard_frames or shard_size(int(to_numpy(new.column("frames")).sum()))
    units: list[ShardUnit] = []
    for split in SPLITS:
        begun = sum(shard.split == split for shard in base.shards)
        mine = np.flatnonzero(to_numpy(pc.equal(new.column("split"), split)))
        units += pack(split, first + mine, new.take(mine), target, begun)
    facts = {key: value for key, value in base.plan.items() if key not in ("hash", "extends")}
    facts |= {
        "extends": [*base.plan.get("extends", ()), base.plan["hash"]],
        "recording": _digest_after(base.plan["recording"], recording_json(new.table)),
        "shards": _digest_after(base.plan["shards"], cut_json(units)),
    }
    return Plan.of(units, facts)


def _digest_after(earlier: str, pieces: Iterator[str]) -> str:
    """Return the digest of [earlier, list], of the pieces of the list's JSON."""
    return digest_of_texts(chain([f"[{json.dumps(earlier)}, "], pieces, ["]"]))


# -- the hash of an episode


class Content:
    """The hash of an episode; the caller adds the frames of each camera in their order.

    Args:
        kept: (N,) frames of the clip that become rows of a camera.
    """

    def __init__(self, clip: Clip, kept: Ints) -> None:
        self._digest = hashlib.sha256(f"{clip.episode.instruction}\n{clip.episode.success}".encode())
        for numbers in (clip.timestamps, clip.actions, clip.states, clip.action_known, clip.state_known):
            self._add(numbers)
        self._looked_at = looked_at(len(kept))
        self._seen: dict[str, list[Images]] = {}  # camera -> its frames that are hashed

    def add(self, camera: str, start: int, frames: Images) -> None:
        """Add the next frames (n, H, W, 3) of a camera; the first of them is its row `start`."""
        seen = self._seen.setdefault(camera, [])
        seen += [frames[row - start].copy() for row in self._looked_at if start <= row < start + len(frames)]

    def text(self) -> str:
        """Return the hash as sixteen hex digits; cameras count in the order in which they came first."""
        for frame in chain(*self._seen.values()):
            self._add(frame)
        return self._digest.hexdigest()[:16]

    def _add(self, numbers: Array | None) -> None:
        if numbers is None:
            self._digest.update(b"none")
        else:
            self._digest.update(f"{numbers.dtype} {numbers.shape}".encode())
            self._digest.update(np.ascontiguousarray(numbers).data)


def looked_at(rows: int) -> list[int]:
    """Return the rows of a camera whose frames are hashed: the first, the middle and the last."""
    return sorted({0, rows // 2, rows - 1})


def kept_frames(clip: Clip, layout: RowLayout) -> Ints:
    """Return the frames (N,) of the clip that become rows of a camera."""
    kept = layout.kept(len(clip))
    if not len(kept):
        fault = f"has {len(clip)} frames, fewer than one stride of {layout.frame_stride}"
        raise EpisodeError(clip.episode.id, fault)
    return kept


def content_of(
    source: Source, uri: str, episode_id: str, embodiment: Embodiment, facts: dict[str, Any]
) -> str:
    """Return the hash of an episode as it is recorded now; see `Content`.

    Args:
        facts: of the plan: which cameras and frames, and the tokenizer's spec.
    """
    layout = RowLayout.of_plan(facts, embodiment)
    spec = layout.tokenizer
    clip = read_clip(source, uri, episode_id, embodiment, layout.cameras)
    kept = kept_frames(clip, layout)
    content = Content(clip, kept)
    for name in layout.cameras:
        for row in looked_at(len(kept)):
            indices = clip.frame_indices[name][kept[row : row + 1]]
            camera, stream = embodiment.camera(name), clip.episode.streams[name]
            content.add(name, row, prepared(stream, indices, camera, spec.image_size, spec.resize_filter))
    return content.text()
