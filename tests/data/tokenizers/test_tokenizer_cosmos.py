"""`cosmos-di16` and `cosmos-ci16`: TorchScript programs of the released form, small ones."""

from pathlib import Path

import numpy as np
import pytest
import torch
from torch import Tensor, nn
from torch.nn import functional

from hma_data.errors import TokenizerError
from hma_data.tokenizers.base import Tokenizer, TokenizerSpec, get_tokenizer
from tests.data.tokenizer_files import frames, write_magvit2

pytestmark = pytest.mark.filterwarnings("ignore:`torch.jit:DeprecationWarning")


class DiscreteEncoder(nn.Module):
    """Cells' mean colours as ids (8·8·8 levels low, 125 high) with codes and a loss, as the released one."""

    def forward(self, pixels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        cells = (functional.avg_pool2d(pixels, 16) + 1) / 2
        low = (cells * 7.999).to(torch.int64)
        ids = low[:, 0] + 8 * low[:, 1] + 64 * low[:, 2] + 512 * (cells.mean(1) * 124.999).to(torch.int64)
        return ids.to(torch.int32), cells, cells.sum()


class DiscreteDecoder(nn.Module):
    def forward(self, ids: Tensor) -> Tensor:
        levels = torch.stack([ids % 8, ids // 8 % 8, ids // 64 % 8], dim=1).float()
        return functional.interpolate((levels + 0.5) / 4 - 1, scale_factor=16.0)


class ContinuousEncoder(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.Conv2d(3, 16, 16, stride=16)

    def forward(self, pixels: Tensor) -> tuple[Tensor]:
        return (self.conv(pixels),)


class ContinuousDecoder(nn.Module):
    def __init__(self) -> None:
        super().__init__()
        self.conv = nn.ConvTranspose2d(16, 3, 16, stride=16)

    def forward(self, latents: Tensor) -> Tensor:
        return self.conv(latents)


class TooManyIds(DiscreteEncoder):
    def forward(self, pixels: Tensor) -> tuple[Tensor, Tensor, Tensor]:
        ids = torch.full([pixels.shape[0], 16, 16], 64000)
        return ids, pixels, pixels.sum()


def write(folder: Path, encoder: nn.Module, decoder: nn.Module) -> Path:
    for half, module in (("encoder", encoder), ("decoder", decoder)):
        torch.jit.save(torch.jit.script(module.eval()), folder / f"{half}.jit")
    return folder


@pytest.fixture(scope="module")
def discrete(tmp_path_factory) -> Path:
    return write(tmp_path_factory.mktemp("di"), DiscreteEncoder(), DiscreteDecoder())


@pytest.fixture(scope="module")
def continuous(tmp_path_factory) -> Path:
    torch.manual_seed(0)
    return write(tmp_path_factory.mktemp("ci"), ContinuousEncoder(), ContinuousDecoder())


def test_discrete_ids_are_stored_as_two_digits_of_512_and_125(discrete):
    tokenizer = get_tokenizer("cosmos-di16", weights=str(discrete))
    spec = tokenizer.spec
    assert isinstance(tokenizer, Tokenizer) and TokenizerSpec.from_json(spec.to_json()) == spec
    assert (spec.vocab_size, spec.factored, spec.grid, spec.dtype) == (64000, (512, 125), (16, 16), "uint16")
    pictures = frames(3)
    tokens = tokenizer.encode(pictures)
    assert tokens.dtype == np.uint16 and tokens.shape == (3, 16, 16)
    cells = pictures.reshape(3, 16, 16, 16, 16, 3).mean(axis=(2, 4)) / 255
    low = (cells * 7.999).astype(int)
    near = np.abs(cells * 7.999 - np.rint(cells * 7.999)).min(-1) < 1e-3
    assert np.array_equal((tokens % 8)[~near], low[..., 0][~near])
    made = tokenizer.decode(tokens)
    assert made.shape == pictures.shape and np.abs(made.astype(int) - pictures).mean() < 40
    assert np.array_equal(np.concatenate([tokenizer.encode(p[None]) for p in pictures]), tokens)


def test_continuous_latents_are_the_programs(continuous):
    tokenizer = get_tokenizer("cosmos-ci16", weights=str(continuous / "decoder.jit"))
    assert (tokenizer.spec.kind, tokenizer.spec.channels) == ("continuous", 16)
    pictures = frames(2)
    latents = tokenizer.encode(pictures)
    assert latents.shape == (2, 16, 16, 16) and latents.dtype == np.float16
    pixels = torch.from_numpy(pictures).permute(0, 3, 1, 2).float() / 127.5 - 1
    program = torch.jit.load(str(continuous / "encoder.jit"))
    np.testing.assert_allclose(latents, program(pixels)[0].detach().numpy(), atol=2e-3)
    assert tokenizer.decode(latents).shape == pictures.shape
    assert {"encoder", "decoder"} == {name for name, _ in tokenizer.network.named_children()}


def test_there_is_no_download(monkeypatch):
    monkeypatch.delenv("HMA_WEIGHTS", raising=False)
    with pytest.raises(TokenizerError, match=r"no pinned download.*weights=PATH"):
        get_tokenizer("cosmos-di16")


def test_both_halves_are_recorded(discrete, tmp_path):
    other = write(tmp_path, DiscreteEncoder(), nn.Sequential(DiscreteDecoder(), nn.Tanh()))
    specs = [get_tokenizer("cosmos-di16", weights=str(path)).spec for path in (discrete, other)]
    assert specs[0].weights_sha256 != specs[1].weights_sha256


@pytest.mark.parametrize("name", ["cosmos-ci16", "cosmos-di16"])
def test_programs_of_the_other_kind_are_refused(name, discrete, continuous):
    swapped = discrete if name == "cosmos-ci16" else continuous
    with pytest.raises(TokenizerError, match=r"encoder\.jit: does not do what cosmos"):
        get_tokenizer(name, weights=str(swapped))


def test_ids_outside_the_vocabulary_are_refused(tmp_path):
    write(tmp_path, TooManyIds(), DiscreteDecoder())
    with pytest.raises(TokenizerError, match="id 64000, the vocabulary ends at 64000"):
        get_tokenizer("cosmos-di16", weights=str(tmp_path))


def test_files_that_are_no_programs_are_refused(discrete, tmp_path):
    for half in ("encoder", "decoder"):
        write_magvit2(tmp_path / f"{half}.jit")
    with pytest.raises(TokenizerError, match=r"encoder\.jit: cannot be loaded as TorchScript"):
        get_tokenizer("cosmos-di16", weights=str(tmp_path))
    torch.save({"a": torch.ones(1)}, tmp_path / "encoder.jit")
    with pytest.raises(TokenizerError, match=r"encoder\.jit: cannot be loaded as TorchScript"):
        get_tokenizer("cosmos-di16", weights=str(tmp_path))
    content = (discrete / "encoder.jit").read_bytes()
    for keep in (len(content) // 2, len(content) - 10):
        (tmp_path / "encoder.jit").write_bytes(content[:keep])
        with pytest.raises(TokenizerError, match=r"encoder\.jit"):
            get_tokenizer("cosmos-di16", weights=str(tmp_path))


def test_a_missing_half_is_named(discrete, tmp_path):
    (tmp_path / "encoder.jit").write_bytes((discrete / "encoder.jit").read_bytes())
    with pytest.raises(TokenizerError, match=r"decoder\.jit: is missing"):
        get_tokenizer("cosmos-di16", weights=str(tmp_path))
    whole = tmp_path / "autoencoder.jit"
    whole.write_bytes((discrete / "encoder.jit").read_bytes())
    with pytest.raises(TokenizerError, match="named after neither"):
        get_tokenizer("cosmos-di16", weights=str(whole))
