"""`hma view RUN`: the figures of its log, and a held-out window beside its prediction."""

import json
from pathlib import Path

import numpy as np
import pytest

from hma_data.errors import UsageError
from hma_data.inspection.view import View
from hma_data.loading.dataset import WindowDataset
from hma_data.shards.reader import ShardSet
from hma_model.checkpoint.folder import Checkpoint
from hma_model.cli import main
from hma_model.training import view as module
from tests.data.inspection.test_view import pictures, read, seconds
from tests.model.robots import Blocks, save
from tests.model.shards import make_shards


@pytest.fixture
def run(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    shards = make_shards(tmp_path / "arm", "arm")
    folder = tmp_path / "run"
    save(folder / "checkpoints" / "step-00000002", {"arm": 2})
    lines = [
        {"kind": "train", "step": 1, "loss_by_embodiment": {"arm": 3.5}, "lr": 0.1, "grad_norm": None},
        {"kind": "eval", "step": 1, "loss_by_embodiment": {"arm": 3.25}},
        {"kind": "train", "step": 2, "loss_by_embodiment": {"arm": 3.0}, "lr": 0.2, "grad_norm": 1.5},
    ]
    (folder / "metrics.jsonl").write_text("".join(json.dumps(line) + "\n" for line in lines))
    (folder / "recipe.json").write_text(json.dumps({"data": [str(shards), str(tmp_path / "moved")]}))
    monkeypatch.setattr(module, "tokenizer_of", lambda shards: Blocks())
    return folder


def test_a_run_is_shown_by_its_log_and_a_held_out_window(run: Path, tmp_path: Path) -> None:
    module.view_run(run, 3).save(tmp_path / "seen.rrd")
    found = read(tmp_path / "seen.rrd")
    training, rate = found["/training/loss/arm"], found["/rates/grad_norm"]
    assert (training["step"], training["Scalars:scalars"]) == ([1, 2], [[3.5], [3.0]])
    assert (rate["step"], rate["Scalars:scalars"]) == ([2], [[1.5]])
    assert found["/held_out/loss/arm"]["Scalars:scalars"] == [[3.25]]
    shards = ShardSet(tmp_path / "arm")
    frames = len(found["/cameras/truth"]["frame"])
    window = WindowDataset(shards, "val", frames).batch([3])
    truth, predicted = (pictures(found[f"/cameras/{name}"]).astype(int) for name in ("truth", "predicted"))
    decoded = Blocks().decode(window.tokens[0].numpy().astype(np.uint32))
    assert np.abs(truth - decoded).mean() < 8 and len(predicted) == frames
    np.testing.assert_allclose(found["/actions"]["Scalars:scalars"], window.actions[0, :, :2])
    np.testing.assert_allclose(
        seconds(found["/actions"]), np.arange(frames) / shards.embodiment.effective_hz, atol=1e-9
    )


def test_a_run_without_its_shards_is_shown_by_its_log(run: Path, tmp_path: Path) -> None:
    (run / "recipe.json").write_text(json.dumps({"data": [str(tmp_path / "moved")]}))
    module.view_run(run).save(tmp_path / "seen.rrd")
    assert set(read(tmp_path / "seen.rrd")) >= {"/training/loss/arm", "/rates/lr"}
    (run / "metrics.jsonl").unlink()
    with pytest.raises(UsageError, match="name a shard set too"):
        module.view_run(run)


def test_a_window_that_is_not_there_is_refused(run: Path) -> None:
    with pytest.raises(UsageError, match="held-out windows"):
        module.view_run(run, 999)


def test_the_command_refuses_what_does_not_belong_to_the_place(run, tmp_path, capsys) -> None:
    out = ["--out", str(tmp_path / "x.rrd")]
    for words, said in (
        ([str(tmp_path / "arm"), "--tokenizer", "fsq-8"], "--tokenizer: is for a recording"),
        ([str(tmp_path / "arm"), str(tmp_path / "arm")], "DATA: is for a checkpoint"),
        ([str(run), "--tokenizer", "fsq-8"], "--tokenizer: is for a recording"),
        ([str(tmp_path / "nothere")], "does not exist"),
    ):
        assert main(["view", *words, *out]) == 2
        assert said in capsys.readouterr().err
    assert not (tmp_path / "x.rrd").exists()


def test_a_robot_with_a_bundled_checkpoint_to_itself_is_found_by_its_shards(tmp_path, monkeypatch) -> None:
    seen: list[str] = []

    def rolled(out: Path, checkpoint: Checkpoint, *_: object) -> View:
        seen.append(checkpoint.name)
        return View("a window", np.zeros(0))

    monkeypatch.setattr(module, "_rolled", rolled)
    module.view_run("embedded", data=[make_shards(tmp_path / "shards", "pusht_fast")])
    assert seen == ["embedded-pusht"]
