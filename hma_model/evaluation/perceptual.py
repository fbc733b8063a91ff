"""Measure LPIPS, FID and FVD of rollouts, with TorchScript networks that the user has.

    --lpips FILE   lpips.LPIPS(net="alex"), traced
    --fid FILE     Inception: NVIDIA's inception-2015-12-05.pt
    --fvd FILE     I3D: i3d_torchscript.pt of StyleGAN-V, a copy of TensorFlow Hub's

A file is named with its SHA-256, `FILE#SHA256`: TorchScript is code, and a metric of other weights is another
metric. Without a file a metric is absent, and `missing` says so. FID compares all predicted frames of a set
with all true ones, FVD the predicted parts of its windows. FVD's videos are scaled to 224 pixels on their
short side and cropped; those of fewer than ten frames are stretched to sixteen by repeating frames.

N pictures or videos, B windows, T frames, S pixels a side, D features.
"""

from collections.abc import Callable
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
import torch.nn.functional as F
from numpy.typing import NDArray
from torch import Tensor

from hma_data.arrays import Floats, Images, Ints
from hma_data.errors import UsageError
from hma_data.storage.files import file_sha256
from hma_data.storage.paths import StrPath, as_text

Network = Callable[[Tensor], Tensor]
I3D_SIDE = 224  # pixels of the short side of I3D's videos
SHORT_VIDEO, STRETCHED_FRAMES = 10, 16  # frames below which a video is stretched, and those that it then has
BATCH_SIZE = 32  # pictures in a pass
REMEDIES = {
    "lpips": '--lpips FILE#SHA256: torch.jit.trace of lpips.LPIPS(net="alex")',
    "fid": "--fid FILE#SHA256: inception-2015-12-05.pt of NVIDIA",
    "fvd": "--fvd FILE#SHA256: i3d_torchscript.pt of StyleGAN-V",
}


@dataclass(frozen=True)
class Networks:
    """The networks that there are.

    Attributes:
        lpips: returns the distance (N,) of pictures (N, 3, S, S) of -1 to 1 from true ones.
        features: returns features (N, D), by the metric's name: for fid of pictures (N, 3, S, S) of 0 to 255,
            for fvd of videos (N, 3, T, 224, 224) of -1 to 1.
        facts: file and SHA-256 of each, by the metric's name.
    """

    lpips: Callable[[Tensor, Tensor], Tensor] | None = None
    features: dict[str, Network] = field(default_factory=dict)
    facts: dict[str, dict[str, str]] = field(default_factory=dict)

    @torch.no_grad()
    def lpips_of(self, truth: Images, made: Images) -> Floats:
        """Return the LPIPS distance (…,) of pictures (…, S, S, 3) from true ones."""
        assert self.lpips is not None
        pairs = zip(_channels(truth).split(BATCH_SIZE), _channels(made).split(BATCH_SIZE))
        found = [self.lpips(one / 127.5 - 1, other / 127.5 - 1).flatten() for one, other in pairs]
        return torch.cat(found).double().numpy().reshape(truth.shape[:-3])


NO_NETWORKS = Networks()


def open_networks(
    lpips: StrPath | None = None, fid: StrPath | None = None, fvd: StrPath | None = None
) -> Networks:
    """Open networks, each `FILE#SHA256` (str or path).

    Raises:
        UsageError: a file is not there, is not the one of its hash, or is not TorchScript.
    """
    scripts: dict[str, Any] = {}
    facts: dict[str, dict[str, str]] = {}
    for metric, file in (("lpips", lpips), ("fid", fid), ("fvd", fvd)):
        if file is not None:
            scripts[metric], facts[metric] = open_script(file, metric)
    distance = scripts.pop("lpips", None)
    return Networks(distance, {name: _features(script) for name, script in scripts.items()}, facts)


def open_script(file: StrPath, metric: str) -> tuple[Any, dict[str, str]]:
    """Return the TorchScript module of `FILE#SHA256` in eval mode, and its file's name and hash.

    Raises:
        UsageError: as of `open_networks`.
    """
    option = f"--{metric}"
    name, _, stated = as_text(file).partition("#")
    path = Path(name).expanduser()
    if not path.is_file():
        raise UsageError(option, f"{name}: no such file", "give the path of the network's weights")
    found = file_sha256(path)
    if not stated:
        remedy = f"compare with its publisher's, and give {option} {name}#{found}"
        raise UsageError(option, f"{name} is given without its SHA-256, which is {found}", remedy)
    if found != stated.lower():
        raise UsageError(option, f"{name} has the SHA-256 {found}, not {stated}", "get the file again")
    try:
        script = torch.jit.load(path, map_location="cpu").eval()
    except Exception as fault:  # torch raises several kinds for a file that is not TorchScript
        raise UsageError(option, f"{name} is not TorchScript", f"give {REMEDIES[metric]}") from fault
    return script, {"file": Path(name).name, "sha256": found}


