"""Show a shard set: in figures, and as images decoded from its tokens with the actions drawn as curves.

`describe` needs the manifest and episodes.parquet alone. T rows of an episode, A values of an action.
"""

from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow.compute as pc
from numpy.typing import NDArray

from hma_data.episodes.images import describe_resize, opencv
from hma_data.episodes.sheets import (
    INK,
    PAPER,
    Images,
    fitted,
    fitted_names,
    text_width,
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
from hma_data.tokenizers.base import Tokenizer, get_tokenizer

THUMB_SIDE, GAP, LABEL_HEIGHT, STRIP_HEIGHT, FILM_SIDE = (
    144,
    4,
    18,
    22,
    256,
)  # pixels; STRIP_HEIGHT is the height of a strip in the sheet
FRAMES_DECODED = 16  # frames decoded at a time
LINE_COLOUR, CURSOR_COLOUR, ZERO_COLOUR, UNKNOWN_COLOUR = (
    (0, 114, 178),
    (213, 94, 0),
    (200, 200, 200),
    (225, 225, 225),
)
MOST_STRIPS = 16  # strips; of further values only the number is shown
LABELS_WIDTH, NAMES_WIDTH, FOOT_HEIGHT = (
    240,
    120,
    16,
)  # pixels left of the strips, of the names in them, and below the strips
CURVES_WIDER = 232  # pixels by which the curves of the video are wider than its frame
TEXT_SCALE = 0.36  # scale of the text beside the strips


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


# -- actions as curves


@dataclass(frozen=True)
class Curves:
    """The actions of one episode, and how to draw them.

    Attributes:
        values: (T, A).
        known: (T,) bool, or None.
        low, high: (A,) range of each value, over the whole set.
        names: A names.
        seconds: time from the first row to the last.
        width, height: size of the image in pixels.
    """

    values: NDArray[np.float32]
    known: NDArray[np.bool_] | None
    low: NDArray[np.float64]
    high: NDArray[np.float64]
    names: list[str]
    seconds: float
    width: int
    height: int

    @cached_property
    def panel(self) -> Images:
        """Draw all curves without a cursor; (height, width, 3)."""
        image = np.full((self.height, self.width, 3), PAPER, np.uint8)
        shown = min(self.values.shape[1], MOST_STRIPS)
        rest = self.values.shape[1] - shown
        tall = (self.height - FOOT_HEIGHT) // max(shown, 1)
        for dim in range(shown):
            self._strip(image, dim, dim * tall, tall)
        text = f"0 to {self.seconds:.1f} s" + (f", {rest} more values" if rest else "")
        write_text(image, text, (LABELS_WIDTH, self.height - 4), TEXT_SCALE)
        return image

    def at(self, row: int) -> Images:
        """Return the panel with a cursor at a row."""
        image = self.panel.copy()
        x = self._x(np.array([row]))[0]
        image[: self.height - FOOT_HEIGHT, max(x - 1, 0) : x + 1] = CURSOR_COLOUR
        return image

    def marked(self, rows: NDArray[np.int64]) -> Images:
        """Return the panel with a tick below each of these rows."""
        image = self.panel.copy()
        for x in self._x(rows):
            image[self.height - FOOT_HEIGHT - 2 : self.height - FOOT_HEIGHT + 3, x - 1 : x + 2] = (
                CURSOR_COLOUR
            )
        return image

    def _x(self, rows: NDArray[np.int64]) -> NDArray[np.int64]:
        last = max(len(self.values) - 1, 1)
        return (LABELS_WIDTH + rows / last * (self.width - LABELS_WIDTH - 6)).round().astype(np.int64)

    def _strip(self, image: Images, dim: int, top: int, tall: int) -> None:
        cv2 = opencv()
        inner = max(tall - 5, 3)
        span = self.high[dim] - self.low[dim]
        scale = 1 / span if span > 0 else 0.0

        def y(values: NDArray[np.floating]) -> NDArray[np.int64]:
            share = np.clip((values - self.low[dim]) * scale, 0, 1) if span > 0 else np.full(len(values), 0.5)
            return (top + 2 + (1 - share) * inner).round().astype(np.int64)

        x = self._x(np.arange(len(self.values)))
        if self.known is not None:
            for at in x[~self.known]:
                image[top + 2 : top + 3 + inner, max(at - 1, 0) : at + 2] = UNKNOWN_COLOUR
        if self.low[dim] <= 0 <= self.high[dim]:
            image[y(np.zeros(1))[0], LABELS_WIDTH : self.width - 6] = ZERO_COLOUR
        points = np.stack([x, y(self.values[:, dim])], axis=1).astype(np.int32).reshape(-1, 1, 2)
        cv2.polylines(image, [points], False, LINE_COLOUR, 1, cv2.LINE_AA)
        image[top + 2 : top + 3 + inner, LABELS_WIDTH - 1] = INK
        if tall >= 10:
            height = top + tall // 2 + 4
            limits = f"{self.low[dim]:.2g} to {self.high[dim]:.2g}"
            write_text(image, self._names[dim], (4, height), TEXT_SCALE)
            write_text(image, limits, (LABELS_WIDTH - 6 - text_width(limits, TEXT_SCALE), height), TEXT_SCALE)

    @cached_property
    def _names(self) -> list[str]:
        return fitted_names(self.names[:MOST_STRIPS], NAMES_WIDTH - 8, TEXT_SCALE)


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
    tokenizer = get_tokenizer(shards.spec.name, weights=weights, device=device)
    if tokenizer.spec != shards.spec:
        made, here = shards.spec.weights_sha256[:12], tokenizer.spec.weights_sha256[:12]
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
        drawn = (frame for one in seen for frame in one.film(frames))
        for done, frame in enumerate(drawn, start=1):
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
        self._known = values.get("action_known")
        self._seconds = float(values["timestamp"][-1])
        self._length = row["length"]
        success = {True: "success", False: "failure", None: ""}[row["success"]]
        length = f"{row['length']} frames, {self._seconds:.1f} s"
        words = [row["id"], row["split"], length, row["instruction"], success]
        self._recorded: Recorded | None = None
        try:
            self._recorded = Recorded(shards, row)
        except (HMAError, OSError, ImportError):
            words.insert(0, "recording not at hand")
        self.label = "   ".join(word for word in words if word)

    def _images(self, rows: NDArray[np.int64]) -> dict[str, Images]:
        """Return what is shown -> images (n, S, S, 3) of some rows, each camera recorded and decoded."""
        found: dict[str, Images] = {}
        for camera, tokens in self._tokens.items():
            named = f"{camera}, " if len(self._tokens) > 1 else ""
            if self._recorded:
                found[f"{named}recorded"] = self._recorded.frames(camera, rows)
            found[f"{named}decoded"] = self._tokenizer.decode(self._shards.tokens(tokens[rows]))
        return found

    def _curves(self, width: int, height: int) -> Curves:
        stats = self._shards.manifest.stats["action"]
        low, high = np.array(stats["min"]), np.array(stats["max"])
        names = self._shards.embodiment.action.names()
        known = self._known
        return Curves(self._actions, known, low, high, names, self._seconds, width, height)

    def sheet(self, columns: int) -> Images:
        """Return (H, W, 3): the label, two rows of frames a camera, and the actions of the whole episode."""
        picks = np.unique(np.linspace(0, self._length - 1, columns).astype(int))
        width = columns * (THUMB_SIDE + GAP) + GAP
        shown = min(self._actions.shape[1], 16)
        curves = self._curves(width, 16 + max(shown * STRIP_HEIGHT, 40))
        strips = []
        for number, (name, images) in enumerate(self._images(picks).items()):
            strip = np.full((LABEL_HEIGHT + THUMB_SIDE + GAP, width, 3), PAPER, np.uint8)
            words = "   ".join([name, *([] if number else [self.label])])
            write_text(strip, fitted(words, width - 2 * GAP), (GAP, LABEL_HEIGHT - 5))
            for place, image in enumerate(images):
                left = GAP + place * (THUMB_SIDE + GAP)
                strip[LABEL_HEIGHT : LABEL_HEIGHT + THUMB_SIDE, left : left + THUMB_SIDE] = _resized(
                    image, THUMB_SIDE
                )
            strips.append(strip)
        return np.concatenate([*strips, curves.marked(picks), np.full((2, width, 3), INK, np.uint8)])

    def film(self, most: int) -> Iterator[Images]:
        """Yield (H, W, 3) for each frame: its images, and the actions with a cursor at its time."""
        curves = self._curves(FILM_SIDE + CURVES_WIDER, FILM_SIDE)
        for start in range(0, min(self._length, most), FRAMES_DECODED):
            rows = np.arange(start, min(start + FRAMES_DECODED, self._length, most))
            shown = self._images(rows)
            for row, *images in zip(rows, *shown.values()):
                parts = [*(_resized(image, FILM_SIDE) for image in images), curves.at(int(row))]
                film = np.concatenate(parts, axis=1)
                bar = np.full((2 * LABEL_HEIGHT, film.shape[1], 3), PAPER, np.uint8)
                write_text(bar, fitted(self.label, film.shape[1] - 2 * GAP), (GAP, LABEL_HEIGHT - 5))
                for place, name in enumerate(shown):
                    write_text(
                        bar,
                        fitted(name, FILM_SIDE - 2 * GAP),
                        (GAP + place * FILM_SIDE, 2 * LABEL_HEIGHT - 5),
                    )
                yield np.concatenate([bar, film])


def _resized(image: Images, side: int) -> Images:
    cv2 = opencv()
    way = cv2.INTER_AREA if image.shape[0] >= side else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(image, (side, side), interpolation=way), np.uint8)
