"""What a run survives: kills at any moment, full disks, other hands in its folder. Each fault in one line."""

import errno
from pathlib import Path

import pytest

from hma_data.errors import CheckpointError, OutputError, RecipeError, ShardError
from hma_model.checkpoint import io as checkpoint
from hma_model.checkpoint.folder import resolve
from hma_model.training.loop import train
from tests.model.runs import TINY
from tests.model.shards import make_shards


@pytest.fixture
def data(arm_shards: Path) -> list[str]:
    return [str(arm_shards)]


def train_quietly(recipe, out: Path) -> None:
    train(recipe, out=out, show=False)


@pytest.fixture
def full(monkeypatch):
    from hma_model.checkpoint import weights as files

    plain, calls = files.write_tensors, []

    def write(path, *given):
        calls.append(path)
        if "step-00000004" in str(path):
            raise OSError(errno.ENOSPC, "No space left on device")
        plain(path, *given)

    monkeypatch.setattr("hma_model.checkpoint.io.write_tensors", write)
    return calls


def test_a_full_disk_is_one_error_and_leaves_the_last_checkpoint(recipe, tmp_path, full, monkeypatch):
    with pytest.raises(CheckpointError, match=r"step-00000004: .*No space left.*checkpoints are intact"):
        train(recipe(), out=tmp_path / "run", show=False)
    last = resolve(tmp_path / "run")
    assert last.name == "step-00000002" and checkpoint.load(last)
    assert [p.name for p in (tmp_path / "run/checkpoints").iterdir()] == ["step-00000002"]
    monkeypatch.undo()
    assert train(recipe(), out=tmp_path / "run", show=False).step == 6


@pytest.mark.parametrize("writer", ["run.write_atomic", "logging.atomic_path", "report.write_atomic"])
def test_whatever_cannot_be_written_is_one_error(recipe, tmp_path, monkeypatch, writer):
    def write(path, *content):
        raise OSError(errno.ENOSPC, "No space left on device")

    monkeypatch.setattr(f"hma_model.training.{writer}", write)
    with pytest.raises(OutputError, match="cannot be written: No space left on device"):
        train(recipe(report=True, steps=1), out=tmp_path / "run", show=False)


def test_a_step_in_which_nothing_may_learn_is_said(recipe, tmp_path):
    skipping = recipe(steps=1, model={**TINY["model"], "absent_action": "skip"})
    base = train(skipping, out=tmp_path / "a", show=False)
    frozen = recipe(start=str(base.out), freeze="trunk", objectives={"passive": 1}, model={})
    with pytest.raises(RecipeError, match="leaves nothing to train with the objective passive"):
        train(frozen, out=tmp_path / "b", show=False)


@pytest.mark.parametrize("place", ["file/run", "run"])
def test_a_folder_that_cannot_be_written_is_said(recipe, tmp_path, place, monkeypatch):
    (tmp_path / "file").write_text("a file")
    if place == "run":
        (tmp_path / "run").write_text("a file too")
    with pytest.raises(OutputError, match=r"cannot be used: (Not a directory|File exists)"):
        train(recipe(), out=tmp_path / place, show=False)


def test_the_folder_of_another_run_is_refused_with_what_differs(recipe, data, tmp_path):
    train(recipe(steps=2), out=tmp_path / "run", show=False)
    other = make_shards(tmp_path / "hand", "hand", dims=3)
    with pytest.raises(RecipeError, match=r"seed: 42, now 1; data\.arm: .* now None; data\.hand: None, now "):
        train(recipe(steps=2, data=[str(other)], seed=1), out=tmp_path / "run", show=False)
    assert resolve(tmp_path / "run").name == "step-00000002"


def test_shards_of_two_tokenizers_are_refused_with_both_names(recipe, data, tmp_path):
    from hma_data.tokenizers.base import TokenizerSpec
    from tests.model.robots import SPEC

    spec = TokenizerSpec(**{**SPEC.to_json(), "name": "coded"})
    other = make_shards(tmp_path / "hand", "hand", spec=spec)
    with pytest.raises(ShardError, match="tokenized by coded .* by raw"):
        train(recipe(data=[*data, str(other)]), out=tmp_path / "run", show=False)


@pytest.mark.parametrize("ema", [0.0, 0.9])
def test_force_goes_on_with_other_shards_and_other_robots(recipe, tmp_path, capsys, ema):
    arm, leg = make_shards(tmp_path / "arm", "arm", seed=4), make_shards(tmp_path / "leg", "leg", dims=3)
    train(recipe(steps=2, ema=ema), out=tmp_path / "run", show=False)
    before = checkpoint.load(tmp_path / "run").embodiments["arm"]
    both = recipe(steps=4, data=[str(arm), str(leg)], ema=ema)
    result = train(both, out=tmp_path / "run", force=True)
    said = capsys.readouterr().err
    assert result.step == 4 and "arm keeps the statistics" in said and "leg is new in this run" in said
    after = checkpoint.load(tmp_path / "run").embodiments
    assert after["arm"].agrees_with(before) and set(after) == {"arm", "leg"}
    last = train(recipe(steps=5, data=[str(leg)], ema=ema), out=tmp_path / "run", force=True, show=False)
    assert last.step == 5 and set(checkpoint.load(last.checkpoint).embodiments) == {"leg"}
