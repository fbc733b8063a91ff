"""What a run survives: kills at any moment, full disks, other hands in its folder. Each fault in one line."""

import errno
import json
import shutil
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest
import torch

from hma_data.errors import CheckpointError, OutputError, RecipeError, ShardError, TrainingError, UsageError
from hma_data.shards.writer import ShardWriter
from hma_data.tokenizers.base import TokenizerSpec
from hma_model.checkpoint import io as checkpoint
from hma_model.checkpoint.folder import read_metadata, resolve, training_checkpoints
from hma_model.checkpoint.weights import read_tensors, write_tensors
from hma_model.training.guards import StepMetrics
from hma_model.training.logging import read_metrics
from hma_model.training.loop import train
from hma_model.training.parallel import Ranks
from hma_model.training.recipe import make_recipe
from hma_model.training.run import Run
from tests.model.processes import errors
from tests.model.robots import SPEC
from tests.model.runs import TINY, same, train_until
from tests.model.shards import make_shards
from tests.model.training.test_parallel import spread

OTHER = TokenizerSpec(**{**SPEC.to_json(), "name": "other"})


@pytest.fixture
def data(arm_shards: Path) -> list[str]:
    return [str(arm_shards)]


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
    other = make_shards(tmp_path / "hand", "hand", spec=OTHER)
    with pytest.raises(ShardError, match="tokenized by other .* by raw"):
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
    last = train(recipe(steps=5, data=[str(leg)], ema=ema), out=tmp_path / "run", force=True)
    assert "the next checkpoints leave out: arm" in capsys.readouterr().err
    assert last.step == 5 and set(checkpoint.load(last.checkpoint).embodiments) == {"leg"}


EPISODE, ROW = 2, 10


def make_hurt(folder: Path) -> Path:
    with pytest.MonkeyPatch.context() as patch:
        plain = ShardWriter.add

        def add(self: ShardWriter, episode_index: int, columns: dict) -> None:
            if episode_index == EPISODE:
                actions = columns["action"].copy()
                actions[ROW, 0] = np.float32(3e38)
                columns = columns | {"action": actions}
            plain(self, episode_index, columns)

        patch.setattr(ShardWriter, "add", add)
        return make_shards(folder, "arm")


def recipe(data: Path, **changes):
    long = {"steps": 16, "checkpoint_every": 1, "eval_every": 0}
    return make_recipe({**TINY, "data": [str(data)], **long, **changes})


def taken(out: Path) -> list[tuple[int, float | None, int]]:
    lines = [line for line in read_metrics(out) if line["kind"] == "train"]
    return [(line["step"], line["loss"], line["skipped"]) for line in lines]


def test_the_run_stops_with_episode_and_frames_and_goes_on_from_repaired_shards(tmp_path):
    whole = train(recipe(make_shards(tmp_path / "well", "arm")), out=tmp_path / "whole", show=False)
    hurt = make_hurt(tmp_path / "hurt")
    with pytest.raises(TrainingError, match=r"the loss is nan") as caught:
        train(recipe(hurt), out=tmp_path / "run", show=False)
    named = caught.value.fault.split("windows: ")[1]
    place, _, last = named.rpartition(" to ")
    head, _, first = place.rpartition(" ")
    assert head == f"arm episode {EPISODE} (e{EPISODE}) frames" and int(first) <= ROW <= int(last) + 1
    step = int(caught.value.where.removeprefix("step "))
    before = [step - 1] if step > 1 else []
    assert [int(p.name[5:]) for p in training_checkpoints(tmp_path / "run")][-1:] == before
    repaired = recipe(tmp_path / "well")
    if before:
        with pytest.raises(RecipeError, match=r"data\.arm: "):
            train(repaired, out=tmp_path / "run", show=False)
    again = train(repaired, out=tmp_path / "run", show=False, force=True)
    assert again.losses == whole.losses and same(whole.checkpoint, again.checkpoint)


