"""Check a few pictures of a camera: still, blank, of several sizes, red and blue swapped.

Two signs show that channels are swapped. The first holds for pictures that were decoded from JPEG or video
and then stored without loss: every pixel is then a result of the conversion from YCbCr, which gives only a
quarter of all colours. The channel order in which all pixels are such results is the right one. The second
sign is the scene: indoors and outdoors, saturated pixels are warm (red > green > blue) far more often than
cold. This sign is weak, because a blue table looks the same, so it gives only a hint.

n pictures, H×W pixels, uint8 RGB.
"""

from collections.abc import Iterator
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.images import Images
from hma_data.sources.common.findings import Finding, Severity

PAIRS = 16  # pairs of neighbouring pictures compared, for a camera over all its episodes
PIXELS = 4096  # pixels of a picture whose colours are checked
DISTINCT = 1_000  # least number of distinct colours for the YCbCr sign
SURE, CHANCE = 0.98, 0.6  # share of colours that YCbCr gives: least in the right order, most in the other
COLD = 0.15  # share of cold pixels (saturated, blue > green > red) above which a hint is given
JPEG_HEAD = 65536  # bytes that are searched for a JPEG's start of frame
STILL, BLANK = 0.5, 2.0  # limits: share of equal neighbours; standard deviation of all values


@dataclass
class Look:
    """Statistics of one camera's pictures.

    Attributes:
        lossless: whether pictures are stored without loss, so that the YCbCr sign can be used.
        pictures: how many were added.
        sizes: (height, width) -> number of calls of `add` with it.
        changes: how often the size changes within an episode.
        neighbours, same: pairs of neighbouring pictures compared, and equal ones among them.
        blank, episodes: episodes in which the camera shows one colour; all episodes looked at.
        red, blue: sums of the means, over `pictures`.
        warm, cold: shares of saturated pixels, summed over `pictures`.
        colours: some of the colours met.
    """

    lossless: bool = True
    pictures: int = 0
    sizes: dict[tuple[int, int], int] = field(default_factory=dict)
    changes: int = 0
    neighbours: int = 0
    same: int = 0
    blank: int = 0
    episodes: int = 0
    red: float = 0.0
    blue: float = 0.0
    warm: float = 0.0
    cold: float = 0.0
    colours: list[NDArray[np.uint8]] = field(default_factory=list)
    _blank: bool = False
    _size: tuple[int, int] = (0, 0)

    def add(self, frames: Images, indices: NDArray[np.int64], again: bool = False) -> None:
        """Add pictures (n, H, W, 3) of one episode, and the rising indices (n,) of their frames.

        `again` says that they are of the same episode as the pictures before.
        """
        if not again:
            self.episodes, self.blank, self._blank = self.episodes + 1, self.blank + 1, True
        self.pictures += len(frames)
        size = (int(frames.shape[1]), int(frames.shape[2]))
        self.changes += again and size != self._size
        self._size = size
        self.sizes[size] = self.sizes.get(size, 0) + 1
        pairs = np.flatnonzero(np.diff(indices) == 1)
        self.neighbours += len(pairs)
        self.same += sum(np.array_equal(frames[i], frames[i + 1]) for i in pairs)
        if self._blank and float(frames.std()) >= BLANK:
            self.blank, self._blank = self.blank - 1, False
        step = max(1, int(np.sqrt(size[0] * size[1] / PIXELS)))
        for frame in frames:
            pixels = frame[::step, ::step].reshape(-1, 3)  # on a grid over the picture
            self.red += float(pixels[:, 0].mean())
            self.blue += float(pixels[:, 2].mean())
            warm, cold = _tones(pixels)
            self.warm, self.cold = self.warm + warm, self.cold + cold
            self.colours.append(pixels)

    def swapped(self) -> tuple[str, str]:
        """Check whether red and blue are swapped; return the answer and its reason.

        The answer is sure, hint, no (they are certainly in order), or empty where it is unknown.
        """
        if self.lossless and self.colours:
            colours = np.unique(np.concatenate(self.colours), axis=0)
            straight, turned = ycbcr_share(colours), ycbcr_share(colours[:, ::-1])
            if straight is not None and turned is not None:
                if turned >= SURE and straight <= CHANCE:
                    return "sure", (
                        f"{turned:.0%} of its colours are what decoding JPEG gives with the two swapped, "
                        f"{straight:.0%} as they stand"
                    )
                if straight >= SURE and turned <= CHANCE:
                    return "no", ""  # even where the scene is blue
        count = max(self.pictures, 1)
        cold, warm = self.cold / count, self.warm / count
        if cold > COLD and cold > 4 * warm and self.blue > 1.25 * self.red:
            return "hint", f"{cold:.0%} of its pixels are cold, {warm:.0%} warm; a blue scene looks the same"
        return "", ""


def _tones(pixels: NDArray[np.uint8]) -> tuple[float, float]:
    """Return the shares of saturated pixels that are warm (red > green > blue) and cold (blue > … > red)."""
    red, green, blue = pixels.astype(np.int16).T
    strong = np.abs(red - blue) > 32
    warm = strong & (red >= green) & (green >= blue)
    cold = strong & (blue >= green) & (green >= red)
    return float(warm.mean()), float(cold.mean())


