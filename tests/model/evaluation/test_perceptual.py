"""LPIPS, FID and FVD against scipy, PSNR and SSIM, the files of the networks."""

import math
import warnings
from pathlib import Path

import numpy as np
import pytest
import torch
from scipy.linalg import sqrtm
from scipy.ndimage import map_coordinates
from skimage.metrics import peak_signal_noise_ratio, structural_similarity
from torch import Tensor, nn

from hma_data.errors import UsageError
from hma_data.storage.files import file_sha256
from hma_model.evaluation.metrics import perplexity, psnr, ssim
from hma_model.evaluation.perceptual import (
    FeatureCollector,
    Moments,
    Networks,
    as_video,
    frechet_distance,
    open_networks,
    open_script,
    stretched,
)


def rng(seed: int = 0) -> np.random.Generator:
    return np.random.default_rng(seed)


def test_the_distance_is_that_of_scipys_matrix_root() -> None:
    one, other = (
        rng(1).normal(size=(90, 12)),
        1.5 * rng(2).normal(size=(70, 12)) @ rng(3).normal(size=(12, 12)),
    )
    found = [Moments(), Moments()]
    found[0].add(one)
    for part in np.array_split(other, 4):
        found[1].add(part)
    c1, c2 = np.cov(one.T), np.cov(other.T)
    apart = np.square(one.mean(axis=0) - other.mean(axis=0)).sum()
    expected = apart + np.trace(c1 + c2 - 2 * sqrtm(c1 @ c2).real)
    assert frechet_distance(*found) == pytest.approx(expected, rel=1e-9)
    assert np.allclose(found[1].covariance, c2, rtol=1e-10)


def test_equal_and_constant_features_are_no_distance_apart() -> None:
    still, moved = Moments(), Moments()
    still.add(np.ones((5, 3)))
    moved.add(np.full((5, 3), 3.0))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert frechet_distance(still, still) == 0 and frechet_distance(still, moved) == pytest.approx(12)


def test_videos_are_scaled_as_scipy_interpolates() -> None:
    pictures = torch.tensor(rng().uniform(0, 255, (2, 3, 24, 40)))
    found = as_video(pictures)
    assert found.shape == (3, 2, 224, 224)
    width = round(40 * 224 / 24)
    rows = (np.arange(224) + 0.5) * 24 / 224 - 0.5
    columns = (np.arange(width) + 0.5) * 40 / width - 0.5
    left = (width - 224) // 2
    places = np.meshgrid(rows, columns[left : left + 224], indexing="ij")
    for frame in range(2):
        expected = map_coordinates(pictures[frame, 1].numpy(), places, order=1, mode="nearest")
        assert np.allclose(found[1, frame].numpy(), expected / 127.5 - 1, atol=1e-9)


def test_short_videos_are_stretched_to_sixteen_frames() -> None:
    assert stretched(10).tolist() == list(range(10))
    six = stretched(6)
    assert len(six) == 16 and set(six) == set(range(6)) and (np.diff(six) >= 0).all()


class Means(nn.Module):
    """Features of pictures or videos: their channels' means."""

    def forward(self, x: Tensor, return_features: bool = False) -> Tensor:
        return x.flatten(2).mean(dim=2)


class Apart(nn.Module):
    """A distance: the largest difference of two pictures."""

    def forward(self, one: Tensor, other: Tensor) -> Tensor:
        return (one - other).abs().flatten(1).amax(dim=1)


def pinned(path: Path) -> str:
    return f"{path}#{file_sha256(path)}"


@pytest.fixture
def script(tmp_path: Path) -> Path:
    torch.jit.script(Means()).save(str(tmp_path / "means.pt"))
    return tmp_path / "means.pt"


def test_a_file_without_its_hash_or_with_another_one_is_refused(script: Path) -> None:
    found = file_sha256(script)
    with pytest.raises(UsageError, match=f"is given without its SHA-256, which is {found} — .*#{found}"):
        open_script(script, "fid")
    with pytest.raises(UsageError, match="has the SHA-256"):
        open_script(f"{script}#{'0' * 64}", "fid")
    with pytest.raises(UsageError, match="no such file"):
        open_script(script.parent / "none.pt", "fid")


