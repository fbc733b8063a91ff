"""Measure a tokenizer: the error of a round trip, the use of its ids, its size and its speed.

    evaluate(get_tokenizer("fsq-16"), hma_data.tokenizers.training.frames.read_frames(Path("video.mp4"), 256))

N frames, S side, h·w grid, D digits. PSNR and SSIM (Wang et al. 2004: grey, Gaussian of 11 taps,
sigma 1.5) are means over frames of pixels in [0, 1].
"""

import heapq
import math
import time
from collections.abc import Iterable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from hma_data.errors import TokenizerError
from hma_data.tokenizers.base import Tokenizer, TokenizerSpec
from hma_data.tokenizers.training.perceptual import Perceptual

Frames = NDArray[np.uint8]
BATCH = 32
GREY = (0.299, 0.587, 0.114)


def _window(size: int, like: Tensor) -> Tensor:
    """Return the (S-10, S) matrix that smooths along a side."""
    offset = torch.arange(size, dtype=like.dtype, device=like.device)
    offset = offset[None, :] - torch.arange(5, size - 5, dtype=like.dtype, device=like.device)[:, None]
    taps = torch.exp(-(offset**2) / (2 * 1.5**2)) * (offset.abs() <= 5)
    return taps / taps.sum(dim=1, keepdim=True)


def _smooth(x: Tensor) -> Tensor:
    return _window(x.shape[2], x) @ x @ _window(x.shape[3], x).T


def ssim_map(first: Tensor, second: Tensor) -> Tensor:
    """Return the structural similarity of (N, C, S, S) pictures in [0, 1] per pixel, (N, C, S-10, S-10)."""
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
    """Return the peak signal-to-noise ratio of each frame in dB; equal frames give inf.

    (N, S, S, 3) uint8 -> (N,).
    """
    error = np.square(true.astype(np.float64) - made).mean(axis=(1, 2, 3))
    with np.errstate(divide="ignore"):
        return 10 * np.log10(255.0**2 / error)


def ssim(true: Frames, made: Frames) -> NDArray[np.float64]:
    """Return the structural similarity of each frame in grey, (N, S, S, 3) uint8 -> (N,)."""
    weights = torch.tensor(GREY, dtype=torch.float64) / 255
    grey = [torch.from_numpy(frames).to(torch.float64) @ weights for frames in (true, made)]
    return ssim_map(grey[0][:, None], grey[1][:, None]).mean(dim=(1, 2, 3)).numpy()


class CodebookUse:
    """Counts of the ids that occur."""

    def __init__(self, spec: TokenizerSpec) -> None:
        self.sizes = spec.factored or (spec.vocab_size or 1,)
        self.joint = np.zeros(spec.vocab_size or 1, np.int64)

    def add(self, ids: NDArray[Any]) -> None:
        """Count (N, h, w) ids."""
        self.joint += np.bincount(ids.ravel().astype(np.int64), minlength=len(self.joint))

    def result(self) -> dict[str, Any]:
        """Return the share used and the perplexity of each digit, and figures of the whole id.

        For the whole id: the number of ids used, the perplexity, and the entropy in bits a token.
        """
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
    """Return the number of bits of a frame's tokens or latents before any entropy coding."""
    cells = spec.grid[0] * spec.grid[1]
    if spec.kind == "discrete":
        return cells * math.log2(spec.vocab_size or 1)
    return cells * (spec.channels or 1) * np.dtype(spec.dtype).itemsize * 8.0


class LatentMoments:
    """The mean and spread of continuous latents, as a model sees them (times `latent_scale`)."""

    def __init__(self, spec: TokenizerSpec) -> None:
        self.scale, self.count, self.total, self.squares = spec.latent_scale, 0, 0.0, 0.0

    def add(self, latents: NDArray[Any]) -> None:
        """Count (N, c, h, w) latents."""
        scaled = latents.astype(np.float64) * self.scale
        self.count += scaled.size
        self.total += float(scaled.sum())
        self.squares += float(np.square(scaled).sum())

    def result(self) -> dict[str, Any]:
        """Return the mean and standard deviation of all latents."""
        mean = self.total / self.count
        deviation = math.sqrt(max(0.0, self.squares / self.count - mean**2))
        return {"latent_mean_scaled": round(mean, 4), "latent_std_scaled": round(deviation, 4)}


@dataclass
class _Totals:
    use: CodebookUse | LatentMoments
    psnr: list[float] = field(default_factory=list)
    ssim: list[float] = field(default_factory=list)
    lpips: list[float] = field(default_factory=list)
    encode_s: float = 0.0
    decode_s: float = 0.0
    worst: list[tuple[float, int, Frames, Frames]] = field(default_factory=list)


def evaluate(
    tokenizer: Tokenizer,
    frames_iter: Iterable[Frames],
    *,
    worst: int = 0,
    perceptual: Perceptual | None = None,
) -> dict[str, Any]:
    """Encode and decode frames with a tokenizer, and measure the result.

    Args:
        tokenizer: the tokenizer to measure.
        frames_iter: frames (S, S, 3), or batches of them (n, S, S, 3), uint8.
        worst: how many of the frames with the lowest PSNR to return as `worst_frames`.
        perceptual: measures LPIPS, see `hma_data.tokenizers.training.perceptual`.

    Returns:
        frames, psnr_db (mean over frames, lossless frames counted as 99), psnr_db_min, ssim, bits_per_frame,
        encode_frames_per_second, decode_frames_per_second (resizing not counted); `lpips` if it is
        measured; the fields of `CodebookUse.result` or `LatentMoments.result`; if `worst` is above 0,
        `worst_frames`, a list of (psnr, index, frame, made).

    Raises:
        TokenizerError: there is no frame, or the frames do not fit.
    """
    discrete = tokenizer.spec.kind == "discrete"
    totals = _Totals(CodebookUse(tokenizer.spec) if discrete else LatentMoments(tokenizer.spec))
    for batch in _batches(frames_iter):
        if not totals.psnr:
            tokenizer.decode(tokenizer.encode(batch[:1]))  # the first pass prepares kernels
        _measure(tokenizer, batch, totals, worst, perceptual)
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
    result |= totals.use.result()
    if totals.lpips:
        result["lpips"] = round(float(np.mean(totals.lpips)), 4)
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


def _measure(
    tokenizer: Tokenizer, batch: Frames, totals: _Totals, worst: int, perceptual: Perceptual | None
) -> None:
    started = time.perf_counter()
    tokens = tokenizer.encode(batch)
    between = time.perf_counter()
    made = tokenizer.decode(tokens)
    totals.encode_s += between - started
    totals.decode_s += time.perf_counter() - between
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
    if perceptual is not None:
        totals.lpips.extend(perceptual(batch, made).tolist())
