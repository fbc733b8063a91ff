"""The recipe that averages two checkpoints."""

import runpy
import sys
from pathlib import Path

import pytest
import torch

from hma_data.registry.embodiment import Embodiment
from hma_data.storage.paths import shipped
from hma_model.checkpoint import io
from hma_model.checkpoint.folder import Checkpoint
from hma_model.network.model import HMA
from tests.model.robots import CONFIG, save, stats, yaml

sys.path.insert(0, str(shipped("recipes") / "world"))
MAIN = runpy.run_path(str(shipped("recipes") / "world" / "mean.py"))["main"]


def mean(monkeypatch: pytest.MonkeyPatch, *words: object) -> None:
    monkeypatch.setattr("sys.argv", ["mean.py", *map(str, words)])
    MAIN()


def test_every_weight_lies_the_share_of_the_way(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    robots = {"arm": 2, "hand": 3}
    one, two = save(tmp_path / "one", robots, seed=1), save(tmp_path / "two", robots, seed=2)
    mean(monkeypatch, tmp_path / "one", tmp_path / "two", 0.25, tmp_path / "a mean")
    made, ends = io.load(tmp_path / "a mean").state_dict(), (one.state_dict(), two.state_dict())
    assert made.keys() == ends[0].keys()
    for name, value in made.items():
        if value.is_floating_point():
            torch.testing.assert_close(value, 0.75 * ends[0][name] + 0.25 * ends[1][name])
    stored = Checkpoint.open(tmp_path / "a mean")
    assert stored.card("arm")["data"] == {"windows": 12} and stored.card("arm")["metrics"] == {}
    for name in robots:
        stored.check(name)


def test_what_does_not_belong_together_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    save(tmp_path / "two", {"arm": 2})
    other = {"action": {**stats()["action"], "mean": [1.25, 0.25]}}
    model = HMA(CONFIG)
    model.add_embodiment(Embodiment.from_yaml(yaml("arm")), io.action_stats(other, "arm"))
    io.save(model, tmp_path / "three", embodiment_yaml={"arm": yaml("arm")}, stats={"arm": other}, cards={})
    with pytest.raises(SystemExit):
        mean(monkeypatch, tmp_path / "three", tmp_path / "two", 0.5, tmp_path / "out")
    assert "arm has other statistics" in capsys.readouterr().err
    assert not (tmp_path / "out").exists()
