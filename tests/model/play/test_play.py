"""`hma play` on the command line: what it opens, without serving it."""

import json
import shutil
from importlib.resources import files
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hma_data.episodes.sheets import write_png
from hma_data.lab import record
from hma_model.checkpoint.folder import BUNDLED, Checkpoint
from hma_model.checkpoint.io import record_evaluation
from hma_model.cli import main
from hma_model.play.holding import MEASURED, Holding, holdings
from tests.hub_server import Hub
from tests.hub_state import REPO, ROBOTS
from tests.model.robots import save

pytest_plugins = ["tests.hub_fixtures"]


@pytest.fixture
def served(monkeypatch: pytest.MonkeyPatch) -> list[tuple[Any, ...]]:
    kept: list[tuple[Any, ...]] = []

    async def serve(*given: Any, **settings: Any) -> None:
        kept.append((*given, settings))

    monkeypatch.setattr("hma_model.play.server.serve", serve)
    monkeypatch.setattr("hma_data.tokenizers.base.get_tokenizer", lambda name, device: name)
    return kept


@pytest.fixture
def image(tmp_path: Path) -> str:
    write_png(tmp_path / "an image.png", np.zeros((40, 30, 3), np.uint8))
    return str(tmp_path / "an image.png")


@pytest.mark.parametrize("address", [REPO, f"{REPO}@main", f"hf://{REPO}"])
def test_a_published_checkpoint_is_fetched(published, served, image, address) -> None:
    assert main(["play", address, "--prompt", image, "--no-browser"]) == 0
    (([part], name, *_),) = served
    assert name == address and set(part.robots) == {f"{robot}:images" for robot in ROBOTS}
    assert set(Checkpoint.open(part.checkpoint.folder).embodiments) == set(ROBOTS)


def test_the_bundled_model_is_played_with_all_its_checkpoints(served) -> None:
    assert main(["play", "-e", "pusht_fast", "--no-browser"]) == 0
    ((parts, name, *_, settings),) = served
    assert [part.checkpoint.name for part in parts] == list(BUNDLED)
    assert name == "the bundled model" and settings["first"] == "pusht_fast"
    robots = [set(part.robots) for part in parts]
    assert robots[0] == {"pendulum"} and robots[4:] == [{"fetch:images"}, {"pusht_fast"}]
    assert "arm2_02" in robots[1] and "rails_03" in robots[2] and "rails_09" in robots[3]
    assert sum(map(len, robots)) == len(set.union(*robots)) == 17


def test_a_folder_of_the_bundled_models_name_is_played_alone(tmp_path, served, monkeypatch) -> None:
    shutil.copytree(BUNDLED["embedded-fsq"], tmp_path / "embedded")
    monkeypatch.chdir(tmp_path)
    assert main(["play", "--no-browser"]) == 0
    (([part], name, *_),) = served
    assert name == "embedded" and "pusht_fast" not in part.robots


@pytest.mark.slow
def test_a_run_brings_the_shards_of_its_training(tmp_path: Path, request: pytest.FixtureRequest) -> None:
    yaml = tmp_path / "rover.yaml"
    yaml.write_text(Checkpoint.open("embedded").embodiment("mover_04").to_yaml().replace("mover_04", "rover"))
    words = ["convert", "-e", str(yaml), "--source", str(record("mover_04", tmp_path, 2)), "--tokenizer"]
    assert main([*words, "fsq-lab", "--out", str(tmp_path / "shards"), "--workers", "1"]) == 0
    small = ["steps=1", "pictures=0", "report=false", "batch_size=1", "device=cpu", "eval_windows=1"]
    data, out = str(tmp_path / "shards"), str(tmp_path / "run")
    assert main(["finetune", "--from", "embedded", "--data", data, "--out", out, *small]) == 0
    assert json.loads((tmp_path / "run/recipe.json").read_text())["data"] == [data]
    served = request.getfixturevalue("served")  # from here on no tokenizer is real
    assert main(["play", out, "--no-browser"]) == 0
    assert list(served[0][0][0].robots) == ["rover:recordings"]


def test_the_page_opens_with_the_robot_that_was_named_or_the_image_that_was_given(
    published: Hub, served: list[Any], image: str, capsys: pytest.CaptureFixture[str]
) -> None:
    words, last = ["play", REPO, "--prompt", image, "--no-browser"], list(ROBOTS)[-1]
    assert main([*words, "-e", last]) == 0
    assert main(words) == 0
    assert "-e ROBOT selects yours" in capsys.readouterr().err
    assert main(["play", "-e", "mover_04", "--no-browser"]) == 0
    assert main(["play", "--no-browser"]) == 0
    assert [kept[-1]["first"] for kept in served] == [
        f"{last}:images",
        f"{next(iter(ROBOTS))}:images",
        "mover_04",
        None,
    ]
    assert main([*words, "-e", "nobody"]) == 2
    assert "there is no robot 'nobody' to drive" in capsys.readouterr().err


def test_the_device_and_precision_reach_the_world(tmp_path, served, image, monkeypatch) -> None:
    monkeypatch.setattr("hma_model.training.runtime.choose_device", lambda name: name)
    save(tmp_path / "model", {"arm": 2})
    words = ["play", str(tmp_path / "model"), "--prompt", image, "--no-browser"]
    assert main([*words, "--precision", "bf16", "--device", "cuda", "--compile"]) == 0
    assert served[0][-1] == {"device": "cuda", "precision": "bf16", "compile": True, "first": "arm:images"}
    assert main([*words, "--host", "0.0.0.0", "--token", ""]) == 0
    assert served[1][4]  # an empty token is none


def test_the_bundled_models_robots_were_measured() -> None:
    """A new bundled model needs a new measurement: python recipes/bench/holding.py CHECKPOINT."""
    measured = json.loads(files("hma_model.play").joinpath(MEASURED).read_text("utf-8"))
    found = dict[str, Holding]()
    for part in map(Checkpoint.open, BUNDLED.values()):
        assert measured[part.trunk_sha256].keys() == set(part.embodiments)
        found |= holdings(part)
    assert len(measured) == len(BUNDLED)
    assert all(one.follows for one in found.values())


@pytest.mark.parametrize(
    ("verdict", "follows"),
    [
        ("follows its actions: last-frame PSNR gain +4.1 dB", True),
        ("does not follow its actions yet: last-frame PSNR gain +0.1 dB", False),
        ("", None),
    ],
)
def test_of_other_checkpoints_the_verdict_of_evaluate_counts(verdict, follows, tmp_path) -> None:
    save(tmp_path / "model", {"arm": 2})
    checkpoint = Checkpoint.open(tmp_path / "model")
    if verdict:
        record_evaluation(checkpoint, "arm", {"verdict": verdict})
    assert holdings(Checkpoint.open(tmp_path / "model")) == {"arm": Holding(None, False, follows)}


def test_those_that_hold_longest_come_first_and_those_that_do_not_follow_last() -> None:
    known = [
        Holding(1.5, False, False),
        Holding(None, False, None),
        Holding(60, True, True),
        Holding(7.4, False, True),
    ]
    words = [one.words for one in sorted(known, key=lambda one: one.rank)]
    assert words == ["holds 60 s or more", "holds 7 s", "", "does not follow its actions"]
