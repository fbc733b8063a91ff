"""Draw and write pictures for people: contact sheets, action bars, PNG, MP4 and animated WebP.

N pictures, H×W pixels, A action dims; pictures are uint8 RGB.
"""

import io
from collections.abc import Iterable, Sequence
from fractions import Fraction
from itertools import chain
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.arrays import Float32s, Floats, Images
from hma_data.episodes.images import opencv
from hma_data.storage.files import atomic_path, write_atomic

CELL = 128  # pixels of a side of a picture in a sample, about
GAP, LABEL = 4, 18  # pixels between the pictures of a grid, and of a row's label
INK, PAPER = (30, 30, 30), (250, 250, 250)
BAR, NEGATIVE = (0, 114, 178), (213, 94, 0)  # safe without colour vision


def grid(rows: Sequence[Sequence[Images]], labels: Sequence[str] = ()) -> Images:
    """Return a picture (H, W, 3) of pictures of one size in rows, with a label above each row."""
    label_height = LABEL if labels else 0
    height, width = rows[0][0].shape[:2]
    columns = max(map(len, rows))
    sheet = np.full(
        (len(rows) * (height + GAP + label_height) + GAP, columns * (width + GAP) + GAP, 3), PAPER, np.uint8
    )
    for i, row in enumerate(rows):
        top = GAP + i * (height + GAP + label_height)
        if labels:
            write_text(sheet, fitted(labels[i], sheet.shape[1] - 2 * GAP), (GAP, top + 13))
        for j, picture in enumerate(row):
            left = GAP + j * (width + GAP)
            sheet[top + label_height : top + label_height + height, left : left + width] = picture
    return sheet


