"""Latents of other autoencoders: `taesd` and `taef2` from either layout of their weights, and `svd-vae`."""

import json
import shutil
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from torch.nn import functional

from hma_data.errors import MissingDependencyError, TokenizerError
from hma_data.tokenizers.base import Tokenizer, get_tokenizer
from hma_data.tokenizers.latents import read_tiny
from hma_data.tokenizers.training.eval import psnr_db
from tests.data.tokenizer_files import (
    altered,
    assert_contract,
    frames,
    tiny_halves,
    write_tiny_pair,
    write_tiny_whole,
)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_tiny_whole(tmp_path_factory.mktemp("taesd") / "tiny.safetensors")


@pytest.fixture(scope="module")
def tiny(weights: Path) -> Tokenizer:
    return get_tokenizer("taesd", weights=str(weights))


def square(picture: np.ndarray) -> np.ndarray:
    import cv2

    side = min(picture.shape[:2])
    top, left = (picture.shape[0] - side) // 2, (picture.shape[1] - side) // 2
    cut = picture[top : top + side, left : left + side]
    return cv2.resize(cut, (256, 256), interpolation=cv2.INTER_AREA)


@pytest.fixture(scope="module")
def taef2(real_data) -> Tokenizer:
    return get_tokenizer("taef2", weights=str(real_data / "weights"))


@pytest.mark.slow
@pytest.mark.real
def test_taef2_gives_a_robots_frames_back(real_data, taef2):
    import av

    video = next((real_data / "lerobot" / "g1_v21" / "videos").rglob("*.mp4"))
    with av.open(str(video)) as container:
        shot = [f.to_ndarray(format="rgb24") for f, _ in zip(container.decode(video=0), range(60))][::30]
    true = np.stack([square(picture) for picture in shot])
    latents = taef2.encode(true)
    assert latents.shape == (2, 32, 32, 32) and latents.dtype == np.float16
    assert 0.5 < latents.astype(np.float32).std() < 1.5  # what a latent scale of 1 promises
    assert psnr_db(true, taef2.decode(latents)).min() > 34


@pytest.mark.parametrize("pooled", [0, 16])
def test_the_network_is_the_one_written_out(tmp_path, pooled):
    encoder, decoder = tiny_halves(width=8, pooled=pooled)
    network = read_tiny(
        [write_tiny_pair(tmp_path, pooled=pooled) / f"taesd_{half}.pth" for half in ("encoder", "decoder")]
    )

    def conv(state, name, x, stride=1):
        return functional.conv2d(x, state[f"{name}.weight"], state.get(f"{name}.bias"), stride, padding=1)

    def block(state, place, x):
        if pooled:
            branch = functional.conv2d(x, state[f"{place}.pool.0.weight"])
            branch = torch.relu(functional.group_norm(branch, 4))
            x = x + functional.conv2d(branch, state[f"{place}.pool.3.weight"])
        h = torch.relu(conv(state, f"{place}.conv.0", x))
        h = torch.relu(conv(state, f"{place}.conv.2", h))
        return torch.relu(x + conv(state, f"{place}.conv.4", h))

    pixels = torch.rand(2, 3, 32, 48, generator=torch.Generator().manual_seed(1))
    x = block(encoder, 1, conv(encoder, 0, pixels))
    for place in (2, 4, 6):
        x = block(encoder, place + 1, conv(encoder, place, x, stride=2))
    latents = conv(encoder, 8, x)
    y = torch.relu(conv(decoder, 1, 3 * torch.tanh(latents / 3)))
    for place in (3, 6, 9):
        y = block(decoder, place, y).repeat_interleave(2, 2).repeat_interleave(2, 3)
        y = conv(decoder, place + 2, y)
    made = conv(decoder, 13, block(decoder, 12, y))
    with torch.inference_mode():
        ours = network.encoder(pixels * 2 - 1)
        torch.testing.assert_close(ours, latents, atol=1e-5, rtol=1e-5)
        torch.testing.assert_close(network.decoder(latents), made * 2 - 1, atol=1e-5, rtol=1e-5)
    assert latents.shape == (2, 4, 4, 6)


