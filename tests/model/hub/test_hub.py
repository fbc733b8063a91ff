"""Hubs in folders and behind fsspec: one embodiment at a time, atomic where pushes are killed."""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest
import torch
from fsspec.implementations.local import LocalFileSystem

from hma_data.errors import CheckpointError, HubError, ShardError
from hma_model.checkpoint import io as checkpoint
from hma_model.checkpoint.io import PARTS, Checkpoint
from hma_model.hub import publish as hub
from hma_model.hub import stores as hub_folder
from hma_model.hub.datasets import pull_data, push_data
from hma_model.hub.listing import list_embodiments
from hma_model.hub.stores import FolderStore
from hma_model.network.model import HMA
from tests.conftest import contents
from tests.hostile import at_once
from tests.interruptions import Disk, disk, put, watched
from tests.model.robots import make_model, save
from tests.model.robots import yaml as robot_yaml
from tests.model.shards import make_shards
from tests.test_interruptions import spread

ROBOTS = {"arm": 2, "hand": 3}
MEMORY = "memory://hub/team/model"


@pytest.fixture
def source(folder: Path) -> Path:
    return folder


@pytest.fixture(autouse=True)
def cache(tmp_path: Path, monkeypatch) -> Path:
    monkeypatch.setenv("HMA_CACHE", str(tmp_path / "cache"))
    return tmp_path / "cache"


@pytest.fixture(params=["folder", "memory"])
def target(request, tmp_path: Path):
    if request.param == "folder":
        yield str(tmp_path / "hub/team/model")
    else:
        yield MEMORY
        fsspec.filesystem("memory").store.clear()


def other_robot(source: Path, out: Path, name: str, dims: int, seed: int) -> Path:
    model = checkpoint.load(source, [])
    torch.manual_seed(seed)
    space = make_model({name: dims}, seed).embodiments[name]
    model.add_embodiment(space)
    save(out, {name: dims}, model=model)
    return out


def test_what_is_pushed_and_pulled_is_the_same(source, target, tmp_path):
    hub.push(source, target)
    pulled = hub.pull(target, out=tmp_path / "pulled")
    assert {**contents(pulled), "README.md": b""} == {**contents(source), "README.md": b""}
    one, other = checkpoint.load(source).state_dict(), checkpoint.load(pulled).state_dict()
    assert all(torch.equal(one[name], other[name]) for name in one)


def test_training_state_is_not_published(source, tmp_path):
    def training(folder: Path) -> None:
        (folder / "state.json").write_text("{}")

    save(tmp_path / "run", ROBOTS, training=training)
    hub.push(tmp_path / "run", tmp_path / "hub")
    assert not (tmp_path / "hub/training").exists()


def test_a_second_push_touches_only_its_embodiment_and_the_readme(source, tmp_path):
    hub.push(source, tmp_path / "hub", ["arm"])
    before = {
        p: (p.stat().st_mtime_ns, p.stat().st_ino) for p in (tmp_path / "hub").rglob("*") if p.is_file()
    }
    hub.push(source, tmp_path / "hub", ["hand"])
    after = {p: (p.stat().st_mtime_ns, p.stat().st_ino) for p in (tmp_path / "hub").rglob("*") if p.is_file()}
    changed = {str(p.relative_to(tmp_path / "hub")) for p in after if before.get(p) != after[p]}
    assert {name for name in changed if not name.startswith("embodiments/hand/")} == {"README.md"}


def test_another_trunk_is_refused_and_nothing_is_touched(source, target, tmp_path):
    hub.push(source, target, ["arm"])
    before = FolderStore(target).files()
    save(tmp_path / "other", ROBOTS, seed=1)
    with pytest.raises(HubError, match="has another trunk"):
        hub.push(tmp_path / "other", target, ["hand"])
    assert FolderStore(target).files() == before


def test_pulling_one_embodiment_reads_no_other(source, target, tmp_path, monkeypatch):
    hub.push(source, target)
    asked = []
    plain = hub_folder._copy
    monkeypatch.setattr(hub_folder, "_copy", lambda one, to: asked.append(one) or plain(one, to))
    hub.pull(target, ["arm"], tmp_path / "pulled")
    assert {path.parent.name for path in asked if path.parent.parent.name == "embodiments"} == {"arm"}
    assert sorted(p.name for p in (tmp_path / "pulled/embodiments").iterdir()) == ["arm"]


def test_pulling_again_adds_and_transfers_only_what_is_missing(source, target, tmp_path, monkeypatch):
    hub.push(source, target)
    hub.pull(target, ["arm"], tmp_path / "pulled")
    trunk = tmp_path / "pulled/trunk.safetensors"
    inode = trunk.stat().st_ino
    hub.pull(target, ["hand"], tmp_path / "pulled")
    assert trunk.stat().st_ino == inode
    assert Checkpoint.open(tmp_path / "pulled").embodiments == ("arm", "hand")


