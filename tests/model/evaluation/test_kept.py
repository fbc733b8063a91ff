"""Trained readers are kept on disk: made once, and again where anything differs that they depend on."""

from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from torch import nn

from hma_data.tokenizers.base import get_tokenizer
from hma_model.evaluation import probe
from hma_model.evaluation.kept import kept, kept_reader
from hma_model.evaluation.probe import train_probe
from tests.hostile import flip


def tokenizer(bias: float = 0.0, name: str = "a") -> SimpleNamespace:
    network = nn.Linear(2, 2)
    nn.init.constant_(network.weight, 1.0)
    nn.init.constant_(network.bias, bias)
    return SimpleNamespace(spec=SimpleNamespace(digest=name), network=network)


class Maker:
    def __init__(self) -> None:
        self.calls = 0

    def __call__(self) -> dict[str, np.ndarray]:
        self.calls += 1
        return {"values": np.arange(6.0).reshape(2, 3).T, "count": np.array(self.calls)}


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("HMA_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache" / "readers"


def test_what_is_kept_is_made_once_and_comes_back_as_it_was(folder: Path) -> None:
    make = Maker()
    first, second = (kept("probe", tokenizer(), {"robot": "x", "seed": 0}, make) for _ in range(2))
    assert make.calls == 1 and len(list(folder.iterdir())) == 1
    assert np.array_equal(first["values"], second["values"]) and second["count"].item() == 1
    assert second["values"].dtype == np.float64


@pytest.mark.parametrize(
    ("kind", "by", "facts"),
    [
        ("judge", tokenizer(), {"seed": 0}),
        ("probe", tokenizer(), {"seed": 1}),
        ("probe", tokenizer(bias=1.0), {"seed": 0}),
        ("probe", tokenizer(name="b"), {"seed": 0}),
    ],
    ids=["another kind", "another fact", "other weights", "another tokenizer"],
)
def test_anything_else_is_made_again(kind, by, facts) -> None:
    make = Maker()
    kept("probe", tokenizer(), {"seed": 0}, make)
    kept(kind, by, facts, make)
    assert make.calls == 2


def test_a_tokenizer_without_a_network_keeps_nothing(folder: Path) -> None:
    make, plain = Maker(), SimpleNamespace(spec=SimpleNamespace(digest="a"))
    for _ in range(2):
        kept("probe", plain, {}, make)
    assert make.calls == 2 and not folder.exists()


def test_a_damaged_file_is_made_again(folder: Path) -> None:
    make = Maker()
    kept("probe", tokenizer(), {}, make)
    (path,) = folder.iterdir()
    flip(90)(path)
    assert kept("probe", tokenizer(), {}, make)["count"].item() == 2
    assert kept("probe", tokenizer(), {}, make)["count"].item() == 2 and make.calls == 2


def test_a_cache_that_cannot_be_written_costs_only_time(folder: Path) -> None:
    folder.parent.write_text("a file")
    assert kept("probe", tokenizer(), {}, Maker())["values"].shape == (3, 2)


def test_a_reader_comes_back_with_its_weights_and_values(folder: Path) -> None:
    network = nn.Sequential(nn.Linear(3, 4), nn.GELU(), nn.Linear(4, 2))
    trained = SimpleNamespace(network=network, error=np.array([0.5, 2.0]), driven=1)

    def read(make: Callable[[], Any]) -> dict[str, Any]:
        return kept_reader("probe", tokenizer(), {}, make, ("error", "driven"), fresh)

    def fresh(count: int) -> nn.Module:
        return nn.Sequential(nn.Linear(3, 4), nn.GELU(), nn.Linear(4, count))

    read(lambda: trained)
    found, x = read(lambda: pytest.fail("it is kept")), torch.randn(5, 3)
    assert torch.equal(network(x), found["network"](x)) and not found["network"].training
    assert found["error"].tolist() == [0.5, 2.0] and found["driven"] == 1


@pytest.mark.slow
def test_a_kept_probe_reads_as_the_trained_one(monkeypatch: pytest.MonkeyPatch) -> None:
    for name, value in {
        "EPISODES": 3,
        "HELD_OUT_SHARE": 0.34,
        "EPISODE_FRAMES": 8,
        "TRAINING_STEPS": 5,
    }.items():
        monkeypatch.setattr(probe, name, value)
    embedded, told = get_tokenizer("fsq-lab"), list[str]()
    first = train_probe("pusht_fast", embedded, 2, tell=told.append)
    count = len(told)
    second = train_probe("pusht_fast", embedded, 2, tell=told.append)
    assert count and len(told) == count
    images = np.random.default_rng(0).integers(0, 255, (4, 128, 128, 3), np.uint8)
    assert np.array_equal(first.read(images), second.read(images))
    assert np.array_equal(first.areas(images), second.areas(images))
    assert first.driven == second.driven and np.array_equal(first.readable, second.readable)