def cell_scale(side: int) -> tuple[int, int]:
    """Return by how much a picture is enlarged for a sample, and which of its pixels are then kept."""
    return max(1, -(-CELL // side)), max(1, side // CELL)


def first_of_grid(sheet: Images, height: int, width: int) -> Images | None:
    """Return the first picture (height, width, 3) of a `grid` with labels; None if it has another size."""
    across, down = sheet.shape[1] - GAP, sheet.shape[0] - GAP
    if across % (width + GAP) or down % (height + GAP + LABEL):
        return None
    return sheet[GAP + LABEL : GAP + LABEL + height, GAP : GAP + width].copy()


def write_text(picture: Images, text: str, at: tuple[int, int], scale: float = 0.42) -> None:
    """Write text into a picture in place, with its lower left corner at (x, y)."""
    cv2 = opencv()
    cv2.putText(picture, _ascii(text), at, cv2.FONT_HERSHEY_SIMPLEX, scale, INK, 1, cv2.LINE_AA)


def text_width(text: str, scale: float = 0.42) -> int:
    """Return the width in pixels that `write_text` needs."""
    cv2 = opencv()
    return int(cv2.getTextSize(_ascii(text), cv2.FONT_HERSHEY_SIMPLEX, scale, 1)[0][0])


def fitted(text: str, width: int, scale: float = 0.42) -> str:
    """Return a text that fits `width` pixels: where it is too long, its middle becomes two dots."""
    short, kept = text, len(text)
    while kept and text_width(short, scale) > width:
        kept -= 1
        short = text[: (kept + 1) // 2] + ".." + text[len(text) - kept // 2 :]
    return short


def fitted_names(names: Sequence[str], width: int, scale: float = 0.42) -> list[str]:
    """Return names that fit `width` pixels and still differ.

    If one is too long, the words that all of them begin and end with are left out; then see `fitted`.
    """
    if len(set(names)) > 1 and any(text_width(name, scale) > width for name in names):
        begin = _shared(names)
        end = _shared([name[::-1] for name in names])
        names = [name[begin : max(len(name) - end, begin + 1)] for name in names]
    return [fitted(name, width, scale) for name in names]


def _shared(names: Sequence[str]) -> int:
    """Return the length of the words, with the marks after them, that all names begin with."""
    first, last = min(names), max(names)  # what these two share, all share
    same = next((i for i, pair in enumerate(zip(first, last)) if len(set(pair)) > 1), len(first))
    return max(first.rfind(mark, 0, same) + 1 for mark in "_./ ")


def _ascii(text: str) -> str:
    return text.encode("ascii", "replace").decode()


def with_actions(
    frames: Images,
    actions: Float32s,
    low: Floats,
    high: Floats,
    names: Sequence[str] = (),
) -> Images:
    """Return frames (N, H, W, 3) with a bar below them for each action dim, from `low` to `high` (A,).

    The names stand beside the bars if there is room for them. A line marks the value zero.
    """
    count, height, width = frames.shape[:3]
    dims = actions.shape[1]
    line = max(3, min(14 if names else 8, 96 // max(dims, 1)))
    shown = fitted_names(names, width // 3, 0.36) if line >= 12 else []
    left = max((text_width(name, 0.36) + 6 for name in shown), default=0)
    out = np.full((count, height + dims * line + 4, width, 3), PAPER, np.uint8)
    out[:, :height] = frames
    span, right = np.where(high > low, high - low, 1.0), width - 1 - left
    share = np.clip((actions - low) / span, 0, 1)
    zero = np.clip((0 - low) / span, 0, 1)
    for d in range(dims):
        top, origin = height + 2 + d * line, left + round(zero[d] * right)
        for t in range(count):
            a, b = sorted((origin, left + round(share[t, d] * right)))
            out[t, top : top + line - 1, a : b + 1] = BAR if actions[t, d] >= 0 else NEGATIVE
            if shown:
                out[t, top : top + line, origin] = INK
                write_text(out[t], shown[d], (2, top + line - 4), 0.36)
    return out


def png_bytes(picture: Images) -> bytes:
    """Return a picture (H, W, 3) as the bytes of a PNG."""
    cv2 = opencv()
    return cv2.imencode(".png", cv2.cvtColor(picture, cv2.COLOR_RGB2BGR))[1].tobytes()


def webp_bytes(frames: Images, fps: float) -> bytes:
    """Return frames (N, H, W, 3) as the bytes of an animated WebP that loops."""
    from PIL import Image

    first, *rest = (Image.fromarray(frame) for frame in frames)
    buffer = io.BytesIO()
    settings: dict[str, Any] = {"duration": round(1000 / fps), "loop": 0, "quality": 85, "method": 4}
    first.save(buffer, "WEBP", save_all=True, append_images=rest, **settings)
    return buffer.getvalue()


def gif_bytes(frames: Iterable[Images], fps: float) -> bytes:
    """Return frames (H, W, 3) as the bytes of an animated GIF that loops."""
    from PIL import Image

    pictures = [Image.fromarray(frame) for frame in frames]
    some = np.concatenate([np.asarray(picture) for picture in pictures[:: max(1, len(pictures) // 8)]])
    palette = Image.fromarray(some).quantize(256)  # one for all: nothing flickers, and the file is small
    first, *rest = (picture.quantize(palette=palette, dither=Image.Dither.NONE) for picture in pictures)
    buffer = io.BytesIO()
    first.save(buffer, "GIF", save_all=True, append_images=rest, duration=round(1000 / fps), loop=0)
    return buffer.getvalue()


def write_png(path: Path, picture: Images) -> None:
    """Write a PNG file, whole or not at all."""
    write_atomic(path, png_bytes(picture))


def write_mp4(path: Path, frames: Iterable[Images], fps: float) -> None:
    """Write frames (H, W, 3) of one size as an H.264 file, whole or not at all.

    Odd sides are padded by one pixel. Frames are taken one by one, so `frames` may be a generator of any
    length; it must give at least one frame.
    """
    import av

    rest = iter(frames)
    first = next(rest)
    height, width = (side + side % 2 for side in first.shape[:2])
    with atomic_path(path) as part, av.open(str(part), "w", format="mp4") as container:
        stream = container.add_stream("libx264", rate=Fraction(fps).limit_denominator(1000))
        stream.height, stream.width, stream.pix_fmt = height, width, "yuv420p"
        stream.options = {"crf": "18", "preset": "fast"}
        for frame in chain([first], rest):
            odd = ((0, height - frame.shape[0]), (0, width - frame.shape[1]), (0, 0))
            padded = np.ascontiguousarray(np.pad(frame, odd, mode="edge"))
            container.mux(stream.encode(av.VideoFrame.from_ndarray(padded, format="rgb24")))
        container.mux(stream.encode(None))
