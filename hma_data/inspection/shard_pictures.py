"""Find the episodes of a shard set whose pictures show nothing: one colour, or one picture throughout.

The tokens show whether a picture changes. They do not show whether it is of one colour: a tokenizer gives the
noise of a covered camera many tokens, and the border of a black picture others than its middle. Therefore a
few pictures are decoded, of the episodes with the least variety first, until some in a row are not blank.

N rows of an episode and camera, S values of a row.
"""

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.images import PictureCheck
from hma_data.errors import HMAError
from hma_data.shards.preview import tokenizer_of
from hma_data.shards.reader import EpisodeReader, ShardSet
from hma_data.shards.schema import token_column
from hma_data.sources.common.checks import Finding
from hma_data.sources.common.survey import listed

LOOKED_AT = 8  # rows of an episode, evenly spaced, that tell its variety; every other one is decoded
CHANGED = 0.01  # share of the tokens, or of the latents' spread, by which the rows of a still episode differ
PATIENCE = 4  # episodes in a row that are not blank, before the search for blank ones ends
BLANK = 12  # levels; more than at a conversion, as decoding adds an error (a scene at 1/16 exposure has 18)


@dataclass(frozen=True, eq=False)
class _Camera:
    """One camera of one episode.

    Attributes:
        variety: how much the pictures contain: the share of different tokens, or the spread of the latents.
        still: whether the rows are equal, up to CHANGED.
    """

    episode: dict[str, Any]
    name: str
    variety: float
    still: bool


def shard_picture_findings(shards: ShardSet) -> Iterator[Finding]:
    """Yield a finding for each camera with blank or still episodes; it names the episodes."""
    seen = list(_cameras(shards))
    blank = set(_blank(shards, seen))
    for name in shards.manifest.cameras:
        own = [one for one in seen if one.name == name]
        black = [one.episode for one in own if one in blank]
        still = [one.episode for one in own if one.still and one not in blank]
        if black:
            meant = shards.embodiment.quality.blank == "flag"
            remedy = "hma convert --overwrite refuses them now, and --exclude leaves them out"
            if meant:
                remedy = "the YAML keeps them: quality.blank is flag"
            said = _said(shards, black, f"camera {name} shows one colour")
            yield Finding("blank", "warn" if meant else "error", said, remedy, name, _numbers(shards, black))
        if still:
            said = _said(shards, still, f"camera {name} shows one picture")
            remedy = "look at them with hma shards preview --only ID; hma convert --exclude leaves them out"
            yield Finding("still", "warn", said, remedy, name, _numbers(shards, still))


def _cameras(shards: ShardSet) -> Iterator[_Camera]:
    reader = _reader(shards)
    table = shards.episodes.sort_by([("shard", "ascending"), ("row_start", "ascending")])
    for episode in table.select(["id", "split", "shard", "row_start", "length"]).to_pylist():
        for name in shards.manifest.cameras:
            rows = _rows(shards, reader, episode, name)
            some = rows[_looked_at(len(rows))]
            if shards.spec.kind == "discrete":
                variety = len(np.unique(some)) / some.shape[1]
                still = float((rows != rows[0]).mean()) <= CHANGED
            else:
                variety = float(some.std(dtype=np.float64))
                still = float(np.abs(rows - rows[0]).mean(dtype=np.float64)) <= CHANGED * variety
            yield _Camera(episode, name, variety, still and len(rows) > 1)


def _reader(shards: ShardSet) -> EpisodeReader:
    return EpisodeReader(shards, sorted(set(shards.manifest.layout.token_columns.values())))


def _rows(shards: ShardSet, reader: EpisodeReader, episode: dict[str, Any], camera: str) -> NDArray[Any]:
    """Return the tokens or latents (N, S) of a camera."""
    return reader.episode(episode, camera)[token_column(shards.spec)[0]]


def _looked_at(length: int) -> NDArray[np.int64]:
    return np.linspace(0, length - 1, min(LOOKED_AT, length)).astype(np.int64)


def _blank(shards: ShardSet, seen: Sequence[_Camera]) -> list[_Camera]:
    """Return the blank ones; none where the tokenizer's weights are not on this machine."""
    ordered = sorted(seen, key=lambda one: one.variety)
    if shards.spec.kind == "discrete":
        ordered = [one for one in ordered if one.variety < 0.5]  # spares the import of the network
    if not ordered:
        return []
    try:
        tokenizer = tokenizer_of(shards)
    except HMAError:
        return []
    reader = _reader(shards)
    found: list[_Camera] = []
    misses = 0
    for one in ordered:
        rows = _rows(shards, reader, one.episode, one.name)
        check = PictureCheck()
        check.add(tokenizer.decode(shards.tokens(rows[_looked_at(len(rows))[::2]])))
        if check.contrast <= BLANK and len(rows) > 1:
            found.append(one)
            misses = 0
        elif (misses := misses + 1) == PATIENCE:
            break
    return found


def _said(shards: ShardSet, episodes: Sequence[dict[str, Any]], what: str) -> str:
    share = _numbers(shards, episodes)["train_share"]
    ids = listed([episode["id"] for episode in episodes])
    count = f"{len(episodes):,} of {len(shards.episodes):,} episodes"
    return f"{what} throughout in {count}, {share:.1%} of the training frames: {ids}"


def _numbers(shards: ShardSet, episodes: Sequence[dict[str, Any]]) -> dict[str, Any]:
    train = sum(episode["length"] for episode in episodes if episode["split"] == "train")
    total = shards.manifest.splits["train"]["frames"]
    return {"episodes": [episode["id"] for episode in episodes], "train_share": train / max(total, 1)}
