"""`svd-vae`: diffusers' autoencoder of Stable Video Diffusion, with small random weights."""

import json
import sys

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from hma_data.errors import MissingDependencyError, TokenizerError
from hma_data.tokenizers.base import Tokenizer, TokenizerSpec, get_tokenizer
from hma_data.tokenizers.latents import derive_svd_config
from tests.data.tokenizer_files import altered, frames

NAME = "diffusion_pytorch_model.safetensors"


@pytest.fixture(scope="module")
def theirs():
    import diffusers

    torch.manual_seed(0)
    return diffusers.AutoencoderKLTemporalDecoder(
        down_block_types=("DownEncoderBlock2D",) * 4, block_out_channels=(32, 32, 64, 64), layers_per_block=1
    ).eval()


@pytest.fixture(scope="module")
def folder(theirs, tmp_path_factory):
    path = tmp_path_factory.mktemp("svd")
    theirs.save_pretrained(path)
    return path


@pytest.fixture(scope="module")
def tokenizer(folder) -> Tokenizer:
    return get_tokenizer("svd-vae", weights=str(folder))


def test_without_diffusers_the_command_that_installs_it_is_named(tmp_path, monkeypatch):
    save_file({"a": torch.ones(1)}, tmp_path / NAME)
    monkeypatch.setitem(sys.modules, "diffusers", None)
    with pytest.raises(MissingDependencyError, match="uv sync --inexact --extra svd"):
        get_tokenizer("svd-vae", weights=str(tmp_path))


@pytest.mark.slow
def test_sizes_are_read_off_the_weights(folder, theirs):
    derived = derive_svd_config(load_file(folder / NAME))
    assert all(tuple(np.atleast_1d(theirs.config[k])) == tuple(np.atleast_1d(v)) for k, v in derived.items())


@pytest.mark.slow
def test_latents_are_the_unscaled_mean_of_the_posterior(tokenizer, theirs):
    pictures = frames(2)
    pixels = torch.from_numpy(pictures).permute(0, 3, 1, 2).float() / 127.5 - 1
    with torch.inference_mode():
        mean = theirs.encode(pixels).latent_dist.mean.numpy()
    latents = tokenizer.encode(pictures)
    assert latents.shape == (2, 4, 32, 32) and latents.dtype == np.float16
    np.testing.assert_allclose(latents, mean, atol=1e-3)
    assert tokenizer.spec.latent_scale == 0.18215


@pytest.mark.slow
def test_frames_are_decoded_one_by_one(tokenizer, theirs):
    latents = tokenizer.encode(frames(2))
    with torch.inference_mode():
        single = [theirs.decode(torch.from_numpy(z[None]).float(), num_frames=1).sample for z in latents]
    expected = ((torch.cat(single).clamp(-1, 1) + 1) * 127.5).permute(0, 2, 3, 1).numpy()
    assert np.abs(tokenizer.decode(latents) - expected).max() <= 0.51


@pytest.mark.slow
def test_it_keeps_the_contract(tokenizer):
    spec = tokenizer.spec
    assert isinstance(tokenizer, Tokenizer) and TokenizerSpec.from_json(spec.to_json()) == spec
    assert (spec.kind, spec.grid, spec.channels, spec.dtype) == ("continuous", (32, 32), 4, "float16")
    pictures = frames(3)
    whole = tokenizer.encode(pictures)
    assert np.array_equal(np.concatenate([tokenizer.encode(p[None]) for p in pictures]), whole)
    assert {"encoder", "decoder"} <= {name for name, _ in tokenizer.network.named_children()}


@pytest.mark.slow
def test_another_scale_in_the_config_is_kept(folder, tmp_path):
    save_file(load_file(folder / NAME), tmp_path / NAME)
    (tmp_path / "config.json").write_text(json.dumps({"scaling_factor": 0.5}))
    assert get_tokenizer("svd-vae", weights=str(tmp_path)).spec.latent_scale == 0.5


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"decoder.time_conv_out.weight": None}, r"decoder\.time_conv_out\.weight"),
        ({"encoder.conv_in.bias": None}, r"Missing key.*encoder\.conv_in\.bias"),
        ({"post_quant_conv.weight": torch.ones(1)}, r"post_quant_conv\.weight"),
        ({"quant_conv.weight": torch.ones(1, 8)}, "the weights of an AutoencoderKL|does not fit the network"),
        (
            {"encoder.down_blocks.0.resnets.0.conv1.weight": torch.ones(30, 3, 3, 3)},
            "the weights of an AutoencoderKL",
        ),
    ],
)
def test_weights_of_another_network_are_refused_by_name(folder, tmp_path, changes, named):
    save_file(altered(load_file(folder / NAME), changes), tmp_path / NAME)
    with pytest.raises(TokenizerError, match=named):
        get_tokenizer("svd-vae", weights=str(tmp_path))
