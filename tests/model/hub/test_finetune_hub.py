"""Finetuning from a hub: what is fetched, which revision, and how the verb says that there is none."""

from pathlib import Path

import pytest

from hma_data.errors import HubError, RecipeError
from hma_model.checkpoint import io as checkpoint
from hma_model.checkpoint.io import Checkpoint
from hma_model.hub import publish as hub
from hma_model.training.loop import finetune
from tests.hub_state import REPO, ROBOTS
from tests.model.processes import run_command
from tests.model.robots import make_model, save
from tests.model.shards import make_shards
from tests.model.training.test_finetune import SHORT

pytest_plugins = ["tests.hub_fixtures"]


@pytest.fixture
def leg(tmp_path) -> Path:
    return make_shards(tmp_path / "leg", "leg", dims=4, seed=2)


def tune(source, leg, out, freeze=True):
    return finetune(str(source), [leg], out=out, freeze_trunk=freeze, overrides=SHORT, show=False)


PARTS = {"stem.safetensors", "head.safetensors", "embodiment.yaml", "stats.json", "card.json"}
ARM, CARDS = {f"embodiments/arm/{part}" for part in PARTS}, {f"embodiments/{n}/card.json" for n in ROBOTS}


@pytest.mark.parametrize(
    ("name", "dims", "freeze", "parts"),
    [
        ("leg", 4, True, CARDS),
        ("leg", 4, False, CARDS),
        ("twin", 2, False, CARDS | ARM),  # may be like it
        ("arm", 2, True, ARM),  # is known
    ],
)
def test_the_trunk_is_fetched_with_what_concerns_the_robot(published, tmp_path, name, dims, freeze, parts):
    result = tune(REPO, make_shards(tmp_path / name, name, dims=dims, seed=5), tmp_path / "run", freeze)
    served = set(published.served())
    assert {"config.json", "trunk.safetensors"} <= served
    assert {one for one in served if one.startswith("embodiments/")} == parts
    assert name in Checkpoint.open(result.checkpoint).embodiments


def test_the_robot_joins_the_others_in_the_repository(published, leg, tmp_path):
    hub.push(tune(REPO, leg, tmp_path / "run").checkpoint, REPO)
    assert set(hub.from_pretrained(REPO).embodiments) == {"arm", "hand", "leg"}


@pytest.mark.parametrize("form", ["{}@{}", "hf://{}@{}"])
def test_a_revision_is_the_one_that_is_fetched(published, leg, tmp_path, form):
    first = published.model(REPO).commits[-1].id
    save(tmp_path / "other", {"arm": 2}, model=make_model({"arm": 2}, seed=5))
    other = checkpoint.Checkpoint.open(tmp_path / "other")
    published.model(REPO).commit(dict.fromkeys(published.model(REPO).files), "empty it")
    hub.push(tmp_path / "other", REPO)
    old = tune(form.format(REPO, first), leg, tmp_path / "run0")
    new = tune(REPO, leg, tmp_path / "run1")
    trunks = [Checkpoint.open(result.checkpoint).trunk_sha256 for result in (old, new)]
    assert trunks[1] == other.trunk_sha256 != trunks[0]
    with pytest.raises(RecipeError, match=f"was started from {REPO}, not from .*{REPO}@{first}"):
        tune(form.format(REPO, first), leg, tmp_path / "run1")


def test_a_revision_that_is_not_there_is_said_and_leaves_no_folder(published, leg, tmp_path):
    with pytest.raises(HubError, match=rf"^{REPO}@.*: has no such revision"):
        tune(f"{REPO}@none", leg, tmp_path / "new/run")
    assert not (tmp_path / "new").exists()


@pytest.mark.slow
def test_the_command_finetunes_from_a_repository_and_the_run_goes_on_without_it(published, leg, tmp_path):
    cache = {"HF_ENDPOINT": published.url, "HF_HUB_CACHE": str(tmp_path / "c"), "HF_HUB_DISABLE_XET": "1"}
    words = ["finetune", "--from", REPO, "--data", str(leg), "--freeze-trunk", "--out", str(tmp_path / "run")]
    done = run_command(tmp_path, *words, *SHORT, env=cache)
    assert done.returncode == 0 and "trunk frozen" in done.stderr, done.stderr
    asked = len(published.log)
    assert tune(REPO, leg, tmp_path / "run").step == 4 and len(published.log) == asked
