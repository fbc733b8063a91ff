"""`magvit2`: the released tokenizer's ids and pictures, from any checkpoint of its kind."""

from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import Tensor
from torch.nn import functional

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.errors import TokenizerError
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.preview import tokenizer_of
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.tokenizers.base import Tokenizer, get_tokenizer
from hma_data.tokenizers.magvit2 import Magvit2, Magvit2Config, derive_config, read_network
from tests.conftest import write_toy
from tests.data.tokenizer_files import (
    TINY_MAGVIT2,
    altered,
    assert_contract,
    frames,
    magvit2_state,
    randomized,
    write_magvit2,
)


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_magvit2(tmp_path_factory.mktemp("magvit2") / "tiny.safetensors")


@pytest.fixture(scope="module")
def tiny(weights: Path) -> Tokenizer:
    return get_tokenizer("magvit2", weights=str(weights))


# -- against the released code


@pytest.mark.real
def test_ids_and_pictures_are_those_of_the_released_code(real_data):
    folder = real_data / "parity" / "magvit2"
    known = np.load(folder / "io.npz")
    network = get_tokenizer("magvit2", weights=str(folder)).network
    with torch.inference_mode():
        latents = network.encoder(torch.from_numpy(known["images"]))
        ids = network.to_ids(latents).numpy()
        decoded = network.decoder(network.from_ids(torch.from_numpy(known["indices"]))).numpy()
    assert np.abs(latents.numpy() - known["pre_quant"]).max() < 1e-4
    certain = (np.abs(known["pre_quant"]) > 1e-4).all(axis=1)
    assert certain.any() and np.array_equal(ids[certain], known["indices"][certain])
    assert np.abs(decoded - known["decoded"]).max() < 1e-4


def test_bit_c_of_an_id_is_the_sign_of_channel_c():
    network = Magvit2(TINY_MAGVIT2)
    latents = np.random.default_rng(0).normal(size=(2, 18, 3, 5)).astype(np.float32)
    latents[0, :, 0, 0] = 0  # zero is not above zero
    expected = np.zeros((2, 3, 5), np.int64)
    for channel in range(18):
        expected += (latents[:, channel] > 0) * 2**channel
    ids = network.to_ids(torch.from_numpy(latents))
    assert np.array_equal(ids.numpy(), expected) and expected[0, 0, 0] == 0
    assert np.array_equal(network.from_ids(ids).numpy(), np.where(latents > 0, 1, -1))


def test_the_low_digit_is_the_first_nine_channels(tiny):
    assert tiny.spec.factored == (512, 512)
    codes = -torch.ones(1, 18, 1, 1)
    codes[:, :9] = 1
    assert int(tiny.network.to_ids(codes)) == 511
    assert int(tiny.network.to_ids(-codes)) == 511 * 512


def swish(x: Tensor) -> Tensor:
    return x * torch.sigmoid(x)


def norm(state: dict[str, Tensor], name: str, x: Tensor) -> Tensor:
    grouped = x.view(x.shape[0], 32, -1)
    mean, variance = grouped.mean(2, keepdim=True), grouped.var(2, unbiased=False, keepdim=True)
    whole = ((grouped - mean) / (variance + 1e-6).sqrt()).view_as(x)
    return whole * state[f"{name}.weight"][:, None, None] + state[f"{name}.bias"][:, None, None]