@pytest.mark.slow
def test_steps_left_out_are_counted_everywhere_and_go_on_being_counted(tmp_path, capsys):
    hurt = make_hurt(tmp_path / "hurt")
    skipping = recipe(hurt, nonfinite="skip", report=True)
    whole = train(skipping, out=tmp_path / "whole", show=False)
    bad = [step for step, loss, _ in taken(tmp_path / "whole") if loss is None]
    assert 1 < whole.skipped == len(bad) == taken(tmp_path / "whole")[-1][2] < 16
    train_until(skipping, tmp_path / "cut", bad[0] + 1)
    capsys.readouterr()
    again = train(skipping, out=tmp_path / "cut")
    assert taken(tmp_path / "cut") == taken(tmp_path / "whole") and again.skipped == whole.skipped
    assert same(whole.checkpoint, again.checkpoint)
    assert f"{whole.skipped} steps skipped" in capsys.readouterr().err
    report = (tmp_path / "cut/report.html").read_text()
    assert f">{whole.skipped}<" in report and "steps skipped" in report
    state = json.loads((again.checkpoint / "training/state.json").read_text())
    assert state["skipped"] == whole.skipped


@pytest.mark.slow
def test_two_ranks_leave_out_the_steps_that_one_leaves_out(tmp_path):
    skipping = recipe(make_hurt(tmp_path / "hurt"), nonfinite="skip", batch_size=1, accumulate=4, steps=10)
    train(skipping, out=tmp_path / "alone", show=False)
    told = spread(skipping, tmp_path / "run")
    one, two = taken(tmp_path / "alone"), taken(tmp_path / "run")
    assert [(s, loss is None, n) for s, loss, n in two] == [(s, loss is None, n) for s, loss, n in one], told
    assert one[-1][2] > 0
    assert [v for _, v, _ in two if v] == pytest.approx([v for _, v, _ in one if v], rel=1e-4)


@pytest.mark.slow
def test_two_ranks_stop_with_one_error_that_names_the_window(tmp_path):
    hurt = recipe(make_hurt(tmp_path / "hurt"), batch_size=1, accumulate=4)
    said = errors(spread(hurt, tmp_path / "run", codes=(1, 1)))
    assert len(said) == 1, said
    assert f"windows: arm episode {EPISODE} (e{EPISODE}) frames" in said[0] and "; arm" not in said[0]


def test_losses_of_several_objectives_are_kept_apart():
    metrics = StepMetrics(["arm", "hand"], torch.device("cpu"), "forward")
    for name, objective, losses in (
        ("arm", "forward", [3.0, 5.0]), ("hand", "policy", [0.5, 0.5]), ("arm", "policy", [0.25, 0.25]),
    ):  # fmt: skip
        values = torch.tensor(losses)
        metrics.add([name] * 2, SimpleNamespace(per_sample=values, loss=values.mean(), objective=objective))
    loss, by_embodiment, by_objective = metrics.whole(Ranks(), 3)
    assert loss == pytest.approx((4 + 0.5 + 0.25) / 3)
    assert by_embodiment == {"arm": 4} and by_objective == {"forward": 4, "policy": 0.375}


# -- what a run goes on from


@pytest.fixture(scope="module")
def averaged(tmp_path_factory):
    data = [str(make_shards(tmp_path_factory.mktemp("shards") / "arm", "arm"))]

    def averaged(**changes):
        return make_recipe({**TINY, "data": data, "ema": 0.5, **changes})

    return averaged


@pytest.fixture(scope="module")
def whole(averaged, tmp_path_factory):
    return train(averaged(), out=tmp_path_factory.mktemp("whole") / "run", show=False).out


@pytest.mark.parametrize(
    "name",
    [
        "config.json", "trunk.safetensors", "embodiments/arm/stem.safetensors", "embodiments/arm/stats.json",
        "training/state.json", "training/optimizer.safetensors",
        "training/weights.safetensors",
    ],
)  # fmt: skip
def test_a_flipped_bit_is_found_wherever_it_is(averaged, tmp_path, capsys, name, whole):
    run = shutil.copytree(whole, tmp_path / "run")
    path = run / "checkpoints/step-00000006" / name
    content = bytearray(path.read_bytes())
    place = content.rindex(b"1") if path.suffix == ".json" else len(content) - 3
    content[place] ^= 1
    path.write_bytes(content)
    assert same(whole / "checkpoints/step-00000006", train(averaged(), out=run).checkpoint)
    assert f"skipped a damaged checkpoint: {run}/checkpoints/step-00000006" in capsys.readouterr().err


