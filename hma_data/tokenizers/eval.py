"""How good a tokenizer is: what a round trip loses, what its ids use, what it costs.

    evaluate(get_tokenizer("fsq-16"), read_frames(Path("video.mp4"), 256))

N frames, S side, h·w grid, D digits. PSNR and SSIM (Wang et al. 2004: grey, Gaussian of 11 taps,
sigma 1.5) are means over frames of pixels in [0, 1].
"""

import heapq
import math
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hma_data.errors import TokenizerError
from hma_data.tokenizers.base import Tokenizer, TokenizerSpec
from hma_data.tokenizers.corpus import VIDEOS, read_pictures
from hma_data.video import resize

Frames = NDArray[np.uint8]
PICTURES = {".png", ".jpg", ".jpeg", ".webp", ".bmp"}
BATCH = 32
GREY = (0.299, 0.587, 0.114)


def _window(size: int, like: Tensor) -> Tensor:
    """(S-10, S) matrix that smooths along a side."""
    offset = torch.arange(size, dtype=like.dtype, device=like.device)
    offset = offset[None, :] - torch.arange(5, size - 5, dtype=like.dtype, device=like.device)[:, None]
    taps = torch.exp(-(offset**2) / (2 * 1.5**2)) * (offset.abs() <= 5)
    return taps / taps.sum(dim=1, keepdim=True)


def _smooth(x: Tensor) -> Tensor:
    return _window(x.shape[2], x) @ x @ _window(x.shape[3], x).T


def ssim_map(first: Tensor, second: Tensor) -> Tensor:
    """Structural similarity of (N, C, S, S) pictures in [0, 1] at every place (N, C, S-10, S-10)."""
    c1, c2 = 0.01**2, 0.03**2
    count = first.shape[1]
    both = torch.cat([first, second, first * first, second * second, first * second], dim=1)
    mean1, mean2, square1, square2, product = _smooth(both).split(count, dim=1)
    var1, var2 = square1 - mean1 * mean1, square2 - mean2 * mean2
    covariance = product - mean1 * mean2
    return ((2 * mean1 * mean2 + c1) * (2 * covariance + c2)) / (
        (mean1 * mean1 + mean2 * mean2 + c1) * (var1 + var2 + c2)
    )


def psnr_db(true: Frames, made: Frames) -> NDArray[np.float64]:
    """Peak signal-to-noise ratio of each frame, (N, S, S, 3) uint8 -> (N,); equal frames give inf."""
    error = np.square(true.astype(np.float64) - made).mean(axis=(1, 2, 3))
    with np.errstate(divide="ignore"):
        return 10 * np.log10(255.0**2 / error)


def ssim(true: Frames, made: Frames) -> NDArray[np.float64]:
    """Structural similarity of the grey of each frame, (N, S, S, 3) uint8 -> (N,)."""
    weights = torch.tensor(GREY, dtype=torch.float64) / 255
    grey = [torch.from_numpy(frames).to(torch.float64) @ weights for frames in (true, made)]
    return ssim_map(grey[0][:, None], grey[1][:, None]).mean(dim=(1, 2, 3)).numpy()


class CodebookUse:
    """Counts of the ids met."""

    def __init__(self, spec: TokenizerSpec) -> None:
        self.sizes = spec.factored or (spec.vocab_size or 1,)
        self.joint = np.zeros(spec.vocab_size or 1, np.int64)

    def add(self, ids: NDArray[Any]) -> None:
        """Count (N, h, w) ids."""
        self.joint += np.bincount(ids.ravel().astype(np.int64), minlength=len(self.joint))

    def result(self) -> dict[str, Any]:
        """Share used and perplexity of each digit and of the whole id, entropy in bits a token."""
        # Low digit first: in C order of the reversed sizes it is the last axis.
        table = self.joint.reshape(self.sizes[::-1])
        digits = [
            table.sum(axis=tuple(i for i in range(table.ndim) if i != axis)) for axis in range(table.ndim)
        ]
        digits = digits[::-1]
        entropy = _entropy_bits(self.joint)
        return {
            "digit_use": [round(float((counts > 0).mean()), 4) for counts in digits],
            "digit_perplexity": [round(2 ** _entropy_bits(counts), 1) for counts in digits],
            "joint_used_ids": int((self.joint > 0).sum()),
            "joint_perplexity": round(2**entropy, 1),
            "entropy_bits_per_token": round(entropy, 3),
        }


def _entropy_bits(counts: NDArray[np.int64]) -> float:
    share = counts[counts > 0] / max(1, counts.sum())
    return float(-(share * np.log2(share)).sum())


def bits_per_frame(spec: TokenizerSpec) -> float:
    """What a frame's tokens or latents take before any entropy coding."""
    cells = spec.grid[0] * spec.grid[1]
    if spec.kind == "discrete":
        return cells * math.log2(spec.vocab_size or 1)
    return cells * (spec.channels or 1) * np.dtype(spec.dtype).itemsize * 8.0


@dataclass
class _Totals:
    use: CodebookUse
    psnr: list[float] = field(default_factory=list)
    ssim: list[float] = field(default_factory=list)
    encode_s: float = 0.0
    decode_s: float = 0.0
    worst: list[tuple[float, int, Frames, Frames]] = field(default_factory=list)


