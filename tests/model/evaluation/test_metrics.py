"""Picture and token metrics against scikit-image and against their definitions."""

import math

import numpy as np
import pytest
import torch
from skimage.metrics import peak_signal_noise_ratio, structural_similarity

from hma_data.errors import UsageError
from hma_model.evaluation.metrics import perplexity, psnr, ssim, token_hits, token_nats


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


def test_ssim_of_a_smooth_picture_on_a_bright_ground_is_scikit_images():
    ramp = np.linspace(250, 255, 40)[None, :, None] * np.ones((40, 1, 3))
    truth, other = ramp.astype(np.uint8), (ramp - 1).astype(np.uint8)
    expected = structural_similarity(truth, other, data_range=255, channel_axis=2)
    assert ssim(truth, other) == pytest.approx(expected, rel=1e-6)


def test_equal_pictures_have_infinite_psnr_and_ssim_one(pictures):
    truth, _ = pictures
    assert np.isposinf(psnr(truth, truth)).all()
    np.testing.assert_allclose(ssim(truth, truth), 1.0)


def test_pictures_of_different_size_are_refused(pictures):
    truth, other = pictures
    with pytest.raises(UsageError, match="must both be"):
        psnr(truth, other[:, :-1])


def test_nats_are_those_of_the_joint_distribution():
    torch.manual_seed(0)
    logits = torch.randn(6, 2, 4)
    tokens = torch.arange(6) * 2 + 1
    low, high = logits.log_softmax(-1).unbind(1)
    joint = (high[:, :, None] + low[:, None, :]).flatten(1)
    expected = -joint.gather(1, tokens[:, None])[:, 0]
    torch.testing.assert_close(token_nats(logits, tokens, (4, 4)), expected)


def test_a_hit_needs_every_digit():
    logits = torch.zeros(3, 2, 4)
    logits[:, 0, 1] = logits[:, 1, 2] = 1.0
    right = 1 + 4 * 2
    assert token_hits(logits, torch.tensor([right, right + 1, right + 4]), (4, 4)).tolist() == [
        True,
        False,
        False,
    ]


def test_perplexity_does_not_overflow():
    assert perplexity(math.log(7)) == pytest.approx(7)
    assert perplexity(1e6) == math.inf
