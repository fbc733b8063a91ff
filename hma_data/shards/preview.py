"""Show a shard set: in figures, and as images decoded from its tokens with the actions drawn below.

`describe` needs the manifest and episodes.parquet alone.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from itertools import batched, chain
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc

from hma_data.arrays import Images, Ints
from hma_data.episodes.images import describe_resize, opencv
from hma_data.episodes.sheets import (
    GAP,
    LABEL,
    PAPER,
    fitted,
    grid,
    with_actions,
    write_mp4,
    write_png,
    write_text,
)
from hma_data.errors import HMAError, ShardError, TokenizerError
from hma_data.shards.reader import EpisodeReader, ShardSet
from hma_data.shards.recorded import Recorded
from hma_data.shards.schema import flag_totals, token_column
from hma_data.shards.windows import WINDOW, WindowIndex
from hma_data.sources.common.choice import chosen_ids
from hma_data.sources.common.survey import sampled
from hma_data.storage.paths import StrPath, as_path
from hma_data.tokenizers.base import Tokenizer, full_name, get_tokenizer, reopened

THUMB_SIDE, FILM_SIDE = 144, 256  # pixels of an image in the sheet and in the video
FRAMES_DECODED = 16  # frames decoded at a time


# -- in figures


def describe(folder: StrPath) -> dict[str, Any]:
    """Return plain values for `hma shards info --json`.

    Args:
        folder: str or path of the set, or its URI.

    Raises:
        ShardError: the manifest or episodes.parquet is missing or damaged.
    """
    shards = ShardSet(folder)
    manifest, robot = shards.manifest, shards.embodiment
    values = manifest.to_json()
    totals = values["totals"]
    rows = sum(split["rows"] for split in manifest.splits.values())
    row_hz = robot.rate_hz / manifest.frame_stride
    return {
        "folder": str(shards.folder),
        "embodiment": {
            "id": robot.id,
            "robot": robot.robot,
            "action_dim": robot.action_dim,
            "state_dim": robot.state.dims if robot.state else 0,
            "stride": robot.stride,
            "rows_hz": row_hz,
            "effective_hz": robot.effective_hz,
            "cameras": manifest.cameras,
            "cameras_line": manifest.cameras_line,
        },
        "tokenizer": values["tokenizer"],
        "source": manifest.source,
        "totals": totals | {"hours": totals["frames"] / row_hz / 3600},
        "bytes_per_frame": totals["bytes"] / max(rows, 1),
        "shards": len(manifest.shards),
        "splits": manifest.splits,
        "windows": {
            split: {"windows": index.count, "short_episodes": index.short_episodes}
            for split in manifest.splits
            for index in [WindowIndex.of(shards, split, WINDOW)]
        },
        "episodes": _episodes(shards),
        "names": {"action": robot.action.names(), "state": robot.state.names() if robot.state else []},
        "stats": manifest.stats,
        "plan": manifest.plan,
    }


def _episodes(shards: ShardSet) -> dict[str, Any]:
    table = shards.episodes
    lengths = np.sort(table["length"].to_numpy())
    told = pc.value_counts(table["success"].combine_chunks()).to_pylist()
    success = {item["values"]: item["counts"] for item in told}
    instructed = table["instruction"].filter(pc.not_equal(table["instruction"], ""))
    return {
        "shortest": int(lengths[0]) if len(lengths) else 0,
        "median": float(np.median(lengths)) if len(lengths) else 0.0,
        "longest": int(lengths[-1]) if len(lengths) else 0,
        "with_instruction": len(instructed),
        "instructions": len(instructed.unique()),
        "success": success.get(True, 0),
        "failure": success.get(False, 0),
        "not_told": success.get(None, 0),
        "worst_skew_ms": pc.max(table["skew_max_ms"]).as_py() or 0.0,
        "flags": flag_totals(table["flags"]),
        "quarantine": dict(Counter(str(item.get("type")) for item in shards.refused())),
    }


# -- in images


@dataclass(frozen=True)
class Preview:
    """The files that were written, the ids of the episodes in them, and what became of the frames.

    Attributes:
        resized: a line for each camera whose YAML states its size, see `describe_resize`.
    """

    sheet: Path
    video: Path
    episodes: tuple[str, ...]
    resized: tuple[str, ...] = ()


def tokenizer_of(shards: ShardSet, weights: StrPath | None = None, device: str = "cpu") -> Tokenizer:
    """Return the tokenizer that made a shard set.

    Args:
        weights: str or path, as `get_tokenizer` takes them.

    Raises:
        TokenizerError: the tokenizer on this machine would give other tokens.
    """
    stated = shards.spec.to_json()
    if weights is None:
        tokenizer = reopened(stated, device)
    else:
        tokenizer = get_tokenizer(full_name(stated), weights=weights, device=device)
    if tokenizer.spec != shards.spec:
        made, here = shards.spec.weights_digest, tokenizer.spec.weights_digest
        fault = f"was made by {shards.spec.name} with weights {made}, and the weights here are {here}"
        raise TokenizerError(shards.folder, fault, "give the weights it was made with, or convert again")
    return tokenizer


def preview(
    folder: StrPath,
    out: StrPath,
    *,
    episodes: int = 4,
    columns: int = 8,
    weights: StrPath | None = None,
    camera: str | None = None,
    frames: int = 300,
    tokenizer: Tokenizer | None = None,
    only: Sequence[str] = (),
    exclude: Sequence[str] = (),
    on_progress: Callable[[int, int], None] = lambda done, total: None,
) -> Preview:
    """Write `sheet.png` and `preview.mp4` for episodes spread evenly over a shard set, held-out ones too.

    Recorded frames stand beside those decoded from the tokens where the recording is at hand.

    Args:
        folder: str or path of the set, or its URI.
        out: str or path of the folder to write to.
        weights: str or path, as `get_tokenizer` takes them.
        episodes: number of episodes, evenly spaced from the first to the last; of several, one is held out.
        columns: number of frames of each episode in the sheet.
        camera: name of the camera; None shows all cameras of the set.
        frames: largest number of frames of each episode in the video.
        tokenizer: tokenizer that decodes; None takes the set's own.
        only, exclude: episodes to choose from: ids, globs, or @FILE; see `chosen_ids`.
        on_progress: called with (frames drawn, frames in all) after each frame of the video.

    Raises:
        ShardError: the set holds no episodes.
        UsageError: there is no such camera or no such episode.
    """
    shards, out = ShardSet(folder), as_path(out)
    cameras = [shards.manifest.cameras[shards.camera_index(camera)]] if camera else shards.manifest.cameras
    if not len(shards.episodes):
        raise ShardError(shards.folder, "holds no episodes", "its quarantine.jsonl says why")
    opened = tokenizer or tokenizer_of(shards, weights)
    ids = shards.episodes["id"].to_pylist()
    kept = set(chosen_ids(ids, only, exclude))
    places = np.flatnonzero([name in kept for name in ids])
    picks = places[sampled(len(places), episodes)]
    held_out = places[[shards.episodes["split"][int(i)].as_py() == "val" for i in places]]
    if len(held_out) and len(picks) > 1 and not np.isin(held_out, picks).any():
        picks[-1] = held_out[0]
    rows = shards.episodes.take(picks).to_pylist()
    seen = [_Seen(shards, opened, row, cameras) for row in rows]
    sheet, video = out / "sheet.png", out / "preview.mp4"
    write_png(sheet, np.concatenate([one.sheet(columns) for one in seen]))
    rate = shards.embodiment.rate_hz / shards.manifest.frame_stride
    total = sum(min(row["length"], frames) for row in rows)

    def film() -> Iterator[Images]:
        for done, frame in enumerate(chain.from_iterable(one.film(frames) for one in seen), start=1):
            yield frame
            on_progress(done, total)

    on_progress(0, total)
    write_mp4(video, film(), rate)
    resized = [
        describe_resize(one, *one.size, shards.spec.image_size)
        for one in map(shards.embodiment.camera, cameras)
        if one.size
    ]
    return Preview(sheet, video, tuple(row["id"] for row in rows), tuple(resized))


class _Seen:
    """One episode as some cameras recorded it; tokens are decoded when they are drawn."""

    def __init__(
        self, shards: ShardSet, tokenizer: Tokenizer, row: dict[str, Any], cameras: Sequence[str]
    ) -> None:
        self._shards, self._tokenizer = shards, tokenizer
        reader = EpisodeReader(shards, shards.columns(cameras))
        views = {camera: reader.episode(row, camera) for camera in cameras}
        self._tokens = {camera: view[token_column(shards.spec)[0]] for camera, view in views.items()}
        values = views[cameras[0]]
        self._actions = values["action"][:, : shards.embodiment.action_dim]  # the first action of a chunk
        self._length = row["length"]
        success = {True: "success", False: "failure", None: ""}[row["success"]]
        length = f"{row['length']} frames, {float(values['timestamp'][-1]):.1f} s"
        words = [row["id"], row["split"], length, row["instruction"], success]
        self._recorded: Recorded | None = None
        try:
            self._recorded = Recorded(shards, row)
        except (HMAError, OSError, ImportError):
            words.insert(0, "recording not at hand")
        self.label = "   ".join(word for word in words if word)

    def _images(self, rows: Ints) -> dict[str, Images]:
        """Return what is shown -> images (n, S, S, 3) of some rows, each camera recorded and decoded."""
        found: dict[str, Images] = {}
        for camera, tokens in self._tokens.items():
            named = f"{camera}, " if len(self._tokens) > 1 else ""
            if self._recorded:
                found[f"{named}recorded"] = self._recorded.frames(camera, rows)
            found[f"{named}decoded"] = self._tokenizer.decode(self._shards.tokens(tokens[rows]))
        return found

    def _with_actions(self, images: Images, rows: Ints) -> Images:
        """Return the images (n, H, W, 3) of some rows with their actions as bars below them."""
        stats = self._shards.manifest.stats["action"]
        low, high = np.array(stats["min"]), np.array(stats["max"])
        return with_actions(images, self._actions[rows], low, high, self._shards.embodiment.action.names())

    def sheet(self, columns: int) -> Images:
        """Return (H, W, 3): the label, two rows of frames a camera, and the actions at these frames."""
        picks = np.array(sampled(self._length, columns))
        shown = {name: _resized(images, THUMB_SIDE) for name, images in self._images(picks).items()}
        labels = list(shown)
        labels[0] += f"   {self.label}"
        bars = self._with_actions(np.zeros((len(picks), 0, THUMB_SIDE, 3), np.uint8), picks)
        sheet = np.concatenate([grid([list(view) for view in shown.values()], labels), grid([list(bars)])])
        wider = columns * (THUMB_SIDE + GAP) + GAP - sheet.shape[1]  # where the episode has few frames
        return np.pad(sheet, ((0, 0), (0, wider), (0, 0)), constant_values=PAPER[0])

    def film(self, most: int) -> Iterator[Images]:
        """Yield (H, W, 3) for each frame: the label, its images side by side, and its actions."""
        for some in batched(range(min(self._length, most)), FRAMES_DECODED):
            rows = np.array(some)
            shown = self._images(rows)
            beside = np.concatenate([_resized(images, FILM_SIDE) for images in shown.values()], axis=2)
            bar = np.full((2 * LABEL, beside.shape[2], 3), PAPER, np.uint8)
            write_text(bar, fitted(self.label, beside.shape[2] - 2 * GAP), (GAP, LABEL - 5))
            for place, name in enumerate(shown):
                at = GAP + place * FILM_SIDE, 2 * LABEL - 5
                write_text(bar, fitted(name, FILM_SIDE - 2 * GAP), at)
            for frame in self._with_actions(beside, rows):
                yield np.concatenate([bar, frame])


def _resized(images: Images, side: int) -> Images:
    """Return images (n, H, W, 3) with sides of `side`; enlarged pixels stay sharp."""
    cv2 = opencv()
    way = cv2.INTER_AREA if images.shape[1] >= side else cv2.INTER_NEAREST
    return np.stack([cv2.resize(image, (side, side), interpolation=way) for image in images])
