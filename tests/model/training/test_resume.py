"""What a run goes on from: whole checkpoints of its own format versions, and nothing else unsaid."""

import json
import shutil

import pytest
import torch

from hma_data.errors import CheckpointError, RecipeError, UsageError
from hma_data.tokenizers.base import TokenizerSpec
from hma_model.checkpoint.folder import read_metadata
from hma_model.checkpoint.weights import read_tensors, write_tensors
from hma_model.training.loop import train
from hma_model.training.recipe import make_recipe
from tests.model.robots import SPEC
from tests.model.runs import TINY, same, train_until
from tests.model.shards import make_shards


@pytest.fixture(scope="module")
def recipe(tmp_path_factory):
    data = [str(make_shards(tmp_path_factory.mktemp("shards") / "arm", "arm"))]

    def recipe(**changes):
        return make_recipe({**TINY, "data": data, "ema": 0.5, **changes})

    return recipe


@pytest.fixture(scope="module")
def whole(recipe, tmp_path_factory):
    return train(recipe(), out=tmp_path_factory.mktemp("whole") / "run", show=False).out


@pytest.mark.parametrize(
    "name",
    [
        "config.json", "trunk.safetensors", "embodiments/arm/stem.safetensors", "embodiments/arm/stats.json",
        "training/state.json", "training/optimizer.safetensors",
        "training/weights.safetensors",
    ],
)  # fmt: skip
def test_a_flipped_bit_is_found_wherever_it_is(recipe, tmp_path, capsys, name, whole):
    run = shutil.copytree(whole, tmp_path / "run")
    path = run / "checkpoints/step-00000006" / name
    content = bytearray(path.read_bytes())
    place = content.rindex(b"1") if path.suffix == ".json" else len(content) - 3
    content[place] ^= 1
    path.write_bytes(content)
    assert same(whole / "checkpoints/step-00000006", train(recipe(), out=run).checkpoint)
    assert f"skipped a damaged checkpoint: {run}/checkpoints/step-00000006" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("file", "key"), [("config.json", "format_version"), ("training/state.json", "version")]
)
def test_a_newer_releases_checkpoint_is_not_passed_over(recipe, tmp_path, whole, file, key):
    run = shutil.copytree(whole, tmp_path / "run")
    path = run / "checkpoints/step-00000006" / file
    path.write_text(json.dumps({**json.loads(path.read_text()), key: 7}))
    with pytest.raises(CheckpointError, match=rf"is of {key} 7, this release resumes from 1 .*start="):
        train(recipe(), out=run, show=False)
    assert (run / "checkpoints/step-00000006").is_dir()


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"model": {**TINY["model"], "width": 32}}, "another network: width is 32, it was 16"),
        ({"model": {**TINY["model"], "qk_norm": True}}, "another network: qk_norm is True, it was False"),
    ],
)
def test_not_even_force_goes_on_with_another_network(recipe, whole, changes, message):
    with pytest.raises(RecipeError, match=message):
        train(recipe(**changes, steps=8), out=whole, show=False, force=True)


def test_not_even_force_goes_on_with_another_tokenizer(recipe, whole, tmp_path):
    spec = TokenizerSpec(**{**SPEC.to_json(), "name": "other"})
    shards = make_shards(tmp_path / "arm", "arm", spec=spec)
    with pytest.raises(RecipeError, match="another tokenizer: 'raw', now 'other'"):
        train(recipe(data=[str(shards)], steps=8), out=whole, show=False, force=True)


def test_robots_that_force_leaves_behind_are_named(recipe, whole, tmp_path, capsys):
    run, hand = shutil.copytree(whole, tmp_path / "run"), make_shards(tmp_path / "hand", "hand", dims=3)
    train(recipe(data=[str(hand)], steps=7), out=run, force=True)
    assert "the next checkpoints leave out: arm" in capsys.readouterr().err


@pytest.mark.parametrize("out", [None, "", " "])
def test_what_cannot_be_a_folder_is_wrong_usage(recipe, out):
    with pytest.raises(UsageError, match="out: is not given"):
        train(recipe(), out=out, show=False)


def test_every_line_of_progress_is_said_once(recipe, tmp_path, capsys):
    train(recipe(), out=tmp_path / "run")
    lines = capsys.readouterr().err.splitlines()
    assert len(lines) == len(set(lines)) and lines[-2].startswith("windows: ")
    assert lines[-1].startswith("training: 6/6 steps") and "loss arm" in lines[-1]
    assert lines[-3].startswith("step 6: loss arm") and "validation" in lines[-3]
    assert "\x1b" not in "".join(lines)


def test_a_resumed_run_says_where_it_continues(recipe, tmp_path, capsys):
    train_until(recipe(), tmp_path / "run", 5)
    for said in (["continues after step 4"], []):  # and a finished one says nothing of it
        train(recipe(), out=tmp_path / "run")
        assert [line for line in capsys.readouterr().err.splitlines() if line.startswith("continues")] == said


def test_a_line_of_metrics_that_is_damaged_is_left_out(recipe, whole, tmp_path):
    run = shutil.copytree(whole, tmp_path / "run")
    lines = (run / "metrics.jsonl").read_bytes().splitlines(keepends=True)
    (run / "metrics.jsonl").write_bytes(
        b"".join([*lines[:2], b"\xff\n", b"[1]\n", b'{"step": "x"}\n', *lines[2:]])
    )
    assert train(recipe(), out=run, show=False).losses == [
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
