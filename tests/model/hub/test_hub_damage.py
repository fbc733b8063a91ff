"""Places that cannot be used, cards of strangers, and robots of different people on one trunk."""

import json

import pytest
import torch

from hma_data.errors import HMAError, HubError
from hma_model.checkpoint import io as checkpoint
from hma_model.hub import publish as hub
from hma_model.hub.datasets import pull_data, push_data
from hma_model.hub.listing import list_embodiments, survey
from hma_model.network.model import HMA
from tests.hostile import cut, values
from tests.model.robots import make_model, save
from tests.model.shards import make_shards

pytest_plugins = ["tests.hub_fixtures"]


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
