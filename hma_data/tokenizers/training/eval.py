"""Measure a tokenizer: the error of a round trip, the use of its ids, its size and its speed.

    evaluate(get_tokenizer("fsq-16"), hma_data.tokenizers.training.frames.read_films(Path("video.mp4"), 256))

N frames, S side, h·w grid, D digits. What moves is measured by itself too: it may be few of the pixels, and
is all that commands change. PSNR and SSIM (Wang et al. 2004: grey, Gaussian of 11 taps, sigma 1.5) are means
over frames of pixels in [0, 1]. LPIPS (Zhang et al. 2018) needs its package and the
weights of its backbone. `write_report` writes what `hma tokenizer eval --out` leaves behind.
"""

import heapq
import json
import math
import time
import warnings
from collections.abc import Callable, Iterable, Iterator
from importlib import import_module
from itertools import batched
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from hma_data.arrays import Array, Bools, Floats, Images, Ints
from hma_data.episodes.movement import bounded_psnr_db, moving
from hma_data.episodes.sheets import grid, write_png
from hma_data.errors import MissingDependencyError, TokenizerError
from hma_data.storage.files import write_atomic
from hma_data.storage.paths import StrPath, as_path
from hma_data.tables import Table
from hma_data.tokenizers.base import Tokenizer, TokenizerSpec

Perceptual = Callable[[Images, Images], Floats]
Results = dict[str, dict[str, Any]]
BATCH_FRAMES = 32
GREY = (0.299, 0.587, 0.114)
BACKBONE = "alexnet-owt-7be5be79.pth"  # torchvision's file of AlexNet, 233 MB


# -- errors of a round trip


def _window(size: int, like: Tensor) -> Tensor:
    """Return the (S-10, S) matrix that smooths along a side."""
    offset = torch.arange(size, dtype=like.dtype, device=like.device)
    offset = offset[None, :] - torch.arange(5, size - 5, dtype=like.dtype, device=like.device)[:, None]
    taps = torch.exp(-(offset**2) / (2 * 1.5**2)) * (offset.abs() <= 5)
    return taps / taps.sum(dim=1, keepdim=True)


def ssim_map(first: Tensor, second: Tensor) -> Tensor:
    """Return the structural similarity of (N, C, S, S) images in [0, 1] per pixel, (N, C, S-10, S-10)."""
    c1, c2 = 0.01**2, 0.03**2
    both = torch.cat([first, second, first * first, second * second, first * second], dim=1)
    smooth = _window(both.shape[2], both) @ both @ _window(both.shape[3], both).T
    mean1, mean2, square1, square2, product = smooth.split(first.shape[1], dim=1)
    var1, var2 = square1 - mean1 * mean1, square2 - mean2 * mean2
    covariance = product - mean1 * mean2
    return ((2 * mean1 * mean2 + c1) * (2 * covariance + c2)) / (
        (mean1 * mean1 + mean2 * mean2 + c1) * (var1 + var2 + c2)
    )


def psnr_db(true: Images, made: Images) -> Floats:
    """Return the peak signal-to-noise ratio in dB, (N, S, S, 3) uint8 -> (N,); equal frames give inf."""
    error = np.square(true.astype(np.float64) - made).mean(axis=(1, 2, 3))
    with np.errstate(divide="ignore"):
        return 10 * np.log10(255.0**2 / error)


def ssim(true: Images, made: Images) -> Floats:
    """Return the structural similarity of each frame in grey, (N, S, S, 3) uint8 -> (N,)."""
    weights = torch.tensor(GREY, dtype=torch.float64) / 255
    first, second = ((torch.from_numpy(frames).double() @ weights)[:, None] for frames in (true, made))
    return ssim_map(first, second).mean(dim=(1, 2, 3)).numpy()


def open_lpips(*, download: bool, device: str = "cpu") -> Perceptual:
    """Return a function that measures LPIPS: (N, S, S, 3) uint8 true and made -> (N,); lower is nearer.

    Args:
        download: whether the backbone may be downloaded.

    Raises:
        MissingDependencyError: the package or the backbone is missing; the remedy says how to get it.
    """
    try:
        lpips = import_module("lpips")
    except ImportError as fault:
        raise MissingDependencyError(
            "LPIPS", "the package lpips is not installed", "pip install lpips"
        ) from fault
    cached = Path(torch.hub.get_dir()) / "checkpoints" / BACKBONE
    if not download and not cached.is_file():
        raise MissingDependencyError(
            "LPIPS", "AlexNet's weights (233 MB) are not on this machine", "--lpips downloads them"
        )
    try:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore")  # it uses torchvision's old arguments
            network = lpips.LPIPS(net="alex", verbose=False).to(device).eval()
    except OSError as fault:
        text = f"AlexNet's weights could not be downloaded: {fault}"
        raise MissingDependencyError("LPIPS", text, f"put {BACKBONE} into {cached.parent}") from fault

    def pixels(frames: Images) -> Tensor:
        return torch.from_numpy(frames).to(device).permute(0, 3, 1, 2).float().mul(2 / 255).sub(1)

    @torch.inference_mode()
    def measure(true: Images, made: Images) -> Floats:
        return np.asarray(network(pixels(true), pixels(made)).flatten().cpu().numpy(), np.float64)

    return measure


