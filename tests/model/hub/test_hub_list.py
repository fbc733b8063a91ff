"""What `hma hub list` says of a folder or repository, and the picture that goes into the card."""

import json
import shutil
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from safetensors.torch import save_file
from typer.testing import CliRunner

from hma_data.errors import CheckpointError, UsageError
from hma_data.tokenizers.base import get_tokenizer
from hma_model.checkpoint.io import Checkpoint
from hma_model.cli import app, main
from hma_model.config import HMAConfig
from hma_model.hub import publish as hub
from hma_model.hub.listing import survey
from hma_model.hub.sample import add_samples
from hma_model.worlds.images import sample_image
from tests.model.robots import Blocks, make_model, save
from tests.model.shards import make_shards


@pytest.fixture
def painted(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("hma_model.hub.sample.tokenizer_of", lambda shards: Blocks())


@pytest.fixture
def shelf(folder: Path, tmp_path: Path) -> Path:
    hub.push(folder, tmp_path / "shelf/team/model")
    released = tmp_path / "shelf/liruiw/hma-base"
    released.mkdir(parents=True)
    values = {
        "num_layers": 32,
        "num_heads": 8,
        "d_model": 256,
        "action_domains": ["bridge"],
        "d_actions": [14],
    }
    (released / "config.json").write_text(json.dumps(values))
    save_file(make_model({}).trunk_state(), released / "model.safetensors")
    (tmp_path / "shelf/bert").mkdir()
    (tmp_path / "shelf/bert/config.json").write_text('{"model_type": "bert"}')
    return tmp_path / "shelf"


def test_ours_and_the_releases_stand_side_by_side(shelf, folder):
    released, ours = survey(shelf)
    assert ours["checkpoint"].endswith("shelf/team/model") and ours["format"] == "hma-toolkit"
    assert ours["trunk_sha256"] == Checkpoint.open(folder).trunk_sha256
    assert ours["trunk_bytes"] == (folder / "trunk.safetensors").stat().st_size
    arm, hand = ours["embodiments"]
    assert (arm["embodiment"], arm["action_dim"], arm["hz"], arm["val_loss"]) == ("arm", 2, 5.0, 1.5)
    assert hand["bytes"] > 1000 and hand["problems"] == []
    assert released["format"] == "released" and "hma hub import" in released["problems"][0]
    assert [(row["embodiment"], row["chunk_dim"]) for row in released["embodiments"]] == [("bridge", 14)]


def test_what_cannot_be_used_here_says_why(folder):
    def change(path, **values):
        path.write_text(json.dumps({**json.loads(path.read_text()), **values}))

    change(folder / "embodiments/arm/card.json", trunk_sha256="0" * 64)
    (folder / "embodiments/hand/head.safetensors").unlink()
    tokenizer = json.loads((folder / "config.json").read_text())["tokenizer"]
    change(folder / "config.json", tokenizer={**tokenizer, "name": "theirs"}, format_version=9)
    (facts,) = survey(folder)
    assert any("'theirs' is not one of this release" in problem for problem in facts["problems"])
    assert any("has format_version 9" in problem and "update" in problem for problem in facts["problems"])
    arm, hand = facts["embodiments"]
    assert "belongs to another trunk" in arm["problems"] and "lacks head.safetensors" in hand["problems"]


def test_a_trainings_folder_lists_its_checkpoints(tmp_path):
    for step in (10, 20):
        save(tmp_path / f"run/checkpoints/step-{step:08d}", {"arm": 2}, seed=step)
    found = survey(tmp_path / "run")
    assert [facts["checkpoint"][-8:] for facts in found] == ["00000010", "00000020"]


def test_the_command_prints_a_table_and_the_same_as_json(shelf):
    shown = CliRunner().invoke(app, ["hub", "list", str(shelf)]).stdout
    for word in (
        "hma-toolkit",
        "released",
        "convert it with hma hub import",
        "arm",
        "an arm",
        "1.5",
        "bridge",
    ):
        assert word in shown
    facts = json.loads(CliRunner().invoke(app, ["hub", "list", str(shelf), "--json"]).stdout)
    assert facts["checkpoints"] == survey(shelf)
    one = json.loads(CliRunner().invoke(app, ["hub", "list", str(shelf / "team/model"), "--json"]).stdout)
    assert [row["embodiment"] for row in one["embodiments"]] == ["arm", "hand"]


def test_a_strangers_text_cannot_steer_the_terminal(folder):
    for path in (folder / "embodiments/arm/card.json", folder / "config.json"):
        values = json.loads(path.read_text())
        values |= {"robot": "\x1b[2J\x1b]0;gone\x07[red]", "model": {"layers": "\x1b[31m", "width": [1]}}
        path.write_text(json.dumps(values))
    shown = CliRunner().invoke(app, ["hub", "list", str(folder)])
    assert shown.exit_code == 0 and r"\x1b[2J\x1b]0;gone\x07[red]" in shown.stdout
    assert "\x1b" not in shown.stdout and "\x07" not in shown.stdout


def test_a_sample_shows_truth_and_predictions_over_time(folder, tmp_path, painted):
    path, film = add_samples(folder, [make_shards(tmp_path / "shards", "arm")])
    picture = np.asarray(Image.open(path))
    height, width = picture.shape[:2]
    assert width > height > 2 * 128 and len(np.unique(picture)) > 5
    first = sample_image(Checkpoint.open(folder), "arm")  # a frame of the model's size, as it was painted
    assert first is not None and first.shape == (16, 16, 3)
    assert np.array_equal(first.repeat(8, 0).repeat(8, 1), picture[22 : 22 + 128, 4 : 4 + 128])
    with Image.open(film) as opened:  # four frames at 5 Hz: truth, true actions, other actions
        assert (opened.format, opened.n_frames, opened.info["duration"]) == ("GIF", 4, 200)
        assert opened.size[0] > 3 * 192


def test_the_picture_is_pushed_with_its_embodiment_and_shown_in_the_card(folder, tmp_path, painted):
    add_samples(folder, [make_shards(tmp_path / "shards", "arm")])
    hub.push(folder, tmp_path / "hub")
    page = (tmp_path / "hub/README.md").read_text()
    assert "(embodiments/arm/sample.gif)" in page and "(embodiments/hand/sample." not in page
    home = hub.pull(tmp_path / "hub", ["arm"], tmp_path / "out") / "embodiments/arm"
    assert (home / "sample.png").is_file() and (home / "sample.gif").is_file()


def test_new_weights_take_the_film_of_older_ones_from_the_hub(folder, tmp_path, painted):
    bare = shutil.copytree(folder, tmp_path / "bare")
    add_samples(folder, [make_shards(tmp_path / "shards", "arm")])
    hub.push(folder, tmp_path / "hub")
    hub.push(bare, tmp_path / "hub", ["hand"])
    assert (tmp_path / "hub/embodiments/arm/sample.gif").is_file()  # of a robot that is not pushed
    hub.push(bare, tmp_path / "hub", ["arm"])
    assert not list((tmp_path / "hub/embodiments/arm").glob("sample.*"))
    assert "sample." not in (tmp_path / "hub/README.md").read_text()


def test_samples_are_not_written_into_the_package(tmp_path):
    with pytest.raises(CheckpointError, match="is part of the installed package"):
        add_samples("embedded", [make_shards(tmp_path / "shards", "arm")])


def test_weights_of_ones_own_are_named_where_a_model_is_listed(tmp_path):
    spec = get_tokenizer("fsq-lab").spec.to_json()
    config = HMAConfig(
        layers=1, width=16, heads=2, frames=4, grid=(16, 16), factored=(8,) * 5, tokenizer=spec
    )
    save(tmp_path / "usual", {"arm": 2}, model=make_model({"arm": 2}, config=config))
    own = config.replace(tokenizer={**spec, "weights_sha256": "0293" * 16})
    save(tmp_path / "own", {"arm": 2}, model=make_model({"arm": 2}, config=own))
    assert [one["problems"] for one in survey(tmp_path / "usual")] == [[]]
    assert "weights of its own (029302930293…)" in survey(tmp_path / "own")[0]["problems"][0]
    usual, other = ((tmp_path / name / "README.md").read_text() for name in ("usual", "own"))
    assert 'get_tokenizer("fsq-lab", weights="WEIGHTS")' in other and "0293" * 16 in other
    assert 'get_tokenizer("fsq-lab")' in usual


def test_the_command_makes_the_picture_on_pushing(folder, tmp_path, painted):
    shards = make_shards(tmp_path / "shards", "hand", dims=3)
    call = ["hub", "push", str(folder), str(tmp_path / "hub"), "--sample", str(shards)]
    assert CliRunner().invoke(app, call).exit_code == 0
    assert (tmp_path / "hub/embodiments/hand/sample.png").read_bytes()[:4] == b"\x89PNG"


def test_a_runs_own_shards_make_the_film_while_they_are_there(folder, tmp_path, painted, capsys):
    run = tmp_path / "run"
    (run / "checkpoints").mkdir(parents=True)
    folder.rename(run / "checkpoints" / "step-00000001")
    short = make_shards(tmp_path / "short", "hand", dims=3, length=3)
    data = [make_shards(tmp_path / "shards", "arm"), short, tmp_path / "moved"]
    (run / "recipe.json").write_text(json.dumps({"data": [str(path) for path in data]}))
    assert main(["hub", "push", str(run), str(tmp_path / "plain"), "--no-film"]) == 0
    assert not list((tmp_path / "plain").rglob("*.gif"))
    assert main(["hub", "push", str(run), str(tmp_path / "hub")]) == 0
    assert [path.parent.name for path in (tmp_path / "hub").rglob("*.gif")] == ["arm"]
    assert capsys.readouterr().err.count("no video: ") == 1


def test_a_push_tells_how_to_fetch_it(folder, tmp_path, capsys):
    call = ["hub", "push", str(folder), f"{tmp_path}/hub/model", "--no-film", "-e", "hand"]
    assert main(call) == 0
    fetch = f"fetch it: hma hub pull {tmp_path}/hub/model -e hand --out model-pulled\n"
    assert capsys.readouterr().out == f"published to {tmp_path}/hub/model\n{fetch}"


def test_shards_of_another_robot_or_too_short_make_no_picture(folder, tmp_path):
    with pytest.raises(CheckpointError, match="has no embodiment 'leg'"):
        add_samples(folder, [make_shards(tmp_path / "leg", "leg")])
    with pytest.raises(UsageError, match="no window of 4 frames"):
        add_samples(folder, [make_shards(tmp_path / "short", "arm", length=3)])
