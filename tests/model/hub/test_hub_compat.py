"""What does not belong together, is older, or is hostile: each refused in one line, and nothing happens."""

import json
import shutil
import struct
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file

from hma_data.errors import CheckpointError, HMAError
from hma_data.storage.files import file_sha256
from hma_model.checkpoint import io as checkpoint
from hma_model.checkpoint.folder import read_metadata
from hma_model.hub import publish as hub
from hma_model.hub.listing import survey
from hma_model.network.model import HMA
from tests.model.robots import make_model, save

ROBOTS = {"arm": 2, "hand": 3}


def edit(path: Path, change) -> None:
    values = json.loads(path.read_text())
    change(values)
    path.write_text(json.dumps(values))


def fit(folder: Path) -> None:
    """Let cards, config.json and stems name the weights that are there now."""
    trunk = file_sha256(folder / "trunk.safetensors")
    edit(folder / "config.json", lambda values: values.update(trunk_sha256=trunk))
    for home in (folder / "embodiments").iterdir():
        rewrite(home / "stem.safetensors", lambda name: name, trunk_sha256=trunk)
        digests = {part.name: file_sha256(part) for part in home.iterdir() if part.name != "card.json"}
        edit(home / "card.json", lambda values, d=digests: values.update(trunk_sha256=trunk, files=d))


def rewrite(path: Path, rename, **metadata: str) -> None:
    """A safetensors file with other names and metadata."""
    facts = read_metadata(path) | metadata
    save_file({rename(name): value for name, value in load_file(path).items()}, path, facts)


# -- parts that do not belong together, each with an error of its own


def test_each_part_that_does_not_fit_has_its_own_error(folder):
    home, faults = folder / "embodiments/arm", []
    cases = {
        folder / "config.json": lambda v: v["tokenizer"].update(version=9),
        home / "card.json": lambda v: v.update(trunk_sha256="0" * 64),
        home / "stats.json": lambda v: v["action"].update(mean=[9.0, 9.0]),
    }
    for path, change in cases.items():
        whole = path.read_bytes()
        edit(path, change)
        with pytest.raises(CheckpointError) as found:
            checkpoint.load(folder, ["arm"])
        faults.append(found.value.fault)
        assert found.value.remedy
        path.write_bytes(whole)
    edit(folder / "config.json", lambda v: v.update(format_version=7))
    with pytest.raises(CheckpointError) as found:
        checkpoint.load(folder, ["arm"])
    faults.append(found.value.fault)
    for word, fault in zip(
        ("another tokenizer", "another trunk", "other statistics", "format_version 7"), faults
    ):
        assert word in fault
    assert len(set(faults)) == 4


# -- hostile repositories


@pytest.mark.parametrize(
    "head", [struct.pack("<Q", 2**62), struct.pack("<Q", 99_000_000), b"\xff" * 8, b"",
             struct.pack("<Q", 2) + b"[]",
             struct.pack("<Q", 66) + b'{"a":{"dtype":"F32","shape":[99999999999,9],"data_offsets":[0,4]}}'],
)  # fmt: skip
def test_a_hostile_safetensors_header_is_refused(folder, head):
    path = folder / "embodiments/arm/stem.safetensors"
    path.write_bytes(head + bytes(16))
    with pytest.raises(CheckpointError, match="is not whole safetensors"):
        checkpoint.load(folder, ["arm"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda t: t.bool(), "as bool, not floating point"),
        (lambda t: t.to(torch.int64), "as int64, not floating point"),
        (lambda t: t.to(torch.float8_e4m3fn), "as float8_e4m3fn, not floating point"),
        (lambda t: t * float("nan"), "that are not finite"),
        (lambda t: t + float("inf"), "that are not finite"),
    ],
)
@pytest.mark.parametrize("name", ["trunk.safetensors", "embodiments/arm/head.safetensors"])
def test_weights_that_are_no_numbers_are_refused(folder, name, change, message):
    values = {key: change(tensor) for key, tensor in load_file(folder / name).items()}
    save_file(values, folder / name, read_metadata(folder / name))
    fit(folder)
    with pytest.raises(CheckpointError, match=message):
        checkpoint.load(folder, ["arm"])


@pytest.mark.parametrize(
    "change",
    [
        {"layers": 10**9}, {"width": 2**40, "heads": 8}, {"width": 2**19, "heads": 8},
        {"factored": [10**6, 10**6]}, {"grid": [10**5, 10**5]}, {"frames": 10**6, "layout": "released"},
        {"mlp_ratio": 1e300}, {"layers": 1.5}, {"layers": "9" * 999}, {"grid": None}, {"frames": 10**30},
        {"layers": [[]]},
        {"kind": "continuous", "diffusion_width": 10**6, "grid": [2, 4]}, {"objectives": 7},
        {"conditioning": [{}]},
    ],
)  # fmt: skip
def test_a_config_that_asks_for_too_much_is_refused_before_anything_is_built(folder, monkeypatch, change):
    edit(folder / "config.json", lambda values: values["model"].update(change))
    monkeypatch.setattr(HMA, "__init__", lambda *a: pytest.fail("was built"))
    with pytest.raises(HMAError) as found:
        checkpoint.load(folder)
    assert "\n" not in str(found.value) and found.value.remedy