@pytest.mark.slow
def test_it_is_diffusers_autoencoder_tiny(tmp_path):
    import diffusers

    torch.manual_seed(0)
    sizes = {"encoder_block_out_channels": (16,) * 4, "decoder_block_out_channels": (24,) * 4}
    theirs = diffusers.AutoencoderTiny(**sizes, num_encoder_blocks=(1, 2, 1, 1)).eval()
    theirs.save_pretrained(tmp_path)
    network = get_tokenizer("taesd", weights=str(tmp_path)).network
    pixels = torch.rand(2, 3, 64, 96) * 2 - 1
    with torch.inference_mode():
        latents = theirs.encode(pixels).latents
        torch.testing.assert_close(network.encoder(pixels), latents)
        torch.testing.assert_close(network.decoder(latents), theirs.decode(latents).sample)


def test_both_layouts_are_one_network(tmp_path, tiny):
    for weights in (write_tiny_pair(tmp_path), tmp_path / "taesd_decoder.pth"):
        other = get_tokenizer("taesd", weights=str(weights))
        latents = other.encode(frames(2))
        assert np.array_equal(latents, tiny.encode(frames(2)))
        assert np.array_equal(other.decode(latents), tiny.decode(latents))


def test_it_keeps_the_contract(tiny):
    spec = tiny.spec
    assert_contract(tiny, frames(3))
    assert (spec.kind, spec.grid, spec.channels, spec.dtype) == ("continuous", (32, 32), 4, "float16")
    assert spec.latent_scale == 1 and len(spec.weights_sha256) == 64


def test_a_frame_has_the_same_latents_in_any_company_and_on_any_number_of_threads(tiny):
    pictures = frames(6)
    before = torch.get_num_threads()
    try:
        torch.set_num_threads(1)
        whole = tiny.encode(pictures)
        for threads in (2, 5):
            torch.set_num_threads(threads)
            assert np.array_equal(tiny.encode(pictures), whole)
            assert np.array_equal(tiny.encode(pictures[2:3]), whole[2:3])
    finally:
        torch.set_num_threads(before)


def test_a_pair_is_known_by_both_its_files(tmp_path):
    first = get_tokenizer("taesd", weights=str(write_tiny_pair(tmp_path))).spec
    state = torch.load(tmp_path / "taesd_decoder.pth", weights_only=True)
    torch.save({key: tensor + 1 for key, tensor in state.items()}, tmp_path / "taesd_decoder.pth")
    second = get_tokenizer("taesd", weights=str(tmp_path)).spec
    assert first.weights_sha256 != second.weights_sha256


def test_the_scale_of_a_config_beside_diffusers_weights_is_kept(tmp_path):
    write_tiny_whole(tmp_path / "diffusion_pytorch_model.safetensors")
    (tmp_path / "config.json").write_text(json.dumps({"scaling_factor": 0.5, "act_fn": "relu"}))
    assert get_tokenizer("taesd", weights=str(tmp_path)).spec.latent_scale == 0.5


@pytest.mark.parametrize("stated", [{"scaling_factor": 0}, {"scaling_factor": "one"}])
def test_a_config_without_a_usable_scale_is_refused(tmp_path, stated):
    write_tiny_whole(tmp_path / "diffusion_pytorch_model.safetensors")
    (tmp_path / "config.json").write_text(json.dumps(stated))
    with pytest.raises(TokenizerError, match=next(iter(stated))):
        get_tokenizer("taesd", weights=str(tmp_path))


def test_latents_of_another_width_are_refused(tmp_path):
    path = write_tiny_whole(tmp_path / "wide.safetensors", channels=16)
    with pytest.raises(TokenizerError, match="16 channels, taesd has 4"):
        get_tokenizer("taesd", weights=str(path))


