"""Cards as the Hub reads them, cards of strangers, places that cannot be used."""

import json
import re
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from huggingface_hub import DatasetCard, ModelCard

from hma_data.errors import CheckpointError, HMAError, HubError
from hma_data.tokenizers.base import get_tokenizer
from hma_data.tokenizers.shapes import get_spec, palette_spec
from hma_model.checkpoint import io as checkpoint
from hma_model.checkpoint.folder import Checkpoint
from hma_model.checkpoint.io import record_evaluation
from hma_model.checkpoint.model_card import licence, render
from hma_model.cli import main
from hma_model.config import HMAConfig
from hma_model.hub import publish as hub
from hma_model.hub.datasets import pull_data, push_data
from hma_model.hub.listing import list_embodiments, survey
from hma_model.network.model import HMA
from hma_model.play.holding import holdings
from recipes.bench import holds
from tests.hostile import cut, values
from tests.model.robots import edit_card, make_model, save
from tests.model.shards import make_shards

pytest_plugins = ["tests.hub_fixtures"]


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
def test_a_loaded_models_verdict_is_published_unless_its_weights_have_changed(folder, tmp_path, trained):
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
    assert "Val loss: nats per square of 2×2 tokens" in text
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


@pytest.mark.parametrize("place", ["my hub/チーム/mö del", "a\nb", "%20 #x?y=1&z"])
@pytest.mark.parametrize("begin", ["", "file://", "memory://"])
def test_names_with_spaces_and_signs_are_names(tmp_path, begin, place):
    target = f"{begin}{'' if begin == 'memory://' else tmp_path}/{place}"
    save(tmp_path / "mein Modell é", {"arm": 2})
    shards = make_shards(tmp_path / "Sätze", "arm")
    hub.push(tmp_path / "mein Modell é", target)
    assert [row["embodiment"] for row in list_embodiments(target)] == ["arm"]
    pulled = hub.pull(target, ["arm"], tmp_path / "aus gabe ü")
    assert list(checkpoint.load(pulled).embodiments) == ["arm"]
    push_data(shards, f"{target} data")
    assert pull_data(f"{target} data", tmp_path / "Daten\t1")


@pytest.mark.parametrize("place", ["{file}", "{file}/below", "/proc/hma-hub", "{file}\0x"])
def test_a_place_that_cannot_be_written_is_called_so(folder, tmp_path, place):
    (tmp_path / "file").write_text("mine")
    target = place.format(file=tmp_path / "file")
    shards = make_shards(tmp_path / "shards", "arm")
    for act in (
        lambda: hub.push(folder, target), lambda: hub.pull(folder, ["arm"], target),
        lambda: push_data(shards, target), lambda: pull_data(shards, target),
    ):  # fmt: skip
        with pytest.raises(HubError, match=r"cannot be (made|used|pulled)") as found:
            act()
        assert found.value.remedy
    assert (tmp_path / "file").read_text() == "mine"


@pytest.mark.parametrize("name", ["README.md", "docs/notes.txt"])
def test_a_folder_of_somebody_elses_files_stays_as_it_is(folder, tmp_path, name):
    mine = tmp_path / "project" / name
    mine.parent.mkdir(parents=True)
    mine.write_text("# My project")
    with pytest.raises(HubError, match=rf"project: holds something else: {name} — push to another address"):
        hub.push(folder, tmp_path / "project")
    assert mine.read_text() == "# My project"
    assert [path for path in (tmp_path / "project").rglob("*") if path.is_file()] == [mine]


def test_a_checkpoint_does_not_go_to_a_shard_sets_place(folder, tmp_path):
    shards = make_shards(tmp_path / "shards", "arm")
    before = sorted(shards.rglob("*"))
    with pytest.raises(HubError, match="holds a shard set"):
        hub.push(folder, shards)
    assert sorted(shards.rglob("*")) == before


def test_a_trunk_that_nobody_could_load_is_not_published(tmp_path):
    model = make_model({"arm": 2})
    with torch.no_grad():
        next(model.trunk.parameters()).fill_(float("nan"))
    save(tmp_path / "broken", {"arm": 2}, model=model)
    with pytest.raises(HMAError, match=r"trunk\.safetensors: holds values in .* that are not finite"):
        hub.push(tmp_path / "broken", tmp_path / "published")
    assert not (tmp_path / "published").exists()


