"""The embedded continuous tokenizer: its latents, its file, its training."""

import numpy as np
import pytest
import torch

from hma_data.errors import TokenizerError
from hma_data.tokenizers.base import Tokenizer, get_tokenizer
from hma_data.tokenizers.catalog import EMBEDDED
from hma_data.tokenizers.checkpoints import read_weights, save_weights
from hma_data.tokenizers.embedded import VaeAutoencoder
from hma_data.tokenizers.shapes import VaeConfig
from hma_data.tokenizers.training.eval import evaluate, psnr_db
from hma_data.tokenizers.training.train import train
from tests.data.tokenizer_files import draw_scene, write_recipe

FORMAT, WEIGHTS = VaeConfig.format, EMBEDDED / "vae.safetensors"
SMALL = VaeConfig(width=8, hidden=8, encoder_blocks=1, decoder_blocks=(1, 1), fine_width=4)


@pytest.fixture(scope="module")
def vae() -> Tokenizer:
    return get_tokenizer("vae-8")


@pytest.fixture(scope="module")
def frames() -> np.ndarray:
    rng = np.random.default_rng(6)
    return np.stack([draw_scene(rng, 256) for _ in range(9)])


def test_its_latents_are_four_channels_at_an_eighth(vae):
    spec = vae.spec
    assert (spec.kind, spec.channels, spec.grid, spec.dtype) == ("continuous", 4, (32, 32), "float16")


def test_scaled_latents_have_about_unit_variance(vae, frames):
    scaled = vae.encode(frames).astype(np.float64) * vae.spec.latent_scale
    assert 0.6 < scaled.std() < 1.6 and abs(scaled.mean()) < 0.5


def test_near_latents_decode_to_near_pictures(vae, frames):
    latents = vae.encode(frames)
    noise = np.random.default_rng(0).normal(0, 0.05, latents.shape)
    plain, moved = vae.decode(latents), vae.decode((latents + noise).astype(np.float16))
    assert psnr_db(plain, moved).mean() > 30


@pytest.mark.parametrize("shape", [(1, 4, 16, 16), (1, 3, 32, 32), (4, 32, 32)])
def test_latents_of_another_shape_are_refused(vae, shape):
    with pytest.raises(TokenizerError, match="decodes"):
        vae.decode(np.zeros(shape, np.float16))


def test_weights_of_the_discrete_tokenizer_are_refused():
    with pytest.raises(TokenizerError, match=r"does not hold hma-vae-1 weights \(format 'hma-fsq-1'\)"):
        get_tokenizer("vae-8", weights=str(EMBEDDED / "fsq.safetensors"))


def test_the_scale_belongs_to_the_spec(tmp_path):
    digests = set()
    for scale in (1.0, 0.5):
        config = VaeConfig(**{**SMALL.model_dump(), "decoder_blocks": (1, 1), "latent_scale": scale})
        torch.manual_seed(0)
        path = tmp_path / f"{scale}.safetensors"
        save_weights(path, FORMAT, config, dict(VaeAutoencoder(config).named_parameters()), {})
        tokenizer = get_tokenizer("vae-8", weights=str(path))
        assert tokenizer.spec.latent_scale == scale
        digests.add(tokenizer.spec.digest)
    assert len(digests) == 2


def test_training_measures_the_scale_of_the_latents(tmp_path):
    network = SMALL.model_dump(exclude={"latent_scale"})
    recipe = write_recipe(tmp_path, network, pictures=6, steps=8)
    train(recipe, tmp_path / "w", report=lambda _: None)
    config, _, _ = read_weights(tmp_path / "w", FORMAT, VaeConfig)
    assert config.latent_scale != 1.0
    result = evaluate(
        get_tokenizer("vae-8", weights=str(tmp_path / "w")),
        [np.stack([draw_scene(np.random.default_rng(1), 256)])],
    )
    assert 0.3 < result["latent_std_scaled"] < 3