def ycbcr_share(colours: NDArray[np.uint8]) -> float | None:
    """Return the share of the RGB colours (m, 3) that JPEG's YCbCr can give; chance alone gives a quarter.

    Colours that are grey or at the edge of the range do not count. None where too few colours remain.
    """
    spread = colours.max(axis=1, initial=0).astype(int) - colours.min(axis=1, initial=255)
    inside = ((colours > 0) & (colours < 255)).all(axis=1) if len(colours) else np.zeros(0, bool)
    rgb = colours[inside & (spread > 8)].astype(np.float64)
    if len(rgb) < DISTINCT:
        return None
    rgb = rgb[:: max(1, len(rgb) // 20_000)]
    luma = rgb @ np.array([0.299, 0.587, 0.114])
    blue, red = (rgb[:, 2] - luma) / 1.772, (rgb[:, 0] - luma) / 1.402
    given = np.zeros(len(rgb), bool)
    for y in (np.floor(luma), np.ceil(luma)):
        for cb in (np.floor(blue), np.ceil(blue)):
            for cr in (np.floor(red), np.ceil(red)):
                back = [y + np.rint(1.402 * cr), y + np.rint(-0.344136 * cb - 0.714136 * cr),
                        y + np.rint(1.772 * cb)]  # fmt: skip
                given |= (np.stack(back, axis=1) == rgb).all(axis=1)
    return float(given.mean())


def choose(length: int, pairs: int, starts: NDArray[np.int64] | None = None) -> NDArray[np.int64]:
    """Choose frames (n,) of an episode, in runs of neighbours over its length.

    Args:
        length: of the episode.
        pairs: how many runs at most.
        starts: for each frame the frame at which its decoding begins, for videos. Runs then begin there
            and have three frames: where every other frame is a keyframe, encoders often repeat it between.
    """
    firsts = np.unique(np.linspace(0, max(length - 2, 0), max(pairs, 1)).astype(np.int64))
    run = 2
    if starts is not None:
        firsts, run = np.unique(np.maximum(starts[firsts], 0)), 3
    return np.unique(np.minimum(firsts[:, None] + np.arange(run), length - 1))


def runs(indices: NDArray[np.int64]) -> list[NDArray[np.int64]]:
    """Divide the chosen frames into runs of neighbours, so that only one run of pictures is in memory."""
    return np.split(indices, np.flatnonzero(np.diff(indices) > 1) + 1)


def stacked(pictures: list[Images]) -> Iterator[tuple[int, Images]]:
    """Yield runs of pictures of one size as (n, H, W, 3), with the index at which each run begins."""
    start = 0
    for i in range(1, len(pictures) + 1):
        if i == len(pictures) or pictures[i].shape != pictures[start].shape:
            yield start, np.stack(pictures[start:i])
            start = i


def one_channel(data: bytes) -> bool:
    """Check whether a JPEG or PNG is grey, by its header."""
    if data[:8] == b"\x89PNG\r\n\x1a\n":
        return data[25:26] in (b"\0", b"\4")
    at, head = 2, data[:JPEG_HEAD]
    while head[:2] == b"\xff\xd8" and at + 10 <= len(head) and head[at] == 0xFF:
        marker = head[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):  # a start of frame
            return head[at + 9] == 1
        at += 2 + (0 if marker == 0xFF else int.from_bytes(head[at + 2 : at + 4], "big"))
    return False


def findings(looks: dict[str, Look]) -> Iterator[Finding]:
    """Yield what looks wrong, camera by camera."""
    for key, look in looks.items():
        if not look.pictures:
            continue
        if len(look.sizes) > 1:
            said = ", ".join(f"{width}×{height}" for height, width in sorted(look.sizes))
            part = "; it changes within episodes" if look.changes else ""
            worst: Severity = "warn" if look.changes else "info"
            yield Finding("size", worst, f"{key}: pictures of several sizes, {said}{part}", key=key)
        if look.blank:
            said = f"{key}: shows nothing (one colour) in {look.blank} of {look.episodes} episodes looked at"
            # Where every episode is blank, the camera was never plugged in.
            severity: Severity = "info" if look.blank == look.episodes else "warn"
            yield Finding("blank", severity, said, "is it another camera's key?", key)
        share = look.same / max(look.neighbours, 1)
        if share > STILL and look.blank < look.episodes:
            said = f"{key}: {share:.0%} of neighbouring pictures are the same"
            remedy = "the camera may be slower than its rate"
            yield Finding("still", "warn", said, remedy, key, {"share": share, "pairs": look.neighbours})
        sureness, reason = look.swapped()
        if sureness in ("sure", "hint"):
            said = f"{key}: red and blue {'are' if sureness == 'sure' else 'may be'} changed over: {reason}"
            remedy = "color: bgr in the YAML" if sureness == "sure" else "look at a preview: color: bgr?"
            yield Finding("colour", "warn" if sureness == "sure" else "info", said, remedy, key,
                          {"confidence": sureness})  # fmt: skip
