"""Cards as the Hub reads them: their metadata by its own client, and code that runs as pasted."""

import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from huggingface_hub import DatasetCard, ModelCard

from hma_data.tokenizers.base import get_tokenizer
from hma_data.tokenizers.shapes import get_spec, palette_spec
from hma_model.checkpoint.folder import Checkpoint
from hma_model.checkpoint.io import record_evaluation
from hma_model.checkpoint.model_card import licence, render
from hma_model.cli import main
from hma_model.config import HMAConfig
from hma_model.hub import publish as hub
from hma_model.hub.datasets import push_data
from hma_model.hub.listing import list_embodiments
from hma_model.network.model import HMA
from recipes.bench import holds
from tests.model.robots import edit_card, make_model, save
from tests.model.shards import make_shards

pytest_plugins = ["tests.hub_fixtures"]
REPO = "team/model"


def test_the_hubs_filters_find_a_model_by_its_data_and_its_base(tmp_path: Path) -> None:
    save(tmp_path / "model", {"arm": 2, "hand": 3})
    edit_card(
        tmp_path / "model", "arm",
        data={"episodes": 3, "source": "hf://datasets/team/arms/v1", "shards": "hf://datasets/team/shards"},
        training={"steps": 5, "from": "team/base@main"},
    )  # fmt: skip
    edit_card(tmp_path / "model", "hand", data={"source": "s3://a/b"}, training={"from": "a: b\n- c"})
    hub.push(tmp_path / "model", tmp_path / "hub")
    card: Any = ModelCard.load(tmp_path / "hub" / "README.md").data
    assert (card.library_name, card.pipeline_tag, card.license) == ("hma-toolkit", "robotics", "apache-2.0")
    assert card.datasets == ["team/arms", "team/shards"]
    assert card.base_model == ["team/base"] and card.to_dict()["base_model_relation"] == "finetune"
    assert {"robotics", "world-model", "embodiment:arm", "embodiment:hand"} <= set(card.tags)


@pytest.mark.parametrize(
    ("tokenizer", "views"), [("fsq-lab", 1), ("fsq-lab", 2), pytest.param("vae-8", 1, marks=pytest.mark.slow)]
)
def test_the_cards_code_runs_as_pasted(tokenizer, views, tmp_path, monkeypatch) -> None:
    spec = get_tokenizer(tokenizer).spec
    numbers = {"factored": spec.factored} if spec.kind == "discrete" else {"channels": spec.channels}
    config = HMAConfig(
        kind=spec.kind, layers=1, width=16, heads=2, frames=4, grid=spec.grid, views=views,
        latent_scale=spec.latent_scale, tokenizer=spec.to_json(), **numbers,
    )  # fmt: skip
    save(tmp_path / "model", {"arm": 2}, model=make_model({"arm": 2}, config=config))
    hub.push(tmp_path / "model", tmp_path / "hub")
    card = ModelCard.load(tmp_path / "hub" / "README.md")
    found = re.search(r"```python\n(.*?)```", card.text, re.DOTALL)
    assert found
    made: dict[str, Any] = {}
    monkeypatch.chdir(tmp_path / "hub")  # the card says: in this folder
    exec(found[1], made)
    assert made["film"].shape == (6, spec.image_size, spec.image_size, 3) and made["film"].dtype == np.uint8


NOT_YET = "does not follow its actions yet: last-frame PSNR gain +0.1 dB"


def test_a_card_opens_with_the_verdict_of_the_evaluation(folder: Path, tmp_path: Path, capsys) -> None:
    record_evaluation(Checkpoint.open(folder), "arm", {"verdict": NOT_YET, "follows": False})
    assert main(["hub", "push", str(folder), str(tmp_path / "hub")]) == 0
    assert f"arm {NOT_YET}; the model card starts with this verdict" in capsys.readouterr().out
    for page in (folder / "README.md", tmp_path / "hub" / "README.md"):
        text = ModelCard.load(page).text.strip().splitlines()
        assert text[0].startswith("# ") and text[2].startswith("> **arm** does not follow its actions yet")
    (row, other) = list_embodiments(tmp_path / "hub")
    assert (row["verdict"], other["verdict"]) == (NOT_YET, None)


