"""Colours as tokens: the nearest colour of each pixel, exact where the list has it."""

import json
from pathlib import Path

import numpy as np
import pytest
import torch
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray
from safetensors.numpy import save_file

from hma_data.episodes.sheets import write_png
from hma_data.errors import TokenizerError
from hma_data.tokenizers import palette
from hma_data.tokenizers.base import TokenizerSpec, get_tokenizer, reopened
from hma_data.tokenizers.palette import Nearest, Shown, fit, write
from hma_data.tokenizers.shapes import get_spec, palette_spec
from tests.command import hma

Colors = NDArray[np.uint8]
CPU = torch.device("cpu")
OWN = np.array([[0, 0, 0], [255, 255, 255], [200, 0, 0]], np.uint8)


@given(seed=st.integers(0, 10**6), count=st.integers(2, 255))
def test_an_image_in_colours_of_the_list_comes_back_exactly(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    steps = rng.choice(32**3, count, replace=False)  # one a cell of the table of nearest colours
    colors = torch.from_numpy(np.stack([steps >> 10, steps >> 5 & 31, steps & 31], axis=1) * 8 + 4)
    frames = colors[rng.integers(0, count, (2, 8, 12))].permute(0, 3, 1, 2) / 127.5 - 1
    ids = Nearest(colors)(frames)
    assert ids.shape == (2, 4, 6) and int(ids.min()) >= 0 and int(ids.max()) < count**4
    assert torch.equal(Shown(colors)(ids), frames)


@given(seed=st.integers(0, 10**6), count=st.integers(2, 255))
def test_the_tables_of_a_cpu_give_what_the_network_gives(seed: int, count: int) -> None:
    rng = np.random.default_rng(seed)
    tokenizer = palette.Palette(palette_spec("palette-64", 64, colors := drawn(rng, count)), colors, CPU)
    frames = rng.integers(0, 256, (3, 64, 64, 3)).astype(np.uint8)
    pixels = torch.from_numpy(frames).permute(0, 3, 1, 2).float().mul(2 / 255).sub(1)
    ids = tokenizer.encode(frames)
    assert np.array_equal(ids, Nearest(torch.from_numpy(colors))(pixels).numpy())
    assert np.array_equal(tokenizer.decode(ids), tokenizer.pictures(torch.from_numpy(ids.astype(np.int64))))


def drawn(rng: np.random.Generator, count: int) -> Colors:
    numbers = rng.choice(2**24, count, replace=False)
    return np.stack([numbers >> 16, numbers >> 8 & 255, numbers & 255], axis=1).astype(np.uint8)


def test_other_colours_become_the_nearest_of_the_list() -> None:
    tokenizer = get_tokenizer("palette-64")
    frames = np.random.default_rng(0).integers(0, 256, (1, 64, 64, 3)).astype(np.uint8)
    shown = tokenizer.decode(tokenizer.encode(frames)).astype(float)
    colors = np.unique(shown.reshape(-1, 3), axis=0)
    least = np.linalg.norm(frames[..., None, :] - colors, axis=-1).min(-1)
    assert (np.linalg.norm(frames - shown, axis=-1) <= least + 8 * 3**0.5).all()  # a table of steps of 8


def test_fitted_colours_keep_a_small_object_apart() -> None:
    frames = np.full((4, 64, 64, 3), 250, np.uint8)
    frames[:, :20] = 90
    frames[:, 40:42, 30:32] = (200, 30, 40)
    colors = fit([frames[:2], frames[2:]], 3)
    assert sorted(map(tuple, colors.tolist())) == [(90, 90, 90), (200, 30, 40), (250, 250, 250)]


def test_fitted_colours_of_noise_are_found_in_parts(monkeypatch: pytest.MonkeyPatch) -> None:
    noise = np.random.default_rng(0).integers(0, 256, (1, 64, 64, 3)).astype(np.uint8)
    whole = fit(iter([noise]), 8)
    monkeypatch.setattr(palette, "AT_ONCE", 500)
    assert np.abs(fit([noise], 8).astype(int) - whole).max() <= 1


def test_the_command_writes_the_colours_of_images(tmp_path: Path) -> None:
    write_png(tmp_path / "some.png", np.repeat(OWN[[0, 1, 2, 1]], 16, axis=0)[:, None].repeat(64, axis=1))
    (tmp_path / "none.png").write_bytes(b"no")
    done = hma("tokenizer", "fit", tmp_path, "--out", tmp_path / "own.safetensors")
    assert done.returncode == 0 and done.stdout == f"wrote {tmp_path}/own.safetensors: 3 colours\n"
    assert "1 files or episodes could not be read" in done.stderr
    spec = get_spec("palette-64", weights=tmp_path / "own.safetensors")
    assert {spec.colors[at : at + 6] for at in (0, 6, 12)} == {"000000", "ffffff", "c80000"}


def test_images_of_one_colour_are_refused() -> None:
    with pytest.raises(TokenizerError, match="images: show fewer than two colours — name images of"):
        fit([np.zeros((1, 64, 64, 3), np.uint8)])


def test_colours_of_ones_own(tmp_path: Path) -> None:
    path = tmp_path / "own.safetensors"
    write(path, OWN)
    tokenizer = get_tokenizer("palette-64", weights=path)
    assert tokenizer.spec.factored == (3,) * 4
    assert tokenizer.spec == get_spec("palette-64", weights=path)
    assert tokenizer.spec.digest != get_spec("palette-64").digest
    assert get_spec("palette-64") == get_tokenizer("palette-64").spec
    kept = json.loads(json.dumps(tokenizer.spec.to_json()))  # as in a checkpoint: the file is not needed
    path.unlink()
    again = reopened(kept)
    assert again.spec == tokenizer.spec == TokenizerSpec.from_json(kept)
    frames = np.random.default_rng(0).integers(0, 256, (1, 64, 64, 3)).astype(np.uint8)
    assert np.array_equal(again.encode(frames), tokenizer.encode(frames))
    assert "colors" not in get_spec("fsq-16").to_json()  # specs of before keep their digests


@pytest.mark.parametrize("colors", [np.zeros((9, 4), np.uint8), np.zeros((9, 3)), np.zeros((1, 3), np.uint8)])
def test_a_file_of_other_values_is_refused(tmp_path: Path, colors: Colors) -> None:
    path = tmp_path / "own.safetensors"
    save_file({"colors": colors}, path)
    with pytest.raises(TokenizerError, match=r"own.safetensors: its colours are .* — name a file"):
        get_tokenizer("palette-64", weights=path)
    with pytest.raises(TokenizerError, match=r"not a complete safetensors file"):
        get_tokenizer("palette-64", weights=tmp_path)
    path.write_bytes(b"no")
    with pytest.raises(TokenizerError, match=r"own.safetensors: "):
        get_spec("palette-64", weights=path)


@pytest.mark.parametrize(
    "colors", ["own.safetensors", "hf://team/own/own.safetensors", "0a0b0", "00" * 3, "000000" * 256, 7]
)
@pytest.mark.parametrize("name", ["palette-64", "fsq-16"])
def test_colours_of_a_spec_open_no_file_and_are_never_too_many(name, colors, tmp_path, monkeypatch) -> None:
    write(tmp_path / "own.safetensors", OWN)
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("hma_data.tokenizers.palette.Nearest", None)  # a table for millions of colours
    spec = {"name": name, "colors": colors}
    if name == "palette-64":
        with pytest.raises(TokenizerError, match="palette-64: holds no colours"):
            reopened(spec)
    else:
        assert reopened(spec).spec == get_spec("fsq-16")


def test_colours_are_read_from_the_json_of_a_model_or_a_set(tmp_path: Path) -> None:
    write(tmp_path / "own.safetensors", OWN)
    own, path = get_spec("palette-64", weights=tmp_path / "own.safetensors"), tmp_path / "config.json"
    path.write_text(json.dumps({"model": {}, "tokenizer": own.to_json()}))
    assert get_tokenizer("palette-64", weights=path).spec == own
    path.write_text(json.dumps({"tokenizer": get_spec("fsq-16").to_json()}))
    with pytest.raises(TokenizerError, match=r"config.json: holds no colours"):
        get_tokenizer("palette-64", weights=path)
