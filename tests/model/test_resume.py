"""What a run goes on from: whole checkpoints of its own format versions, and nothing else unsaid."""

import json
import shutil

import pytest
import torch

from hma_data.errors import CheckpointError
from hma_model.recipe import make_recipe
from hma_model.train import train
from tests.model.runs import TINY, same
from tests.model.shards import make_shards


@pytest.fixture(scope="module")
def recipe(tmp_path_factory):
    torch.set_num_threads(1)
    data = [str(make_shards(tmp_path_factory.mktemp("shards") / "arm", "arm"))]

    def recipe(**changes):
        return make_recipe({**TINY, "data": data, "ema": 0.5, **changes})

    return recipe


@pytest.fixture(scope="module")
def whole(recipe, tmp_path_factory):
    """A run that was never cut."""
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
    assert train(recipe(), out=run).step == 6
    assert f"passed over a damaged checkpoint: {run}/checkpoints/step-00000006" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("file", "key"), [("config.json", "format_version"), ("training/state.json", "version")]
)
def test_a_newer_releases_checkpoint_is_not_passed_over(recipe, tmp_path, whole, file, key):
    run = shutil.copytree(whole, tmp_path / "run")
    path = run / "checkpoints/step-00000006" / file
    path.write_text(json.dumps({**json.loads(path.read_text()), key: 7}))
    with pytest.raises(CheckpointError, match=rf"is of {key} 7, this release trains on with 1 .*start="):
        train(recipe(), out=run, show=False)
    assert (run / "checkpoints/step-00000006").is_dir()


def test_a_checkpoint_of_before_hashes_and_versions_goes_on(recipe, tmp_path, whole):
    run = shutil.copytree(whole, tmp_path / "run")
    shutil.rmtree(run / "checkpoints/step-00000006")
    path = run / "checkpoints/step-00000004/training/state.json"
    old = {k: v for k, v in json.loads(path.read_text()).items() if k not in ("version", "files", "sha256")}
    path.write_text(json.dumps(old))
    assert same(train(recipe(), out=run, show=False).checkpoint, whole / "checkpoints/step-00000006")