def test_a_pull_does_not_mix_trunks(source, tmp_path):
    hub.push(source, tmp_path / "hub")
    save(tmp_path / "mine", {"arm": 2}, seed=1)
    before = contents(tmp_path / "mine")
    with pytest.raises(HubError, match="with embodiments of its own"):
        hub.pull(tmp_path / "hub", out=tmp_path / "mine")
    assert contents(tmp_path / "mine") == before


def test_a_uri_is_pulled_to_the_cache(source, cache):
    hub.push(source, MEMORY)
    assert hub.pull(MEMORY, ["arm"]).is_relative_to(cache)
    fsspec.filesystem("memory").store.clear()


REFUSALS = {  # what is done with a hub in a folder, and what the error says
    "a name that is no id": (lambda hub_, _: hub.pull(hub_, ["../arm"]), "not an embodiment's id"),
    "no such robot": (lambda hub_, _: hub.pull(hub_, ["leg"]), r"no embodiment 'leg'.*it has: arm, hand"),
    "none to push": (lambda hub_, model: hub.push(model, hub_, ["leg"]), r"no embodiment 'leg'"),
    "no folder": (lambda hub_, _: hub.pull(hub_ / "nothing"), "no such folder"),
    "no file system": (lambda hub_, _: hub.pull("nosuch://place/model"), "cannot be used"),
    "something else": (lambda hub_, _: hub.pull(hub_.parent / "bert"), "is not of hma-toolkit"),
    "a folder's revision": (lambda hub_, _: hub.pull(hub_, revision="v1"), "has no revision 'v1'"),
    "no repository": (lambda _, model: hub.push(model, "hf://a/b/c"), "is not hf://ORGANISATION/NAME"),
}


@pytest.mark.parametrize("refusal", REFUSALS)
def test_what_cannot_be_done_is_said(source, tmp_path, refusal):
    hub.push(source, tmp_path / "hub")
    (tmp_path / "bert").mkdir()
    (tmp_path / "bert/config.json").write_text('{"architectures": ["GPT2"]}')
    act, said = REFUSALS[refusal]
    with pytest.raises((HubError, CheckpointError), match=said):
        act(tmp_path / "hub", source)


def test_links_in_circles_are_not_followed(source, tmp_path):
    hub.push(source, tmp_path / "hub", ["arm"])
    for name in ("one", "two", "three"):
        (tmp_path / "hub/embodiments" / name).symlink_to(tmp_path / "hub")
    assert [row["embodiment"] for row in list_embodiments(tmp_path / "hub")] == ["arm"]
    hub.push(source, tmp_path / "hub", ["hand"])
    assert sorted(HMA.from_pretrained(str(tmp_path / "hub")).embodiments) == ["arm", "hand"]


def test_a_failed_push_leaves_the_hub_as_it_was(source, tmp_path, monkeypatch):
    hub.push(source, tmp_path / "hub", ["arm"])
    before = contents(tmp_path / "hub")
    plain = FolderStore._stage

    def full_disk(self, name, content):
        if name.endswith("stats.json"):
            raise OSError(28, "No space left on device")
        return plain(self, name, content)

    monkeypatch.setattr(FolderStore, "_stage", full_disk)
    with pytest.raises(HubError, match="No space left on device"):
        hub.push(source, tmp_path / "hub", ["hand"])
    assert contents(tmp_path / "hub") == before


def test_people_who_push_at_once_all_get_in_and_into_the_readme(source, tmp_path):
    names = [f"robot{number}" for number in range(4)]
    folders = [other_robot(source, tmp_path / name, name, 2, seed) for seed, name in enumerate(names)]
    at_once(lambda folder: hub.push(folder, tmp_path / "hub"), folders)
    assert sorted(checkpoint.load(tmp_path / "hub").embodiments) == names
    page = (tmp_path / "hub/README.md").read_text()
    assert all(f"| `{name}` |" in page for name in names)
    assert not [path for path in (tmp_path / "hub").rglob("*") if path.name.endswith(".part")]


def test_the_model_card_has_a_row_for_each_embodiment(source, tmp_path):
    hub.push(source, tmp_path / "hub")
    page = (tmp_path / "hub/README.md").read_text()
    row = next(line for line in page.splitlines() if line.startswith("| `hand` |"))
    cells = [cell.strip() for cell in row.strip("|").split("|")]
    assert cells[1:5] == ["an arm", "3 (joint_position)", "5", "2"]
    assert cells[5:] == ["windows 12", "val loss 1.5", "apache-2.0"]


def test_a_loaded_model_is_pushed_with_what_it_was_loaded_with(source, target):
    model = HMA.from_pretrained(str(source))
    model.push_to_hub(target, embodiments=["arm"])
    (row,) = list_embodiments(target)
    assert row["robot"] == "an arm" and row["val_loss"] == 1.5


def test_a_made_model_without_yaml_is_not_pushed(target):
    with pytest.raises(HubError, match="embodiment arm: has no YAML"):
        make_model({"arm": 2}).push_to_hub(target)


