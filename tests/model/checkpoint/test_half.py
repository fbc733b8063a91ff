"""Checkpoints in float16."""

from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from hma_data.errors import CheckpointError
from hma_model.checkpoint import io
from hma_model.checkpoint.folder import README, SAMPLE, STEM, TRUNK, Checkpoint
from hma_model.network.model import HMA
from tests.model.robots import make_model, save


@pytest.fixture
def halved(tmp_path: Path) -> Path:
    for name in ("whole", "half"):
        robots = {"arm": 2, "hand": 3}
        save(tmp_path / name, robots, samples={"arm": b"a picture"}, half=name == "half")
    return tmp_path / "half"


def test_weights_are_rounded_and_statistics_are_not(halved: Path) -> None:
    whole, half = io.load(halved.with_name("whole")).state_dict(), io.load(halved).state_dict()
    for name, value in whole.items():
        rounded = value.is_floating_point() and "normalizer" not in name
        assert half[name].dtype == value.dtype
        assert torch.equal(half[name], value.half().to(value.dtype) if rounded else value)
    home = halved / "embodiments" / "arm"
    assert (home / SAMPLE).read_bytes() == b"a picture" and SAMPLE in (halved / README).read_text()
    assert load_file(home / STEM)["normalizer.mean"].dtype == torch.float32
    stored = Checkpoint.open(halved)
    assert stored.card("arm")["data"] == {"windows": 12}
    for name in ("arm", "hand"):
        stored.check(name)
    sizes = [(folder / TRUNK).stat().st_size for folder in (halved, halved.with_name("whole"))]
    assert sizes[0] < 0.7 * sizes[1]


def test_a_robot_joins_the_published_trunk(halved: Path, tmp_path: Path) -> None:
    HMA.from_pretrained(halved, embodiments=["arm"]).push_to_hub(tmp_path / "repo")
    assert Checkpoint.open(tmp_path / "repo").embodiments == ("arm",)
    HMA.from_pretrained(halved, embodiments=["hand"]).push_to_hub(tmp_path / "repo")
    there = Checkpoint.open(tmp_path / "repo")
    assert there.embodiments == ("arm", "hand") and there.trunk_sha256 == Checkpoint.open(halved).trunk_sha256
    given = torch.randint(0, 65, (1, 4, 2, 3)), torch.randn(1, 4, 6), "hand"
    with torch.no_grad():
        logits = [io.load(folder).video_logits(*given) for folder in (halved, tmp_path / "repo")]
    assert torch.equal(*logits)


def test_a_changed_trunk_is_published_as_it_is(halved: Path, tmp_path: Path) -> None:
    model = HMA.from_pretrained(halved)
    with torch.no_grad():
        model.trunk.position.add_(0.001)
    model.push_to_hub(tmp_path / "repo")
    assert torch.equal(io.load(tmp_path / "repo").trunk.position, model.trunk.position)


def test_weights_beyond_float16_are_refused(tmp_path: Path) -> None:
    model = make_model({"arm": 2})
    with torch.no_grad():
        model.trunk.absent[0, 0] = 1e5
    with pytest.raises(CheckpointError, match=r"trunk\.absent holds 1e\+05, which float16 cannot represent"):
        save(tmp_path / "half", {"arm": 2}, model=model, half=True)
    assert not (tmp_path / "half").exists()