def test_a_damaged_manifest_is_named_where_it_is(tmp_path):
    shards = make_shards(tmp_path / "shards", "arm")
    cut(300)(shards / "manifest.json")
    with pytest.raises(HMAError, match=rf"{shards}/manifest\.json: is damaged.*push it again"):
        pull_data(shards, tmp_path / "out")


HOSTILE = (
    "</td><script>alert(1)</script>| ![x](http://a.b/c) [y](javascript:1)\n\n# Title\n\n---\nlicense: mit"
)


def test_a_hostile_card_stays_text_in_its_cell(folder):
    changes = dict.fromkeys(("robot", "license", "description"), HOSTILE)
    changes |= {"metrics": {HOSTILE: 1}, "data": [HOSTILE], "stride": {}}
    values(**changes)(folder / "embodiments/arm/card.json")
    checkpoint.write_readme(folder)
    page = (folder / "README.md").read_text()
    rows = [row for row in page.splitlines() if row.startswith("| `arm`")]
    assert len(rows) == 1 and rows[0].replace("\\|", "").count("|") == 9
    assert "<script" not in page and "](http" not in page and "](javascript" not in page
    assert [line for line in page.splitlines() if line.startswith("# ")] == ["# HMA world model"]
    assert page.count("\n---\n") == 1 and "license: other" in page


@pytest.mark.parametrize(
    "content", [[], 7, {"metrics": [1], "data": 3, "files": "x", "license": {"a": []}}, {}]
)
def test_a_broken_card_of_somebody_else_stops_neither_list_nor_push(folder, tmp_path, content):
    hub.push(folder, tmp_path / "hub", ["arm"])
    (tmp_path / "hub/embodiments/arm/card.json").write_text(json.dumps(content))
    hub.push(folder, tmp_path / "hub", ["hand"])
    (facts,) = survey(tmp_path / "hub")
    rows = {row["embodiment"]: row["problems"] for row in facts["embodiments"]}
    assert rows["arm"] and not rows["hand"]
    assert list(HMA.from_pretrained(str(tmp_path / "hub"), ["hand"]).embodiments) == ["hand"]


def test_a_broken_card_of_ones_own_stops_neither_push_nor_play(folder, tmp_path, capsys):
    for data, evaluation in (({"cameras": 3}, {"verdict": 1, "follows": False}), ([], "follows")):
        values(data=data, evaluation=evaluation)(folder / "embodiments/arm/card.json")
        assert main(["hub", "push", str(folder), str(tmp_path / "hub")]) == 0
        opened = Checkpoint.open(folder)
        assert holdings(opened)["arm"].follows is None and opened.cameras("arm") == "first"


def test_a_card_that_names_more_cameras_than_the_model_has_views_is_refused(folder):
    values(data={"cameras": ["top", "side"]})(folder / "embodiments/arm/card.json")
    fault = "card.json: names 2 cameras, but a frame of the model has 1"
    with pytest.raises(CheckpointError, match=fault):
        Checkpoint.open(folder).cameras("arm")


def test_stems_trained_apart_generate_together_what_each_generates_alone(folder, tmp_path):
    hub.push(folder, tmp_path / "hub", [])
    for seed, (name, dims) in enumerate({"leg": 4, "gripper": 1, "base.v2": 3}.items()):
        theirs = checkpoint.load(folder, [])
        torch.manual_seed(seed)
        theirs.add_embodiment(make_model({name: dims}, seed).embodiments[name])
        with torch.no_grad():
            for part in (theirs.stem(name), theirs.head(name)):
                for parameter in part.parameters():
                    parameter += 0.3 * torch.randn_like(parameter)
        save(tmp_path / name, {name: dims}, model=theirs)
        hub.push(tmp_path / name, tmp_path / "hub")
    together = HMA.from_pretrained(str(tmp_path / "hub"))
    made = []
    for name, space in together.embodiments.items():
        alone = HMA.from_pretrained(str(tmp_path / name))
        assert list(alone.embodiments) == [name]
        prompt = torch.randint(0, 64, (1, 2, 2, 3), generator=torch.Generator().manual_seed(1))
        actions = torch.randn(1, 4, space.chunk_dim, generator=torch.Generator().manual_seed(2))
        one, other = (
            model.generate(prompt, actions, name, 2, generator=torch.Generator().manual_seed(3))
            for model in (together, alone)
        )
        assert torch.equal(one, other)
        seen = torch.cat([prompt, one], dim=1)
        made.append(together.video_logits(seen, actions, name))
        assert torch.equal(made[-1], alone.video_logits(seen, actions, name))
    assert len(made) == 3 and not torch.equal(made[0], made[1])