def test_a_card_says_what_is_left_of_objects_and_evaluating_again_keeps_it(folder: Path) -> None:
    keys = ("frame", "limbs", "limbs_whole", "left", "left_whole", "shape", "off", "moved")
    figures = (20, 0.97, 1.0, 0.18, 0.05, 0.15, 1.2, 9), (60, 0.9, 0.5, 0.1, 0.0, 0.1, 1.9, 9)
    rows = [{"robot": "arm", **dict(zip(keys, one, strict=True))} for one in figures]
    holds.record(str(folder), rows, rollouts=12)
    record_evaluation(Checkpoint.open(folder), "arm", {"verdict": NOT_YET, "follows": False})
    text = ModelCard.load(folder / "README.md").text
    assert "> **arm** does not follow its actions yet" in text
    assert (
        "> **arm** in closed loop keeps after 20 frames 97% of the robot's pixels \\(100% of its parts "
        "whole\\), 18% of the pixels of loose objects \\(5% of them whole\\), their shapes overlap the true "
        "ones by 15%." in text
    )
    kept = Checkpoint.open(folder).card("arm")["holds"]
    assert (kept["rollouts"], list(kept["frames"]), kept["frames"]["20"]["off"]) == (12, ["20"], 1.2)


@pytest.mark.parametrize("trained", [False, True])
def test_a_loaded_models_verdict_is_published_unless_its_weights_have_changed(
    folder: Path, tmp_path: Path, trained: bool
) -> None:
    record_evaluation(Checkpoint.open(folder), "arm", {"verdict": NOT_YET, "follows": False})
    model = HMA.from_pretrained(str(folder))
    if trained:
        with torch.no_grad():
            next(model.stem("arm").parameters()).add_(1)
    model.push_to_hub(tmp_path / "hub")
    assert ("evaluation" in Checkpoint.open(tmp_path / "hub").card("arm")) is not trained


def test_a_card_says_what_its_losses_are_of() -> None:
    config: dict[str, Any] = {"model": {"kind": "discrete", "merge": 2}, "tokenizer": {}}
    cards = {"arm": {"metrics": {"val_loss": 7.1, "baseline_loss": 12.5}}}
    text = render(config, cards).decode()
    assert "Val loss: nats a square of 2×2 tokens" in text
    assert "Baseline loss" not in render(config, {"arm": {"metrics": {"val_loss": 7.1}}}).decode()


def test_a_shard_sets_card_tells_the_viewer_its_tables(tmp_path: Path) -> None:
    push_data(make_shards(tmp_path / "shards", "arm"), tmp_path / "hub")
    data: Any = DatasetCard.load(tmp_path / "hub" / "README.md").data
    assert [config["config_name"] for config in data.to_dict()["configs"]] == ["frames", "episodes"]
    for config in data.to_dict()["configs"]:
        for files in config["data_files"]:
            assert list((tmp_path / "hub").glob(files["path"]))
    assert data.license == "apache-2.0" and data.task_categories == ["robotics"]


@pytest.mark.parametrize("name", ["fsq-lab", "palette-64"])
def test_a_shard_sets_code_runs_as_pasted(name: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    colors = np.random.default_rng(0).integers(0, 256, (3, 3), np.uint8)
    spec = palette_spec(name, 64, colors) if name == "palette-64" else get_spec(name)
    push_data(make_shards(tmp_path / "shards", "arm", spec=spec), tmp_path / "hub")
    found = re.search(r"```python\n(.*?)```", (tmp_path / "hub" / "README.md").read_text(), re.DOTALL)
    assert found
    monkeypatch.chdir(tmp_path / "hub")
    monkeypatch.setattr("datasets.config.HF_DATASETS_CACHE", tmp_path / "cache")
    made: dict[str, Any] = {}
    exec(found[1], made)
    size = spec.image_size
    assert made["images"].shape == (8, size, size, 3) and made["images"].dtype == np.uint8
    if spec.colors:
        assert {*map(tuple, made["images"].reshape(-1, 3))} <= {*map(tuple, colors)}


@pytest.mark.parametrize(
    ("stated", "found"),
    [
        (["Apache-2.0", "apache-2.0 "], {"license": "other", "license_name": "several"}),
        (["MIT", "MIT"], {"license": "mit"}),
        (["MIT", "unknown"], {"license": "other", "license_name": "several"}),
        (["MIT", None], {"license": "other", "license_name": "several"}),
        (["unknown", None], {}),
    ],
)
def test_one_licence_stands_for_all_only_if_each_states_it(stated: list[Any], found: dict[str, str]) -> None:
    assert licence(stated) == found
