"""The recipe that gives a checkpoint more layers."""

import runpy
import sys

import pytest
import torch

from hma_data.storage.paths import shipped
from hma_model.checkpoint import io
from hma_model.checkpoint.folder import Checkpoint
from tests.model.robots import CONFIG, make_model, save

sys.path.insert(0, str(shipped("recipes") / "world"))
GROW = runpy.run_path(str(shipped("recipes") / "world" / "grow.py"))
SHARED = {"shared_modulation": True, "modulation_out": "trunk"}


@pytest.fixture
def grow(monkeypatch: pytest.MonkeyPatch):
    def run(*words: object) -> None:
        monkeypatch.setattr("sys.argv", ["grow.py", *map(str, words)])
        GROW["main"]()

    return run


@pytest.mark.parametrize("before, after", [(2, 3), (2, 4), (3, 5)])
@pytest.mark.parametrize(
    "kind", [SHARED, {"conditioning": ("cross_attention",)}], ids=["modulation", "cross"]
)
def test_a_grown_network_gives_the_same_answers(tmp_path, grow, kind, before, after):
    small = make_model({"arm": 2, "hand": 3}, config=CONFIG.replace(layers=before, **kind))
    save(tmp_path / "small", {"arm": 2, "hand": 3}, model=small)
    grow(tmp_path / "small", after, tmp_path / "large")
    large = io.load(tmp_path / "large")
    assert large.config == small.config.replace(layers=after)
    given = torch.randint(0, 65, (2, 4, 2, 3)), torch.randn(2, 4, 6), "hand"  # 64 is masked
    with torch.no_grad():
        assert torch.equal(large.video_logits(*given), small.video_logits(*given))
    for name in ("arm", "hand"):
        Checkpoint.open(tmp_path / "large").check(name)


@pytest.mark.parametrize("kind", [{}, {"conditioning": ("add",), "add_at": "layers"}], ids=["stems", "added"])
def test_layers_with_parts_elsewhere_are_refused(tmp_path, grow, kind, capsys):
    save(tmp_path / "small", {"arm": 2}, model=make_model({"arm": 2}, config=CONFIG.replace(**kind)))
    with pytest.raises(SystemExit):
        grow(tmp_path / "small", 2, tmp_path / "large")
    assert "outside of the trunk" in capsys.readouterr().err and not (tmp_path / "large").exists()


def test_more_than_twice_the_layers_are_refused(tmp_path, grow, capsys):
    save(tmp_path / "small", {"arm": 2}, model=make_model({"arm": 2}, config=CONFIG.replace(**SHARED)))
    with pytest.raises(SystemExit):
        grow(tmp_path / "small", 3, tmp_path / "large")
    assert "has 1 layers: take 2 to 2" in capsys.readouterr().err


def test_copies_follow_their_layers_evenly():
    assert GROW["sources"](4, 6) == [(0, False), (1, False), (1, True), (2, False), (3, False), (3, True)]
    assert [new for _, new in GROW["sources"](6, 8)] == [False] * 3 + [True] + [False] * 3 + [True]