# -- use of ids and latents


class CodebookUse:
    """Counts of the ids that occur; a vocabulary may have billions that do not."""

    def __init__(self, spec: TokenizerSpec) -> None:
        self.sizes = spec.factored or (spec.vocab_size or 1,)
        self.ids, self.counts = np.zeros((2, 0), np.int64)  # the ids in rising order

    def add(self, ids: Array) -> None:
        """Count (N, h, w) ids."""
        found, counts = np.unique(ids.astype(np.int64), return_counts=True)
        self.ids, place = np.unique(np.concatenate([self.ids, found]), return_inverse=True)
        total = np.zeros(len(self.ids), np.int64)
        np.add.at(total, place, np.concatenate([self.counts, counts]))
        self.counts = total

    def result(self) -> dict[str, Any]:
        """Return the share used and the perplexity of each digit, and figures of the whole id.

        For the whole id: the number of ids used, the perplexity, and the entropy in bits a token.
        """
        digits, rest = list[Ints](), self.ids
        for size in self.sizes:  # low digit first
            digits.append(np.zeros(size, np.int64))
            np.add.at(digits[-1], rest % size, self.counts)
            rest = rest // size
        entropy = _entropy_bits(self.counts)
        return {
            "digit_use": [round(float((counts > 0).mean()), 4) for counts in digits],
            "digit_perplexity": [round(2 ** _entropy_bits(counts), 1) for counts in digits],
            "joint_used_ids": len(self.ids),
            "joint_perplexity": round(2**entropy, 1),
            "entropy_bits_per_token": round(entropy, 3),
        }


def _entropy_bits(counts: Ints) -> float:
    share = counts[counts > 0] / max(1, counts.sum())
    return float(-(share * np.log2(share)).sum())


class LatentMoments:
    """The mean and spread of continuous latents, as a model sees them (times `latent_scale`)."""

    def __init__(self, spec: TokenizerSpec) -> None:
        self.scale, self.moments = spec.latent_scale, list[tuple[float, float]]()

    def add(self, latents: Array) -> None:
        """Count (N, c, h, w) latents."""
        for scaled in latents.astype(np.float64) * self.scale:
            self.moments.append((scaled.mean(), np.square(scaled).mean()))

    def result(self) -> dict[str, Any]:
        """Return the mean and standard deviation of all latents."""
        mean, square = np.mean(self.moments, axis=0)
        deviation = math.sqrt(max(0.0, square - mean**2))
        return {"latent_mean_scaled": round(float(mean), 4), "latent_std_scaled": round(deviation, 4)}


# -- everything together


def evaluate(
    tokenizer: Tokenizer,
    frames_iter: Iterable[Images],
    *,
    worst: int = 0,
    perceptual: Perceptual | None = None,
) -> dict[str, Any]:
    """Encode and decode frames with a tokenizer, and measure the result.

    Args:
        tokenizer: the tokenizer to measure.
        frames_iter: frames (S, S, 3), or films (n, S, S, 3) of frames that follow one another, uint8.
        worst: how many of the frames with the lowest PSNR to return as `worst_frames`.
        perceptual: measures LPIPS, see `open_lpips`.

    Returns:
        frames, psnr_db (mean over frames, lossless frames counted as 99), psnr_db_min, ssim, bits_per_frame
        (before any entropy coding), encode_frames_per_second, decode_frames_per_second (resizing not
        counted); if something moves in a film (`moving`), psnr_moving_db, of all those pixels together, and
        moving_share, their share; `lpips` if it is measured; the fields of `CodebookUse.result` or
        `LatentMoments.result`; if `worst` is above 0, `worst_frames`, a list of (psnr, index, frame, made).

    Raises:
        TokenizerError: there is no frame, or the frames do not fit.
    """
    spec = tokenizer.spec
    use = CodebookUse(spec) if spec.kind == "discrete" else LatentMoments(spec)
    bits = math.log2(spec.vocab_size) if spec.vocab_size else np.dtype(spec.dtype).itemsize * 8.0
    psnr, similarity, distance = list[float](), list[float](), list[float]()
    lowest = list[tuple[float, int, Images, Images]]()
    encode_s = decode_s = moving_error = 0.0
    moved = 0
    for batch, masks in _batches(frames_iter):
        if not psnr:
            tokenizer.decode(tokenizer.encode(batch[:1]))  # the first pass prepares kernels
        started = time.perf_counter()
        tokens = tokenizer.encode(batch)
        between = time.perf_counter()
        made = tokenizer.decode(tokens)
        decode_s += time.perf_counter() - between
        encode_s += between - started
        use.add(tokens)
        values = np.minimum(psnr_db(batch, made), 99.0).tolist()
        found = zip(values, range(len(psnr), len(psnr) + len(batch)), batch, made, strict=True)
        lowest = heapq.nsmallest(worst, [*lowest, *found], key=lambda entry: entry[:2])
        psnr += values
        similarity += ssim(batch, made).tolist()
        moving_error += float(np.square(batch[masks].astype(np.float64) - made[masks]).sum()) / 3
        moved += int(masks.sum())
        if perceptual is not None:
            distance += perceptual(batch, made).tolist()
    if not psnr:
        raise TokenizerError(spec.name, "was given no frame to measure")
    result: dict[str, Any] = {
        "tokenizer": spec.name,
        "weights_sha256": spec.weights_sha256,
        "frames": len(psnr),
        "psnr_db": round(float(np.mean(psnr)), 3),
        "psnr_db_min": round(min(psnr), 3),
        "ssim": round(float(np.mean(similarity)), 4),
        "bits_per_frame": math.prod(spec.cells) * bits,
        "encode_frames_per_second": round(len(psnr) / encode_s, 1),
        "decode_frames_per_second": round(len(psnr) / decode_s, 1),
        **use.result(),
    }
    if moved:
        result["psnr_moving_db"] = round(bounded_psnr_db(moving_error / moved), 3)
        result["moving_share"] = round(moved / (len(psnr) * spec.image_size**2), 4)
    if distance:
        result["lpips"] = round(float(np.mean(distance)), 4)
    if worst:
        result["worst_frames"] = lowest
    return result


