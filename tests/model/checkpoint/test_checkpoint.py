"""Checkpoints: what is saved comes back, parts that do not belong together do not, and files stay whole."""

import hashlib
import json
import os
import shutil
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import load_file

from hma_data.errors import CheckpointError
from hma_data.tokenizers.shapes import palette_spec
from hma_model.checkpoint import io
from hma_model.checkpoint import io as checkpoint
from hma_model.checkpoint.folder import (
    README,
    SAMPLE,
    STEM,
    TRUNK,
    Checkpoint,
    read_metadata,
    require_tokenizer,
)
from hma_model.network.model import HMA
from tests.model.robots import CONFIG, SPEC, edit_card, make_model, save, yaml
from tests.model.robots import stats as stats_of

ROBOTS = {"arm": 2, "hand.v2": 3}


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    save(tmp_path / "model", ROBOTS)
    return tmp_path / "model"


def states(model) -> dict[str, torch.Tensor]:
    return {name: value.clone() for name, value in model.state_dict().items()}


def test_every_weight_comes_back_bit_for_bit(tmp_path):
    model = save(tmp_path / "m", ROBOTS)
    again = checkpoint.load(tmp_path / "m")
    assert states(again).keys() == states(model).keys()
    assert all(torch.equal(value, states(again)[name]) for name, value in states(model).items())


def test_the_layout_is_the_contracts(folder):
    files = {str(path.relative_to(folder)) for path in folder.rglob("*") if path.is_file()}
    parts = ("stem.safetensors", "head.safetensors", "embodiment.yaml", "stats.json", "card.json")
    expected = {"config.json", "trunk.safetensors", "README.md"}
    assert files == expected | {f"embodiments/{name}/{part}" for name in ROBOTS for part in parts}
    assert json.loads((folder / "config.json").read_text())["format_version"] == 1


def test_the_cards_and_stems_name_the_trunk_by_its_sha256(folder):
    trunk = hashlib.sha256((folder / "trunk.safetensors").read_bytes()).hexdigest()
    for name in ROBOTS:
        assert Checkpoint.open(folder).card(name)["trunk_sha256"] == trunk
        stem = folder / "embodiments" / name / "stem.safetensors"
        assert read_metadata(stem)["trunk_sha256"] == trunk


def test_saving_a_loaded_model_gives_the_same_files(folder, tmp_path):
    save(tmp_path / "again", ROBOTS, model=checkpoint.load(folder))
    for path in folder.rglob("*.*"):
        if path.name != "README.md" and path.is_file():
            same = (tmp_path / "again" / path.relative_to(folder)).read_bytes() == path.read_bytes()
            # a stem's metadata has several keys, whose order safetensors leaves open
            assert same or path.suffix == ".safetensors" or path.name == "card.json", path
    assert (tmp_path / "again/trunk.safetensors").read_bytes() == (folder / "trunk.safetensors").read_bytes()


def test_loading_one_embodiment_reads_no_other(folder):
    for path in (folder / "embodiments/hand.v2").iterdir():
        path.write_bytes(b"not what it should be")
    assert list(checkpoint.load(folder, ["arm"]).embodiments) == ["arm"]


def test_an_unknown_embodiment_is_named_with_those_there(folder):
    with pytest.raises(CheckpointError, match=r"no embodiment 'leg'.*arm, hand\.v2"):
        checkpoint.load(folder, ["leg"])


@pytest.mark.parametrize("name", ["../arm", "arm/../arm", "/etc", "", "a\\b", "..", "a..b"])
def test_a_name_that_is_no_id_is_refused(folder, name):
    with pytest.raises(CheckpointError, match="not an embodiment's id"):
        checkpoint.load(folder, [name])


def test_a_tokenizer_other_than_the_models_is_refused_with_the_difference(folder):
    other = {**SPEC.to_json(), "image_size": 32}
    with pytest.raises(CheckpointError, match="image_size is 16 there and 32 here"):
        require_tokenizer(Checkpoint.open(folder).config, type(SPEC).from_json(other), folder)