def _features(script: Any) -> Network:
    """Return a network of features; the published scripts name their options alike, but not all have all."""
    known = {argument.name for argument in script.forward.schema.arguments}
    wanted = {"rescale": False, "resize": False, "return_features": True}
    options = {name: value for name, value in wanted.items() if name in known}

    def features(x: Tensor) -> Tensor:
        return script(x, **options)

    return features


def _channels(pictures: Images) -> Tensor:
    """Return pictures (…, H, W, 3) as (N, 3, H, W) float32 of 0 to 255."""
    flat = pictures.reshape(-1, *pictures.shape[-3:])
    return torch.from_numpy(np.ascontiguousarray(flat)).permute(0, 3, 1, 2).float()


def stretched(frames: int) -> Ints:
    """Return the indices of the frames that I3D sees of a video."""
    if frames >= SHORT_VIDEO:
        return np.arange(frames)
    return np.round(np.linspace(0, frames - 1, STRETCHED_FRAMES)).astype(np.int64)


def as_video(pictures: Tensor) -> Tensor:
    """Scale and crop a video's pictures (T, 3, H, W) of 0 to 255 to (3, T, 224, 224) of -1 to 1."""
    height, width = pictures.shape[2:]
    scale = I3D_SIDE / min(height, width)
    size = [max(I3D_SIDE, round(height * scale)), max(I3D_SIDE, round(width * scale))]
    large = F.interpolate(pictures, size=size, mode="bilinear", align_corners=False)
    top, left = ((side - I3D_SIDE) // 2 for side in size)
    return (large[:, :, top : top + I3D_SIDE, left : left + I3D_SIDE] / 127.5 - 1).transpose(0, 1)


# -- Fréchet distances of features (N, D): Heusel et al. 2017


@dataclass
class Moments:
    """The count, mean (D,) and sum of outer products of deviations (D, D) of features."""

    count: int = 0
    mean: Any = 0.0
    scatter: Any = 0.0

    def add(self, features: NDArray[np.floating]) -> None:
        """Add features (N, D), as Chan et al. (1979) merge two sets."""
        values = features.astype(np.float64)
        mean = values.mean(axis=0)
        scatter = (values - mean).T @ (values - mean)
        total, apart = self.count + len(values), mean - self.mean
        self.scatter = self.scatter + scatter + np.outer(apart, apart) * (self.count * len(values) / total)
        self.mean = self.mean + apart * (len(values) / total)
        self.count = total

    @property
    def covariance(self) -> Floats:
        """Return the unbiased covariance (D, D)."""
        return self.scatter / (self.count - 1)

    @property
    def needed(self) -> int:
        """Return the least number of features whose covariance can have full rank."""
        return len(self.mean) + 1


def frechet_distance(one: Moments, other: Moments) -> float:
    """Return |m1 - m2|² + tr(C1 + C2 - 2 (C1 C2)^½) of two normal distributions."""
    values, vectors = np.linalg.eigh(one.covariance)
    root = (vectors * np.sqrt(values.clip(min=0))) @ vectors.T
    product = np.linalg.eigvalsh(root @ other.covariance @ root)
    apart = np.square(one.mean - other.mean).sum()
    traces = np.trace(one.covariance) + np.trace(other.covariance)
    return max(float(apart + traces - 2 * np.sqrt(product.clip(min=0)).sum()), 0.0)


# -- the judge


@dataclass
class FeatureCollector:
    """Collects features of the truth and of each kind of rollout, and compares them."""

    networks: Networks
    moments: dict[tuple[str, str], Moments] = field(default_factory=dict)

    @torch.no_grad()
    def add(self, kind: str, pictures: Images) -> None:
        """Add the predicted or true frames (B, T, S, S, 3) of some windows."""
        for metric, network in self.networks.features.items():
            if metric == "fid":
                parts = _channels(pictures).split(BATCH_SIZE)
            else:
                chosen = pictures[:, stretched(pictures.shape[1])]
                parts = tuple(as_video(_channels(video))[None] for video in chosen)
            features = torch.cat([network(part) for part in parts]).double().numpy()
            self.moments.setdefault((metric, kind), Moments()).add(features)

    def figures(self, horizon: int) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
        """Return the distances of each kind of rollout, and in words why a metric is absent.

        Args:
            horizon: predicted frames of a window.
        """
        found: dict[str, dict[str, Any]] = {}
        missing: dict[str, str] = {}
        for metric, remedy in REMEDIES.items():
            if metric not in self.networks.facts:
                missing[metric] = f"not measured, weights are missing: {remedy}"
        for (metric, kind), own in self.moments.items():
            true = self.moments[metric, "truth"]
            if true.count < true.needed:
                what, a_window = ("frames", horizon) if metric == "fid" else ("videos", 1)
                missing[metric] = (
                    f"not measured: {true.count:,} {what} are too few, its {true.needed - 1:,} features need "
                    f"{true.needed:,}: --windows {-(-true.needed // a_window)} or more"
                )
            elif kind != "truth":
                found.setdefault(kind, {})[metric] = round(frechet_distance(true, own), 4)
        return found, missing