def _batches(frames_iter: Iterable[Images]) -> Iterator[tuple[Images, Bools]]:
    """Regroup films and single frames into batches of `BATCH_FRAMES`, beside which pixels of them move."""
    films = (item[None] if item.ndim == 3 else item for item in frames_iter)
    pairs = (pair for film in films for pair in zip(film, moving(film), strict=True))
    for batch in batched(pairs, BATCH_FRAMES):
        frames, masks = zip(*batch, strict=True)
        yield np.stack(frames), np.stack(masks)


# -- report


def _percent(shares: list[float]) -> str:
    return ", ".join(f"{100 * share:.0f} %" for share in shares)


# column -> (key in a result, function that formats its value)
COLUMNS: dict[str, tuple[str, Callable[[Any], str]]] = {
    "frames": ("frames", str),
    "PSNR dB": ("psnr_db", "{:.2f}".format),
    "lowest dB": ("psnr_db_min", "{:.2f}".format),
    "where it moves dB": ("psnr_moving_db", "{:.2f}".format),
    "moves": ("moving_share", "{:.1%}".format),
    "SSIM": ("ssim", "{:.3f}".format),
    "LPIPS": ("lpips", "{:.3f}".format),
    "digits used": ("digit_use", _percent),
    "entropy bits/token": ("entropy_bits_per_token", "{:.2f}".format),
    "latents' std × scale": ("latent_std_scaled", "{:.2f}".format),
    "bits/frame": ("bits_per_frame", "{:.0f}".format),
    "encode frames/s": ("encode_frames_per_second", "{:.0f}".format),
    "decode frames/s": ("decode_frames_per_second", "{:.0f}".format),
}


def to_markdown(results: Results) -> str:
    """Return a table with one row per set of frames; leave out columns that no result has.

    Args:
        results: name -> what `evaluate` returned.
    """
    columns = {
        name: column for name, column in COLUMNS.items() if any(column[0] in r for r in results.values())
    }
    rows = [
        [name, *(show(result[key]) if key in result else None for key, show in columns.values())]
        for name, result in results.items()
    ]
    return Table(["of", *columns], rows).markdown() + "\n"


def write_report(folder: StrPath, title: str, results: Results, notes: list[str]) -> list[Path]:
    """Write `eval.md`, `eval.json` and, where results hold worst frames, `worst.png` to a folder.

    Args:
        folder: str or path of the folder.
        results: as for `to_markdown`; their `worst_frames` go into `worst.png`.
        notes: lines to print below the table.
    """
    folder = as_path(folder)
    plain = {name: without_frames(result) for name, result in results.items()}
    text = f"# {title}\n\n{to_markdown(plain)}" + "".join(f"\n{note}\n" for note in notes)
    paths = [folder / "eval.json", folder / "eval.md"]
    rows, labels = [], []
    for name, result in results.items():
        if worst := result.get("worst_frames"):
            rows += [[true for _, _, true, _ in worst], [made for _, _, _, made in worst]]
            levels = ", ".join(f"{value:.1f}" for value, _, _, _ in worst)
            labels += [f"{name}: the frames of lowest PSNR", f"decoded: {levels} dB"]
    if rows:
        paths.append(folder / "worst.png")
        write_png(paths[-1], grid(rows, labels))
        text += "\n![Frames of lowest PSNR, original above decoded](worst.png)\n"
    write_atomic(paths[0], json.dumps(plain, indent=1, ensure_ascii=False) + "\n")
    write_atomic(paths[1], text)
    return paths


def without_frames(result: dict[str, Any]) -> dict[str, Any]:
    """Return the result without its `worst_frames`, so that it holds plain values only."""
    return {key: value for key, value in result.items() if key != "worst_frames"}