def test_colours_other_than_the_models_are_refused_with_where_its_own_are():
    spec, other = (palette_spec("palette-64", 64, np.eye(3, dtype=np.uint8) * n) for n in (1, 2))
    config = CONFIG.replace(tokenizer=spec.to_json(), factored=spec.factored)
    with pytest.raises(CheckpointError, match="other colours of 'palette-64' — .*--weights PATH"):
        require_tokenizer(config, other, "runs/own")


@pytest.mark.parametrize("colors", ["zz0000", "../../x", 7, "ffffff" * 300, "ffffff000000"])
def test_a_configuration_of_colours_that_are_none_names_its_file(folder, colors):
    path = folder / "config.json"
    values = json.loads(path.read_text())
    values["tokenizer"]["colors"] = colors
    path.write_text(json.dumps(values))
    with pytest.raises(CheckpointError, match=r"config\.json: does not describe a model: tokenizer: ha?"):
        Checkpoint.open(folder)


def test_the_links_of_a_hub_cache_are_followed(folder, tmp_path):
    snapshot, blobs = tmp_path / "cache/snapshots/abc", tmp_path / "cache/blobs"
    shutil.copytree(folder, snapshot)
    blobs.mkdir()
    for number, path in enumerate(sorted(snapshot.rglob("*.*"))):
        if path.is_file():
            path.rename(blobs / str(number))
            path.symlink_to(os.path.relpath(blobs / str(number), path.parent))
    assert set(checkpoint.load(snapshot).embodiments) == set(ROBOTS)


def test_a_failed_save_leaves_the_older_checkpoint_intact(folder, tmp_path):
    before = {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()}

    def full_disk(_: Path) -> None:
        raise OSError(28, "No space left on device")

    with pytest.raises(CheckpointError, match="No space left on device"):
        save(folder, ROBOTS, seed=1, training=full_disk)
    assert {path: path.read_bytes() for path in folder.rglob("*") if path.is_file()} == before
    assert [path.name for path in tmp_path.iterdir()] == ["model"]


def test_saving_over_a_checkpoint_replaces_it_whole(folder):
    model = save(folder, {"arm": 2}, seed=1)
    again = checkpoint.load(folder)
    assert list(again.embodiments) == ["arm"]
    assert torch.equal(again.trunk.position, model.trunk.position)


def test_a_folder_with_something_else_is_not_overwritten(tmp_path):
    (tmp_path / "thesis.tex").write_text("years of work")
    with pytest.raises(CheckpointError, match="is not a checkpoint"):
        save(tmp_path, {"arm": 2})
    assert (tmp_path / "thesis.tex").read_text() == "years of work"


def test_a_model_with_an_embodiment_without_yaml_is_not_saved(tmp_path):
    with pytest.raises(CheckpointError, match="no embodiment YAML was given for hand"):
        robots = {"arm": yaml("arm")}
        numbers = {"arm": stats_of(2)}
        checkpoint.save(make_model(ROBOTS), tmp_path / "m", embodiment_yaml=robots, stats=numbers, cards={})


def test_a_training_runs_folder_stands_for_its_newest_checkpoint(tmp_path):
    save(tmp_path / "run/checkpoints/step-00000010", {"arm": 2})
    newest = save(tmp_path / "run/checkpoints/step-00000020", {"arm": 2}, seed=2)
    assert torch.equal(checkpoint.load(tmp_path / "run").trunk.position, newest.trunk.position)


def test_a_missing_folder_and_an_empty_one_say_so(tmp_path):
    with pytest.raises(CheckpointError, match="no such folder"):
        checkpoint.load(tmp_path / "nothing")
    with pytest.raises(CheckpointError, match=r"has no config\.json"):
        checkpoint.load(tmp_path)


def test_metrics_of_the_card_are_in_the_readme(folder):
    edit_card(folder, "arm", metrics={"psnr": 21.25})
    assert "psnr 21.25" in (folder / "README.md").read_text()
    checkpoint.load(folder)


def test_the_config_comes_back(folder):
    assert Checkpoint.open(folder).config == CONFIG


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