def test_a_file_that_is_no_torchscript_is_refused_with_how_to_get_one(tmp_path: Path) -> None:
    torch.save({"a.weight": torch.rand(3)}, tmp_path / "a.pth")
    with pytest.raises(UsageError, match=r"is not TorchScript — give --lpips .*jit.trace of lpips"):
        open_networks(lpips=pinned(tmp_path / "a.pth"))


def test_lpips_takes_pairs_of_pictures_from_minus_one_to_one(tmp_path: Path) -> None:
    torch.jit.trace(Apart(), (torch.zeros(1, 3, 4, 4),) * 2).save(str(tmp_path / "apart.pt"))
    networks = open_networks(lpips=pinned(tmp_path / "apart.pt"))
    black, white = np.zeros((40, 4, 4, 3), np.uint8), np.full((40, 4, 4, 3), 255, np.uint8)
    assert networks.lpips_of(black, white) == pytest.approx(np.full(40, 2.0))


def test_distances_are_of_all_pictures_and_too_few_are_refused_with_the_number(script: Path) -> None:
    opened = open_networks(fid=pinned(script), fvd=pinned(script))
    truth, made = rng().integers(0, 255, (2, 6, 4, 16, 16, 3)).astype(np.uint8)
    judge = FeatureCollector(opened)
    for part in (slice(0, 3), slice(3, 6)):
        judge.add("truth", truth[part])
        judge.add("true", made[part])
    found, missing = judge.figures(4)
    features = [x.reshape(24, -1, 3).mean(axis=1) for x in (truth, made)]
    c1, c2 = (np.cov(x.T) for x in features)
    expected = np.square(features[0].mean(axis=0) - features[1].mean(axis=0)).sum()
    expected += np.trace(c1 + c2 - 2 * sqrtm(c1 @ c2).real)
    assert found["true"]["fid"] == pytest.approx(expected, rel=1e-3) and found["true"]["fvd"] > 0
    assert list(missing) == ["lpips"] and "--lpips FILE" in missing["lpips"]
    few = FeatureCollector(Networks(features={"fvd": opened.features["fvd"]}, facts=opened.facts))
    few.add("truth", truth[:3])
    few.add("true", made[:3])
    found, missing = few.figures(4)
    assert not found and "3 videos are too few, its 3 features need 4: --windows 4" in missing["fvd"]


@pytest.fixture
def pictures() -> tuple[np.ndarray, np.ndarray]:
    rng = np.random.default_rng(0)
    truth = rng.integers(0, 256, (3, 24, 31, 3), dtype=np.uint8)
    noise = rng.integers(-30, 31, truth.shape)
    return truth, np.clip(truth.astype(int) + noise, 0, 255).astype(np.uint8)


@pytest.mark.parametrize(
    ("ours", "theirs", "options"),
    [(psnr, peak_signal_noise_ratio, {}), (ssim, structural_similarity, {"channel_axis": 2})],
)
def test_psnr_and_ssim_are_scikit_images(pictures, ours, theirs, options):
    expected = [theirs(a, b, data_range=255, **options) for a, b in zip(*pictures)]
    np.testing.assert_allclose(ours(*pictures), expected, rtol=1e-9)
    equal = np.inf if ours is psnr else 1.0
    np.testing.assert_allclose(ours(pictures[0], pictures[0]), equal)


def test_ssim_of_a_smooth_picture_on_a_bright_ground_is_scikit_images():
    ramp = np.linspace(250, 255, 40)[None, :, None] * np.ones((40, 1, 3))
    truth, other = ramp.astype(np.uint8), (ramp - 1).astype(np.uint8)
    expected = structural_similarity(truth, other, data_range=255, channel_axis=2)
    assert ssim(truth, other) == pytest.approx(expected, rel=1e-6)


def test_pictures_of_different_size_are_refused(pictures):
    truth, other = pictures
    for of_other_shape in (other[:, :-1], other[:, :1]):  # the second would broadcast
        with pytest.raises(UsageError, match="must both be"):
            psnr(truth, of_other_shape)


def test_perplexity_does_not_overflow():
    assert perplexity(math.log(7)) == pytest.approx(7)
    assert perplexity(1e6) == math.inf