def test_half_a_pair_is_refused(tmp_path):
    write_tiny_pair(tmp_path)
    (tmp_path / "taesd_decoder.pth").unlink()
    with pytest.raises(TokenizerError, match=r"taesd_decoder\.pth: is missing"):
        get_tokenizer("taesd", weights=str(tmp_path / "taesd_encoder.pth"))
    with pytest.raises(TokenizerError, match=r"taesd_decoder\.pth: is missing"):
        get_tokenizer("taesd", weights=str(tmp_path))
    with pytest.raises(TokenizerError, match="holds none of"):
        get_tokenizer("taef2", weights=str(tmp_path))


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"encoder.layers.1.conv.2.weight": None}, r"Missing key.*encoder\.layers\.1\.conv\.2\.weight"),
        ({"encoder.layers.1.attention.weight": torch.zeros(2)}, r"attention\.weight"),
        ({"quant_conv.weight": torch.zeros(2)}, r"quant_conv\.weight"),
        ({"encoder.layers.0.weight": torch.zeros(8)}, "does not hold the weights"),
        ({"encoder.layers.1.conv.2.bias": torch.full((8,), torch.inf)}, "not finite"),
        ({"decoder.layers.11.conv.2.weight": torch.zeros(8, 8, 1, 1)}, r"size mismatch for decoder\.layers"),
    ],
)
def test_weights_of_another_network_are_refused_by_name(tmp_path, weights, changes, named):
    save_file(altered(load_file(weights), changes), tmp_path / "other.safetensors")
    with pytest.raises(TokenizerError, match=named) as caught:
        get_tokenizer("taesd", weights=str(tmp_path / "other.safetensors"))
    assert "other.safetensors" in str(caught.value)


def test_latents_too_large_to_store_are_refused(tmp_path, weights):
    state = load_file(weights)
    state["encoder.layers.8.bias"] = torch.full((4,), 1e6)
    save_file(state, tmp_path / "loud.safetensors")
    with pytest.raises(TokenizerError, match="too large for float16"):
        get_tokenizer("taesd", weights=str(tmp_path / "loud.safetensors")).encode(frames(1))


@pytest.mark.real
def test_the_pair_may_lie_among_other_files(real_data, tmp_path):
    for half in ("encoder", "decoder"):
        shutil.copy(real_data / "weights" / f"taef2_{half}.pth", tmp_path)
    (tmp_path / "config.json").write_text('{"act_fn": "gelu"}')  # somebody else's
    assert get_tokenizer("taef2", weights=str(tmp_path)).spec.channels == 32


# -- svd-vae


SVD_NAME = "diffusion_pytorch_model.safetensors"


@pytest.fixture(scope="module")
def svd_theirs():
    import diffusers

    torch.manual_seed(0)
    return diffusers.AutoencoderKLTemporalDecoder(
        down_block_types=("DownEncoderBlock2D",) * 4, block_out_channels=(32, 32, 64, 64), layers_per_block=1
    ).eval()


@pytest.fixture(scope="module")
def svd_folder(svd_theirs, tmp_path_factory):
    path = tmp_path_factory.mktemp("svd")
    svd_theirs.save_pretrained(path)
    return path


@pytest.fixture(scope="module")
def svd(svd_folder) -> Tokenizer:
    return get_tokenizer("svd-vae", weights=str(svd_folder))


def test_without_diffusers_the_command_that_installs_it_is_named(tmp_path, monkeypatch):
    save_file({"a": torch.ones(1)}, tmp_path / SVD_NAME)
    monkeypatch.setitem(sys.modules, "diffusers", None)
    with pytest.raises(MissingDependencyError, match="uv sync --inexact --extra svd"):
        get_tokenizer("svd-vae", weights=str(tmp_path))


@pytest.mark.slow
def test_latents_are_the_unscaled_mean_of_the_posterior_and_frames_are_decoded_one_by_one(svd, svd_theirs):
    pictures = frames(2)
    pixels = torch.from_numpy(pictures).permute(0, 3, 1, 2).float() / 127.5 - 1
    with torch.inference_mode():
        mean = svd_theirs.encode(pixels).latent_dist.mean.numpy()
    latents = svd.encode(pictures)
    np.testing.assert_allclose(latents, mean, atol=1e-3)
    spec = svd.spec
    assert (spec.kind, spec.grid, spec.channels, spec.dtype) == ("continuous", (32, 32), 4, "float16")
    assert spec.latent_scale == 0.18215
    with torch.inference_mode():
        single = [svd_theirs.decode(torch.from_numpy(z[None]).float(), num_frames=1).sample for z in latents]
    expected = ((torch.cat(single).clamp(-1, 1) + 1) * 127.5).permute(0, 2, 3, 1).numpy()
    assert np.abs(svd.decode(latents) - expected).max() <= 0.51


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
def test_weights_of_another_network_than_svds_are_refused_by_name(svd_folder, tmp_path, changes, named):
    save_file(altered(load_file(svd_folder / SVD_NAME), changes), tmp_path / SVD_NAME)
    with pytest.raises(TokenizerError, match=named):
        get_tokenizer("svd-vae", weights=str(tmp_path))
