"""Pushes to folders, file stores and object stores, killed at any operation: what a pull gets meanwhile.

What a kill leaves is on the disk, or in the store, before each operation of an undisturbed push. Folders are
always swept; of the others a sample is taken, and all of it where slow tests are run.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest
from fsspec.implementations.local import LocalFileSystem

from hma_data.errors import CheckpointError, HubError, ShardError
from hma_model.checkpoint import io as checkpoint
from hma_model.checkpoint.io import PARTS
from hma_model.hub import publish as hub
from hma_model.hub.datasets import pull_data, push_data
from tests.conftest import contents
from tests.interruptions import Disk, disk, put, watched
from tests.model.robots import make_model, save
from tests.model.shards import make_shards
from tests.test_interruptions import spread

MOST, SAMPLE = 300, 6  # operations of a push


class FileStore(LocalFileSystem):
    """A store that keeps files and folders, as one behind SFTP: what is put is there before it is whole."""

    protocol = "filestore"

    @classmethod
    def _strip_protocol(cls, path: Any) -> str:
        text = str(path).removeprefix("filestore://")
        return str(super()._strip_protocol("/" + text.lstrip("/")))


@pytest.fixture(autouse=True)
def stores(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    monkeypatch.setenv("HMA_CACHE", str(tmp_path / "cache"))
    fsspec.register_implementation("filestore", FileStore, clobber=True)
    yield
    FileStore.clear_instance_cache()


@pytest.fixture(scope="module")
def versions(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two checkpoints on one trunk: arm and hand, and another arm."""
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