def test_new_checkpoints_stay_though_a_damaged_one_is_ahead_of_them(averaged, tmp_path, monkeypatch, whole):
    run = shutil.copytree(whole, tmp_path / "run")
    (run / "checkpoints/step-00000006/trunk.safetensors").write_bytes(b"damaged")
    kept, save = [], Run.save

    def saved(self):
        path = save(self)
        kept.append([path.name, *(one.name for one in training_checkpoints(run))])
        return path

    monkeypatch.setattr(Run, "save", saved)
    train(averaged(checkpoint_every=1, keep_last=1), out=run)
    assert kept == [[f"step-0000000{step}"] * 2 for step in range(int(kept[0][0][-1]), 7)]
    assert len(kept) > 1


@pytest.mark.parametrize(
    ("file", "key"), [("config.json", "format_version"), ("training/state.json", "version")]
)
def test_a_newer_releases_checkpoint_is_not_passed_over(averaged, tmp_path, whole, file, key):
    run = shutil.copytree(whole, tmp_path / "run")
    path = run / "checkpoints/step-00000006" / file
    path.write_text(json.dumps({**json.loads(path.read_text()), key: 7}))
    with pytest.raises(CheckpointError, match=rf"is of {key} 7, this release resumes from 1 .*start="):
        train(averaged(), out=run, show=False)
    assert (run / "checkpoints/step-00000006").is_dir()


@pytest.mark.parametrize(
    ("shards", "network", "message"),
    [
        ({}, {"width": 32}, "another network: width is 32, it was 16"),
        ({"spec": OTHER}, {}, "another tokenizer: 'raw', now 'other'"),
        ({"dims": 5}, {}, "was started on arm with action_dim 2, the shards have 5"),
    ],
)
def test_not_even_force_goes_on_with_another_network_tokenizer_or_actions(
    averaged, whole, tmp_path, shards, network, message
):
    changes = {"model": {**TINY["model"], **network}}
    if shards:
        changes["data"] = [str(make_shards(tmp_path / "arm", "arm", **shards))]
    with pytest.raises(RecipeError, match=message):
        train(averaged(**changes, steps=8), out=whole, show=False, force=True)


@pytest.mark.parametrize(
    ("out", "said"),
    [(None, "is not given"), (" ", "is not given"), ("s3://bucket/run", "not a local folder")],
)
def test_what_cannot_be_a_folder_is_wrong_usage(averaged, out, said):
    with pytest.raises(UsageError, match=said):
        train(averaged(), out=out, show=False)


def test_every_line_of_progress_is_said_once(averaged, tmp_path, capsys):
    train(averaged(), out=tmp_path / "run")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == len(set(lines)) and lines[-2].startswith("windows: ")
    assert lines[-1].startswith("training: 6/6 steps") and "loss arm" in lines[-1]
    assert lines[-3].startswith("step 6: loss arm") and "validation" in lines[-3]
    assert "\x1b" not in "".join(lines)


def test_a_resumed_run_says_where_it_continues(averaged, tmp_path, capsys):
    train_until(averaged(), tmp_path / "run", 5)
    for said in (["continues after step 4"], []):  # and a finished one says nothing of it
        train(averaged(), out=tmp_path / "run")
        assert [line for line in capsys.readouterr().err.splitlines() if line.startswith("continues")] == said


def test_a_line_of_metrics_that_is_damaged_is_left_out(averaged, whole, tmp_path):
    run = shutil.copytree(whole, tmp_path / "run")
    lines = (run / "metrics.jsonl").read_bytes().splitlines(keepends=True)
    (run / "metrics.jsonl").write_bytes(
        b"".join([*lines[:2], b"\xff\n", b"[1]\n", b'{"step": "x"}\n', *lines[2:]])
    )
    assert train(averaged(), out=run, show=False).losses == [
        (line["step"], line["loss"]) for line in map(json.loads, lines) if line["kind"] == "train"
    ]


def test_the_same_tensors_give_the_same_bytes(tmp_path):
    metadata = {f"key{i}": f'val"ue {i}' for i in range(8)}
    tensors = {"b": torch.arange(3.0), "a.é": torch.ones(2, 2, dtype=torch.bfloat16)}
    contents = set()
    for i in range(8):
        write_tensors(tmp_path / f"{i}.safetensors", tensors, metadata)
        contents.add((tmp_path / f"{i}.safetensors").read_bytes())
    assert len(contents) == 1 and read_metadata(tmp_path / "0.safetensors") == metadata
    read = read_tensors(tmp_path / "0.safetensors")
    assert all(torch.equal(value, tensors[name]) for name, value in read.items())