def test_an_embodiment_that_asks_for_too_much_is_refused(folder, monkeypatch):
    path = folder / "embodiments/arm/embodiment.yaml"
    path.write_text(path.read_text().replace("stride: 2", "stride: 100000000"))
    fit(folder)
    with pytest.raises(HMAError, match=r"too small for chunks|stride"):
        checkpoint.load(folder, ["arm"])


@pytest.mark.parametrize(
    ("name", "key"), [("config.json", "trunk_sha256"), ("embodiments/arm/card.json", "files")]
)
def test_a_key_that_is_given_twice_is_refused(folder, tmp_path, name, key):
    hub.push(folder, tmp_path / "hub")
    path = tmp_path / "hub" / name
    path.write_text(path.read_text().replace("{", f'{{"{key}": {{}},', 1))
    for act in (lambda: checkpoint.load(tmp_path / "hub"), lambda: hub.pull(tmp_path / "hub")):
        with pytest.raises(HMAError, match=rf"{name}: is not valid JSON: key '{key}' is given twice"):
            act()


def test_a_key_given_twice_is_shown_short_and_plain(folder):
    key = "k" * 10**6 + "\\u001b"
    (folder / "config.json").write_text(f'{{"{key}": 1, "{key}": 2}}')
    with pytest.raises(CheckpointError, match="is given twice") as found:
        checkpoint.load(folder)
    assert len(str(found.value)) < 300


def test_pickles_under_our_names_are_not_unpickled(folder, tmp_path):
    marker = tmp_path / "ran"
    bomb = f"cos\nsystem\n(S'touch {marker}'\ntR.".encode()
    for name in ("trunk.safetensors", "embodiments/arm/stem.safetensors", "embodiments/arm/stats.json"):
        shutil.copytree(folder, tmp_path / "bad", dirs_exist_ok=True)
        (tmp_path / "bad" / name).write_bytes(bomb)
        with pytest.raises(HMAError):
            checkpoint.load(tmp_path / "bad")
    assert not marker.exists()


def test_yaml_tags_are_not_obeyed(folder, tmp_path):
    marker = tmp_path / "ran"
    path = folder / "embodiments/arm/embodiment.yaml"
    path.write_text(f"id: !!python/object/apply:os.system ['touch {marker}']\n")
    with pytest.raises(HMAError):
        checkpoint.load(folder, ["arm"])
    assert not marker.exists()


HOSTILE = (
    "</td><script>alert(1)</script>| ![x](http://a.b/c) [y](javascript:1)\n\n# Title\n\n---\nlicense: mit"
)


def test_a_hostile_card_stays_text_in_its_cell(folder):
    for key in ("robot", "license", "description"):
        edit(folder / "embodiments/arm/card.json", lambda values, key=key: values.update({key: HOSTILE}))
    edit(
        folder / "embodiments/arm/card.json",
        lambda v: v.update(metrics={HOSTILE: 1}, data=[HOSTILE], stride={}),
    )
    checkpoint.write_readme(folder)
    page = (folder / "README.md").read_text()
    rows = [row for row in page.splitlines() if row.startswith("| `arm`")]
    assert len(rows) == 1 and rows[0].replace("\\|", "").count("|") == 9
    assert "<script" not in page and "](http" not in page and "](javascript" not in page
    assert [line for line in page.splitlines() if line.startswith("# ")] == ["# HMA world model"]
    assert page.count("\n---\n") == 1 and "license: other" in page


@pytest.mark.parametrize(
    "values", [[], 7, {"metrics": [1], "data": 3, "files": "x", "license": {"a": []}}, {}]
)
def test_a_broken_card_of_somebody_else_stops_neither_list_nor_push(folder, tmp_path, values):
    hub.push(folder, tmp_path / "hub", ["arm"])
    (tmp_path / "hub/embodiments/arm/card.json").write_text(json.dumps(values))
    hub.push(folder, tmp_path / "hub", ["hand"])
    (facts,) = survey(tmp_path / "hub")
    rows = {row["embodiment"]: row["problems"] for row in facts["embodiments"]}
    assert rows["arm"] and not rows["hand"]
    assert list(HMA.from_pretrained(str(tmp_path / "hub"), ["hand"]).embodiments) == ["hand"]


# -- stems of different people on one frozen trunk


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
