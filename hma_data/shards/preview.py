"""Show a shard set: decode pictures from its tokens and draw the actions as curves."""

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.images import opencv
from hma_data.episodes.sheets import INK, PAPER, Images, write_mp4, write_png, write_text
from hma_data.errors import ShardError, TokenizerError, UsageError
from hma_data.shards.curves import Curves
from hma_data.shards.reader import ShardSet
from hma_data.shards.schema import mask_columns, token_column
from hma_data.storage.paths import StrPath, as_path
from hma_data.tokenizers.base import Tokenizer, get_tokenizer

THUMB, GAP, LABEL, STRIPS, FILM = 144, 4, 18, 22, 256  # pixels; STRIPS is the height of a strip in the sheet
DECODED = 16  # frames decoded at a time


@dataclass(frozen=True)
class Preview:
    """The files that were written, and the ids of the episodes in them."""

    sheet: Path
    video: Path
    episodes: tuple[str, ...]


def tokenizer_of(shards: ShardSet, weights: StrPath | None = None, device: str = "cpu") -> Tokenizer:
    """Return the tokenizer that made a shard set.

    Args:
        weights: str or path, as `get_tokenizer` takes them.

    Raises:
        TokenizerError: the tokenizer on this machine would give other tokens.
    """
    tokenizer = get_tokenizer(shards.spec.name, weights=weights, device=device)
    if tokenizer.spec != shards.spec:
        raise TokenizerError(
            shards.folder,
            f"was made by {shards.spec.name} with weights {shards.spec.weights_sha256[:12]}, here are "
            f"{tokenizer.spec.weights_sha256[:12]}",
            "give the weights it was made with, or convert again",
        )
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
) -> Preview:
    """Write `sheet.png` and `preview.mp4` for episodes spread evenly over a shard set.

    Args:
        folder: str or path of the set, or its URI.
        out: str or path of the folder to write to.
        weights: str or path, as `get_tokenizer` takes them.
        episodes: number of episodes, evenly spaced from the first to the last.
        columns: number of pictures of each episode in the sheet.
        camera: name of the camera; None takes the first.
        frames: largest number of frames of each episode in the video.
        tokenizer: tokenizer that decodes; None takes the set's own.

    Raises:
        ShardError: the set holds no episodes.
        UsageError: there is no such camera.
    """
    shards, out = ShardSet(folder), as_path(out)
    if camera is not None and camera not in shards.manifest.cameras:
        known = ", ".join(shards.manifest.cameras)
        raise UsageError("--camera", f"{camera!r} is not in {shards.folder}", f"its cameras: {known}")
    if not len(shards.episodes):
        raise ShardError(shards.folder, "holds no episodes", "its quarantine.jsonl says why")
    opened = tokenizer or tokenizer_of(shards, weights)
    picks = np.unique(np.linspace(0, len(shards.episodes) - 1, episodes).round().astype(int))
    rows = shards.episodes.take(picks).to_pylist()
    seen = [_Seen(shards, opened, row, camera) for row in rows]
    out.mkdir(parents=True, exist_ok=True)
    sheet, video = out / "sheet.png", out / "preview.mp4"
    write_png(sheet, np.concatenate([one.sheet(columns) for one in seen]))
    rate = shards.embodiment.rate_hz / shards.manifest.frame_stride
    write_mp4(video, (frame for one in seen for frame in one.film(frames)), rate)
    return Preview(sheet, video, tuple(row["id"] for row in rows))


class _Seen:
    """One episode as one camera recorded it; tokens are decoded when they are drawn."""

    def __init__(
        self, shards: ShardSet, tokenizer: Tokenizer, row: dict[str, Any], camera: str | None
    ) -> None:
        self._shards, self._tokenizer = shards, tokenizer
        number = shards.manifest.cameras.index(camera) if camera else 0
        own = slice(number * row["length"], (number + 1) * row["length"])
        masks = [name for name in mask_columns(shards.embodiment) if name == "action_known"]
        names = [token_column(shards.spec)[0], "action", "timestamp", *masks]
        values = shards.episode_rows(row["episode_index"], names)
        self._tokens = values[names[0]][own]
        self._actions = values["action"][own, : shards.embodiment.action_dim]  # the first command of a chunk
        self._known = values["action_known"][own] if masks else None
        self._seconds = float(values["timestamp"][own][-1])
        words = [
            row["id"],
            row["split"],
            f"{row['length']} frames, {self._seconds:.1f} s",
            row["instruction"],
        ]
        if row["success"] is not None:
            words.append("success" if row["success"] else "failure")
        self.label = "   ".join(word for word in words if word)

    def _pictures(self, rows: NDArray[np.int64]) -> Images:
        return self._tokenizer.decode(self._shards.tokens(self._tokens[rows]))

    def _curves(self, width: int, height: int) -> Curves:
        stats = self._shards.manifest.stats["action"]
        low, high = np.array(stats["min"]), np.array(stats["max"])
        names = self._shards.embodiment.action.names()
        known = self._known
        return Curves(self._actions, known, low, high, names, self._seconds, width, height)

    def sheet(self, columns: int) -> Images:
        """Return (H, W, 3): the label, pictures in a row, and below them the actions of the whole episode."""
        picks = np.unique(np.linspace(0, len(self._tokens) - 1, columns).astype(int))
        width = columns * (THUMB + GAP) + GAP
        shown = min(self._actions.shape[1], 16)
        curves = self._curves(width, 16 + max(shown * STRIPS, 40))
        strip = np.full((LABEL + THUMB + GAP, width, 3), PAPER, np.uint8)
        write_text(strip, self.label[:110], (GAP, LABEL - 5))
        for place, picture in enumerate(self._pictures(picks)):
            left = GAP + place * (THUMB + GAP)
            strip[LABEL : LABEL + THUMB, left : left + THUMB] = _resized(picture, THUMB)
        return np.concatenate([strip, curves.marked(picks), np.full((2, width, 3), INK, np.uint8)])

    def film(self, most: int) -> Iterator[Images]:
        """Yield (H, W, 3) for each frame: the picture, and the actions with a cursor at its time."""
        curves = self._curves(FILM + 128, FILM)
        for start in range(0, min(len(self._tokens), most), DECODED):
            rows = np.arange(start, min(start + DECODED, len(self._tokens), most))
            for row, picture in zip(rows, self._pictures(rows)):
                bar = np.full((LABEL, 2 * FILM + 128, 3), PAPER, np.uint8)
                write_text(bar, self.label[:80], (GAP, LABEL - 5))
                yield np.concatenate(
                    [bar, np.concatenate([_resized(picture, FILM), curves.at(int(row))], axis=1)]
                )


def _resized(picture: Images, side: int) -> Images:
    cv2 = opencv()
    way = cv2.INTER_AREA if picture.shape[0] >= side else cv2.INTER_NEAREST
    return np.asarray(cv2.resize(picture, (side, side), interpolation=way), np.uint8)