def evaluate(tokenizer: Tokenizer, frames_iter: Iterable[Frames], *, worst: int = 0) -> dict[str, Any]:
    """Send frames through a tokenizer and measure.

    Args:
        tokenizer: what to measure.
        frames_iter: frames (S, S, 3), or batches of them (n, S, S, 3), uint8.
        worst: how many of the frames with the lowest PSNR to return as `worst_frames`.

    Returns:
        frames, psnr_db (mean over frames, lossless frames counted as 99), psnr_db_min, ssim, bits_per_frame,
        encode_frames_per_second, decode_frames_per_second; for discrete tokenizers also the fields of
        `CodebookUse.result`; `worst_frames`, a list of (psnr, index, frame, made), when asked for.

    Raises:
        TokenizerError: no frame, or frames that do not fit.
    """
    totals = _Totals(CodebookUse(tokenizer.spec))
    for batch in _batches(frames_iter):
        _measure(tokenizer, batch, totals, worst)
    if not totals.psnr:
        raise TokenizerError(tokenizer.spec.name, "was given no frame to measure")
    count = len(totals.psnr)
    result: dict[str, Any] = {
        "tokenizer": tokenizer.spec.name,
        "weights_sha256": tokenizer.spec.weights_sha256,
        "frames": count,
        "psnr_db": round(float(np.mean(totals.psnr)), 3),
        "psnr_db_min": round(min(totals.psnr), 3),
        "ssim": round(float(np.mean(totals.ssim)), 4),
        "bits_per_frame": bits_per_frame(tokenizer.spec),
        "encode_frames_per_second": round(count / totals.encode_s, 1),
        "decode_frames_per_second": round(count / totals.decode_s, 1),
    }
    if tokenizer.spec.kind == "discrete":
        result |= totals.use.result()
    if worst:
        lowest_first = sorted(totals.worst, key=_order, reverse=True)
        result["worst_frames"] = [(-value, index, true, made) for value, index, true, made in lowest_first]
    return result


def _order(entry: tuple[float, int, Frames, Frames]) -> tuple[float, int]:
    return entry[0], entry[1]


def _batches(frames_iter: Iterable[Frames]) -> Iterator[Frames]:
    """Stack single frames and regroup batches into batches of `BATCH`."""
    waiting: list[Frames] = []
    for item in frames_iter:
        waiting.extend([item] if item.ndim == 3 else list(item))
        while len(waiting) >= BATCH:
            yield np.stack(waiting[:BATCH])
            del waiting[:BATCH]
    if waiting:
        yield np.stack(waiting)


def _measure(tokenizer: Tokenizer, batch: Frames, totals: _Totals, worst: int) -> None:
    started = time.perf_counter()
    tokens = tokenizer.encode(batch)
    between = time.perf_counter()
    made = tokenizer.decode(tokens)
    totals.encode_s += between - started
    totals.decode_s += time.perf_counter() - between
    if tokenizer.spec.kind == "discrete":
        totals.use.add(tokens)
    psnr = np.minimum(psnr_db(batch, made), 99.0)
    for i, value in enumerate(psnr):
        if worst:
            # A heap of the highest -PSNR; the index breaks ties before pictures are compared.
            heapq.heappush(totals.worst, (-float(value), len(totals.psnr) + i, batch[i], made[i]))
            if len(totals.worst) > worst:
                heapq.heappop(totals.worst)
    totals.psnr.extend(psnr.tolist())
    totals.ssim.extend(ssim(batch, made).tolist())


def read_frames(path: Path, size: int, *, frames: int = 64, resize_filter: Any = "area") -> Iterator[Frames]:
    """Frames (size, size, 3) of a picture, a video, or every picture and video below a folder.

    Args:
        frames: taken from each video, evenly.

    Raises:
        TokenizerError: there is no picture and no video.
    """
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    found = False
    for file in files:
        if file.suffix.lower() not in VIDEOS | PICTURES or not file.is_file():
            continue
        for picture in read_pictures(file, frames):
            found = True
            yield resize(picture[None], size, "short_side_crop", resize_filter)[0]
    if not found:
        raise TokenizerError(path, "holds no picture and no video", "name a file or folder of png, jpg, mp4")


def to_markdown(results: dict[str, dict[str, Any]]) -> str:
    """A table, one row a set of frames: name -> what `evaluate` returned."""
    columns = {
        "frames": lambda r: str(r["frames"]),
        "PSNR dB": lambda r: f"{r['psnr_db']:.2f}",
        "lowest dB": lambda r: f"{r['psnr_db_min']:.2f}",
        "SSIM": lambda r: f"{r['ssim']:.3f}",
        "digits used": lambda r: ", ".join(f"{100 * use:.0f} %" for use in r.get("digit_use", [])) or "–",
        "entropy bits/token": lambda r: f"{r.get('entropy_bits_per_token', math.nan):.2f}",
        "bits/frame": lambda r: f"{r['bits_per_frame']:.0f}",
        "encode frames/s": lambda r: f"{r['encode_frames_per_second']:.0f}",
        "decode frames/s": lambda r: f"{r['decode_frames_per_second']:.0f}",
    }
    lines = ["| of | " + " | ".join(columns) + " |", "|" + " --- |" * (len(columns) + 1)]
    for name, result in results.items():
        lines.append(f"| {name} | " + " | ".join(text(result) for text in columns.values()) + " |")
    return "\n".join(lines) + "\n"