def conv(state: dict[str, Tensor], name: str, x: Tensor, stride: int = 1) -> Tensor:
    weight = state[f"{name}.weight"]
    return functional.conv2d(x, weight, state.get(f"{name}.bias"), stride, weight.shape[-1] // 2)


def block(state: dict[str, Tensor], name: str, x: Tensor) -> Tensor:
    h = conv(state, f"{name}.conv1", swish(norm(state, f"{name}.norm1", x)))
    h = conv(state, f"{name}.conv2", swish(norm(state, f"{name}.norm2", h)))
    return h + (conv(state, f"{name}.nin_shortcut", x) if f"{name}.nin_shortcut.weight" in state else x)


def stated_encoder(state: dict[str, Tensor], config: Magvit2Config, x: Tensor) -> Tensor:
    x = conv(state, "encoder.conv_in", x)
    for level in range(len(config.mult)):
        for i in range(config.res_blocks):
            x = block(state, f"encoder.down.{level}.block.{i}", x)
        if level < len(config.mult) - 1:
            x = conv(state, f"encoder.down.{level}.downsample", x, stride=2)
    for i in range(config.res_blocks):
        x = block(state, f"encoder.mid_block.{i}", x)
    return conv(state, "encoder.conv_out", swish(norm(state, "encoder.norm_out", x)))


def stated_decoder(state: dict[str, Tensor], config: Magvit2Config, codes: Tensor) -> Tensor:
    x = conv(state, "decoder.conv_in", codes)
    for i in range(config.res_blocks):
        x = block(state, f"decoder.mid_block.{i}", x)
    for level in reversed(range(len(config.mult))):
        for i in range(config.res_blocks):
            x = block(state, f"decoder.up.{level}.block.{i}", x)
        if level:
            x = depth_to_space(conv(state, f"decoder.up.{level}.upsample.conv1", x))
    return conv(state, "decoder.conv_out", swish(norm(state, "decoder.norm_out", x)))


def depth_to_space(x: Tensor) -> Tensor:
    """Channel k·C + c goes to row k // 2, column k % 2 of each 2×2 cell of channel c."""
    width = x.shape[1] // 4
    made = x.new_empty(x.shape[0], width, 2 * x.shape[2], 2 * x.shape[3])
    for k in range(4):
        made[:, :, k // 2 :: 2, k % 2 :: 2] = x[:, k * width : (k + 1) * width]
    return made


@pytest.mark.parametrize(
    "config",
    [
        Magvit2Config(base=32, z=18, mult=(1, 1, 2, 2, 4), res_blocks=2),
        Magvit2Config(base=64, z=13, mult=(1, 1, 3), res_blocks=1),
    ],
    ids=["released", "odd"],
)
def test_the_network_is_the_one_written_out(config):
    state = magvit2_state(config)
    network = randomized(Magvit2(config))
    pixels = torch.rand(2, 3, 32, 48, generator=torch.Generator().manual_seed(1)) * 2 - 1
    with torch.inference_mode():
        latents = network.encoder(pixels)
        torch.testing.assert_close(latents, stated_encoder(state, config, pixels), atol=1e-4, rtol=1e-4)
        codes = torch.where(latents > 0, 1.0, -1.0)
        made = network.decoder(codes)
        torch.testing.assert_close(made, stated_decoder(state, config, codes), atol=1e-4, rtol=1e-4)
    assert latents.shape == (2, config.z, 32 // config.stride, 48 // config.stride)
    assert made.shape == pixels.shape


def test_sizes_are_read_off_the_weights():
    config = Magvit2Config(base=64, z=14, mult=(1, 3, 2), res_blocks=3)
    with torch.device("meta"):
        state = dict(Magvit2(config).named_parameters())
    assert derive_config(state) == config


def test_names_are_those_of_the_release():
    with torch.device("meta"):
        names = {name for name, _ in Magvit2(Magvit2Config()).named_parameters()}
    assert {
        "encoder.conv_in.weight",
        "encoder.down.3.downsample.bias",
        "encoder.down.4.block.0.nin_shortcut.weight",
        "encoder.mid_block.1.norm2.bias",
        "decoder.up.1.upsample.conv1.weight",
        "decoder.up.3.block.0.nin_shortcut.weight",
        "decoder.norm_out.weight",
    } <= names
    assert "encoder.conv_in.bias" not in names and "encoder.down.4.downsample.weight" not in names
    assert "decoder.up.0.upsample.conv1.weight" not in names


def test_it_keeps_the_contract(tiny):
    spec, made = tiny.spec, assert_contract(tiny, frames(3))
    assert (spec.kind, spec.grid, spec.vocab_size, spec.dtype) == ("discrete", (16, 16), 2**18, "uint32")
    tokens = tiny.encode(frames(3))
    assert tokens.max() < 2**18 and len(np.unique(tokens)) > 100
    assert np.array_equal(made, tiny.decode(tokens.astype(np.int64)))


def test_frames_are_encoded_as_the_network_does(tiny):
    pictures = frames(2)
    pixels = torch.from_numpy(pictures).permute(0, 3, 1, 2).float() / 127.5 - 1
    with torch.inference_mode():
        latents = tiny.network.encoder(pixels)
        made = tiny.network.decoder(torch.where(latents > 0, 1.0, -1.0))
    certain = (latents.abs() > 1e-4).all(1).numpy()
    tokens = tiny.encode(pictures)
    assert np.array_equal(tokens[certain], tiny.network.to_ids(latents).numpy()[certain])
    expected = ((made.clamp(-1, 1) + 1) * 127.5).permute(0, 2, 3, 1).numpy()
    assert np.abs(tiny.decode(tiny.network.to_ids(latents).numpy()) - expected).max() <= 0.51


def test_a_trainers_checkpoint_is_stripped_to_the_network(tmp_path, tiny):
    state = magvit2_state()
    named = {f"module.{name}": tensor for name, tensor in state.items()}
    extra = {"module.loss.discriminator.main.0.weight": torch.ones(2), "module.quantize.mask": torch.ones(18)}
    torch.save({"state_dict": named | extra, "epoch": 3, "optimizer_states": []}, tmp_path / "a.ckpt")
    other = get_tokenizer("magvit2", weights=str(tmp_path / "a.ckpt"))
    assert np.array_equal(other.encode(frames(1)), tiny.encode(frames(1)))
    assert other.spec.weights_sha256 != tiny.spec.weights_sha256


def test_averaged_weights_are_preferred_and_the_plain_ones_beside_them_can_be_had(tmp_path):
    state, average = magvit2_state(seed=1), magvit2_state(seed=2)
    shadow = {"model_ema." + name.replace(".", ""): tensor for name, tensor in average.items()}
    counters = {"model_ema.decay": torch.tensor(0.999), "model_ema.num_updates": torch.tensor(4)}
    torch.save({"state_dict": {**state, **shadow, **counters}}, tmp_path / "a.ckpt")
    both = [get_tokenizer(name, weights=str(tmp_path / "a.ckpt")) for name in ("magvit2", "magvit2-plain")]
    for tokenizer, expected in zip(both, (average, state), strict=True):
        assert all(torch.equal(p, expected[name]) for name, p in tokenizer.network.named_parameters())
    assert both[0].spec.digest != both[1].spec.digest


def test_averaged_weights_must_be_whole(tmp_path):
    state = magvit2_state()
    shadow = {"model_ema." + name.replace(".", ""): tensor for name, tensor in state.items()}
    del shadow["model_ema.decoderconv_inbias"]
    save_file({**state, **{k: v.clone() for k, v in shadow.items()}}, tmp_path / "a.safetensors")
    with pytest.raises(TokenizerError, match=r"model_ema\.decoderconv_inbias"):
        read_network(tmp_path / "a.safetensors")


def test_halves_are_computed_with_as_floats(tmp_path, weights, tiny):
    halves = {name: tensor.half() for name, tensor in load_file(weights).items()}
    save_file(halves, tmp_path / "half.safetensors")
    network = read_network(tmp_path / "half.safetensors")
    assert all(torch.equal(p, halves[name].float()) for name, p in network.named_parameters())


@pytest.mark.parametrize(
    ("changes", "named"),
    [
        ({"encoder.conv_in.weight": None}, r"lacks encoder\.conv_in\.weight"),
        ({"decoder.conv_in.bias": None}, r"Missing key.*decoder\.conv_in\.bias"),
        ({"encoder.conv_out.weight": None}, r"lacks encoder\.conv_out\.weight"),
        ({"encoder.mid.attn_1.q.weight": torch.zeros(2)}, r"encoder\.mid\.attn_1\.q\.weight"),
        ({"quant_conv.weight": torch.zeros(2)}, r"quant_conv\.weight"),
        ({"decoder.adaptive.0.gamma.weight": torch.zeros(2)}, r"decoder\.adaptive\.0\.gamma\.weight"),
        ({"decoder.conv_in.weight": torch.zeros(32, 4, 3, 3)}, r"size mismatch for decoder\.conv_in"),
        ({"encoder.conv_in.weight": torch.zeros(24, 3, 3, 3)}, "divisible"),
        ({"encoder.conv_in.weight": torch.zeros(32, 1, 3, 3)}, r"size mismatch for encoder\.conv_in"),
        ({"encoder.conv_in.weight": torch.zeros(0, 3, 3, 3)}, "does not hold the weights"),
        ({"encoder.conv_in.weight": torch.zeros(3)}, "does not hold the weights"),
        ({"decoder.conv_in.bias": torch.full((32,), torch.nan)}, "not finite"),
    ],
)
def test_weights_of_another_network_are_refused_by_name(tmp_path, changes, named):
    save_file(altered(magvit2_state(), changes), tmp_path / "other.safetensors")
    with pytest.raises(TokenizerError, match=named) as caught:
        get_tokenizer("magvit2", weights=str(tmp_path / "other.safetensors"))
    assert "other.safetensors" in str(caught.value) and caught.value.remedy


def test_its_shards_are_decoded_with_its_own_weights_alone(toy_arm: Embodiment, tmp_path, weights, tiny):
    write_toy(tmp_path / "toy.hdf5", [2])
    out = tmp_path / "out"
    settings = Settings(cameras=("top",))
    convert(toy_arm, str(tmp_path / "toy.hdf5"), "magvit2", out, weights=str(weights), settings=settings)
    shards = ShardSet(out)
    assert verify(out) == [] and shards.spec == tiny.spec
    tokens = shards.tokens(shards.episode_rows(0)["tokens"])
    assert tokenizer_of(shards, str(weights)).decode(tokens).shape == (len(tokens), 256, 256, 3)
    other = write_magvit2(tmp_path / "other.safetensors", seed=5)
    with pytest.raises(TokenizerError, match="was made by magvit2 with weights"):
        tokenizer_of(shards, str(other))