def test_a_made_model_is_pushed_with_the_registrys_yaml(target, tmp_path, monkeypatch):
    (tmp_path / "arm.yaml").write_text(robot_yaml("arm"))
    monkeypatch.setenv("HMA_REGISTRY", str(tmp_path))
    make_model({"arm": 2}).push_to_hub(target)
    assert list(HMA.from_pretrained(target).embodiments) == ["arm"]


MOST, SAMPLE = 300, 6  # operations of a push


class FileStore(LocalFileSystem):
    """A store that keeps files and folders, as one behind SFTP: what is put is there before it is whole."""

    protocol = "filestore"

    @classmethod
    def _strip_protocol(cls, path: Any) -> str:
        text = str(path).removeprefix("filestore://")
        return str(super()._strip_protocol("/" + text.lstrip("/")))


@pytest.fixture(autouse=True)
def stores() -> Iterator[None]:
    fsspec.register_implementation("filestore", FileStore, clobber=True)
    yield
    FileStore.clear_instance_cache()


@pytest.fixture(scope="module")
def versions(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    home = tmp_path_factory.mktemp("versions")
    save(home / "old", {"arm": 2, "hand": 3})
    model = checkpoint.load(home / "old", [])
    model.add_embodiment(make_model({"arm": 2}, 7).embodiments["arm"])
    save(home / "new", {"arm": 2}, model=model)
    return home / "old", home / "new"


def parts(folder: Path, name: str) -> list[bytes]:
    return [(folder / "embodiments" / name / part).read_bytes() for part in PARTS]


def kills(root: Path, act: Callable[[], object], most: int) -> Iterator[int]:
    """Yield numbers of points; root is then as a kill at that point of the act leaves it."""
    moments = list[Disk]()
    with watched(root, lambda at, moved: moments.append(disk(root, moved))):
        act()
    assert 10 < len(moments) < MOST
    for at in spread(range(len(moments)), most):
        put(moments[at], root)
        yield at


PLACES = [(place, begun) for place in ("folder", "file store", "object store") for begun in (False, True)]
PUSHES = [("folder", True, MOST), *((*one, SAMPLE) for one in PLACES if one != ("folder", True))]
SLOW = [pytest.param(*one, MOST, marks=pytest.mark.slow) for one in PLACES if one != ("folder", True)]


@pytest.mark.parametrize(("place", "begun", "most"), [*PUSHES, *SLOW])
def test_a_push_killed_anywhere_is_ended_by_the_same_command(versions, tmp_path, place, begun, most):
    old, new = versions
    root = tmp_path / "hub"
    put({}, root)
    target = {"folder": str(root), "file store": f"filestore://{root}"}.get(place, f"memory:/{root}")
    seen = target if place == "object store" else root
    if begun:
        hub.push(old, seen)
        if place == "folder":
            (root / "embodiments/arm/notes.part-of-mine").write_text("kept")
    for at in kills(root, lambda: hub.push(new, target), most):
        got = tmp_path / f"got{at}"
        if begun:
            assert parts(hub.pull(seen, ["hand"], got), "hand") == parts(old, "hand")
        try:
            assert parts(hub.pull(seen, ["arm"], got), "arm") in (parts(old, "arm"), parts(new, "arm"))
        except (HubError, CheckpointError) as fault:
            assert not begun or "again" in str(fault.remedy), fault
        hub.push(new, target)
        assert parts(hub.pull(seen, ["arm"], tmp_path / f"new{at}"), "arm") == parts(new, "arm")
        assert place == "object store" or "| `arm` |" in (root / "README.md").read_text()
        left = [path.name for path in root.rglob("*") if ".part" in path.name]
        assert left == (["notes.part-of-mine"] if place == "folder" and begun else [])


@pytest.mark.parametrize("most", [SAMPLE, pytest.param(MOST, marks=pytest.mark.slow)], ids=["sample", "all"])
@pytest.mark.parametrize("place", ["folder", "file store"])
def test_a_data_push_killed_anywhere_is_ended_by_the_same_command(tmp_path, place, most):
    old, new = make_shards(tmp_path / "old", "arm"), make_shards(tmp_path / "new", "arm", held_out=0, seed=5)
    root, out = tmp_path / "hub", tmp_path / "out"
    target = f"filestore://{root}" if place == "file store" else str(root)
    push_data(old, root)
    for _ in kills(root, lambda: push_data(new, target), most):
        put({}, out)
        try:
            got = (pull_data(root, out) / "manifest.json").read_bytes()
            assert got in [(one / "manifest.json").read_bytes() for one in (old, new)]
        except (HubError, ShardError) as fault:
            assert "push" in str(fault.remedy), fault
        put({}, out)
        push_data(new, target)
        assert contents(new).items() <= contents(pull_data(root, out)).items()
        assert not (root / "val/shard-00000.parquet").exists()
