"""Damaged checkpoints and places that cannot be used: one clear error each, before anything is made."""

from pathlib import Path

import numpy as np
import pytest
from safetensors.numpy import load_file, save_file

from hma_data.errors import CheckpointError, HMAError, HubError
from hma_data.storage.files import file_sha256
from hma_model.checkpoint import io as checkpoint
from hma_model.checkpoint.folder import read_metadata
from hma_model.hub import publish as hub
from hma_model.hub.datasets import pull_data, push_data
from hma_model.hub.listing import list_embodiments
from tests.model.robots import save
from tests.model.shards import make_shards

pytest_plugins = ["tests.hub_fixtures"]


def flip(path: Path, at: int = -5) -> None:
    """Change one bit."""
    content = bytearray(path.read_bytes())
    content[at] ^= 4
    path.write_bytes(content)


def cut(path: Path, size: int) -> None:
    path.write_bytes(path.read_bytes()[:size])


def replace(path: Path, old: str, new: str) -> None:
    path.write_text(path.read_text().replace(old, new))


def spoil(path: Path) -> None:
    """Put a number into weights that is none, and their new digest into the card."""
    tensors = load_file(path)
    next(iter(tensors.values())).flat[0] = np.nan
    before = file_sha256(path)
    save_file(tensors, path, read_metadata(path))
    replace(path.with_name("card.json"), before, file_sha256(path))


ARM = "embodiments/arm/"
DAMAGES = {
    "a trunk cut short": ("trunk.safetensors", lambda path: cut(path, 1000)),
    "an empty trunk": ("trunk.safetensors", lambda path: cut(path, 0)),
    "no trunk": ("trunk.safetensors", Path.unlink),
    "a bit of the head": (ARM + "head.safetensors", flip),
    "a bit of the stem": (ARM + "stem.safetensors", flip),
    "a bit of the stem's header": (ARM + "stem.safetensors", lambda path: flip(path, 12)),
    "a bit of the header's length": (ARM + "stem.safetensors", lambda path: flip(path, 6)),
    "a bit of the statistics": (ARM + "stats.json", flip),
    "no head": (ARM + "head.safetensors", Path.unlink),
    "an empty card": (ARM + "card.json", lambda path: cut(path, 0)),
    "the card of another robot": (ARM + "card.json", lambda path: replace(path, '"id": "arm"', '"id": "x"')),
    "a config cut short": ("config.json", lambda path: cut(path, 50)),
    "YAML that is none": (ARM + "embodiment.yaml", lambda path: path.write_text("a: [1")),
    "the YAML of another robot": (ARM + "embodiment.yaml", lambda path: replace(path, "id: arm", "id: hand")),
    "YAML with another rate": (ARM + "embodiment.yaml", lambda path: replace(path, "hz: 10", "hz: 12")),
}


@pytest.mark.parametrize("damage", DAMAGES)
def test_a_damaged_checkpoint_is_neither_pushed_nor_pulled(folder, tmp_path, damage):
    name, act = DAMAGES[damage]
    act(folder / name)
    of_card = damage.startswith("the card of")  # which the one who pulls can live with
    pull = [] if of_card else [lambda: hub.pull(folder, out=tmp_path / "out")]
    for act in (lambda: hub.push(folder, tmp_path / "hub"), *pull):
        with pytest.raises(HMAError) as found:
            act()
        said = str(found.value)
        assert "\n" not in said and found.value.remedy
        assert Path(name).name in said or "stats.json" in said
    assert not (tmp_path / "hub").exists()


@pytest.mark.parametrize("part", ["stem.safetensors", "head.safetensors"])
def test_weights_that_are_no_numbers_are_not_pushed(folder, tmp_path, part):
    spoil(folder / ARM / part)
    with pytest.raises(CheckpointError, match=rf"{part}: holds values in .* that are not finite"):
        hub.push(folder, tmp_path / "hub")
    assert not (tmp_path / "hub").exists()
    assert hub.push(folder, tmp_path / "hub", ["hand"])


def test_a_folder_without_a_checkpoint_is_not_pushed(tmp_path):
    (tmp_path / "empty").mkdir()
    for place in (tmp_path / "empty", tmp_path / "none"):
        with pytest.raises(CheckpointError, match=r"no config\.json|no such folder"):
            hub.push(place, tmp_path / "hub")
    assert not (tmp_path / "hub").exists()


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
    with pytest.raises(
        HubError, match=rf"project: holds something else: {name} — push to a place of its own"
    ):
        hub.push(folder, tmp_path / "project")
    assert mine.read_text() == "# My project"
    assert [path for path in (tmp_path / "project").rglob("*") if path.is_file()] == [mine]


def test_a_checkpoint_does_not_go_to_a_shard_sets_place(folder, tmp_path):
    shards = make_shards(tmp_path / "shards", "arm")
    before = sorted(shards.rglob("*"))
    with pytest.raises(HubError, match="holds a shard set"):
        hub.push(folder, shards)
    assert sorted(shards.rglob("*")) == before


def test_a_damaged_manifest_is_named_where_it_is(tmp_path):
    shards = make_shards(tmp_path / "shards", "arm")
    cut(shards / "manifest.json", 300)
    with pytest.raises(HMAError, match=rf"{shards}/manifest\.json: is damaged.*have it pushed again"):
        pull_data(shards, tmp_path / "out")
