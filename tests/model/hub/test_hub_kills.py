"""Pushes to folders and file stores, killed at file operations, and the same command again.

A sweep over all operations of a push to a folder is always made; of other acts a sample is killed, and all of
them where slow tests are run.
"""

import shutil
from collections.abc import Callable, Iterable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import fsspec
import pytest
from fsspec.implementations.memory import MemoryFileSystem

from hma_data.errors import CheckpointError, HubError, ShardError
from hma_model.checkpoint import io as checkpoint
from hma_model.checkpoint.io import PARTS
from hma_model.hub import publish as hub
from hma_model.hub.datasets import pull_data, push_data
from tests.model.kills import FileStore, killed, make_quick
from tests.model.robots import make_model, save
from tests.model.shards import make_shards

MOST = 300  # operations of a push
SAMPLE = 6  # of them in a quick run
ALL_OR_SAMPLE = pytest.mark.parametrize(
    "most", [SAMPLE, pytest.param(MOST, marks=pytest.mark.slow)], ids=["sample", "all"]
)


@pytest.fixture(autouse=True)
def stores(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    monkeypatch.setenv("HMA_CACHE", str(tmp_path / "cache"))
    make_quick(monkeypatch.setattr)
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


def moments(whole: int, most: int) -> Iterable[int]:
    """At most so many of the numbers of an act's operations, the first and the last among them."""
    assert 10 < whole < MOST
    return (
        sorted({round(i * (whole - 1) / (most - 1)) for i in range(most)}) if whole > most else range(whole)
    )


def parts(folder: Path, name: str) -> list[bytes]:
    return [(folder / "embodiments" / name / part).read_bytes() for part in PARTS]


class Killed(BaseException):
    """Nothing comes after it."""


def cut_in_memory(act: Callable[[], object], monkeypatch: pytest.MonkeyPatch, at: int) -> int:
    """Run an act whose store does nothing from its change number `at` on; how many it did."""
    done = 0
    with monkeypatch.context() as patched:
        for name in ("pipe_file", "put_file", "cp_file", "rm_file"):
            plain = getattr(MemoryFileSystem, name)

            def change(self: Any, *given: Any, plain: Any = plain, **options: Any) -> Any:
                nonlocal done
                if done == at:
                    raise Killed
                done += 1
                return plain(self, *given, **options)

            patched.setattr(MemoryFileSystem, name, change)
        with suppress(Killed):
            act()
    return done


PLACES = [(place, begun) for place in ("folder", "file store", "object store") for begun in (False, True)]
PUSHES = [("folder", True, MOST), *((*one, SAMPLE) for one in PLACES if one != ("folder", True))]
SLOW = [pytest.param(*one, MOST, marks=pytest.mark.slow) for one in PLACES if one != ("folder", True)]


@pytest.mark.parametrize(("place", "begun", "most"), PUSHES + SLOW)
def test_a_push_killed_anywhere_is_ended_by_the_same_command(
    versions, tmp_path, monkeypatch, place, begun, most
):
    old, new = versions
    root, objects = tmp_path / "hub", fsspec.filesystem("memory").store
    target = {"folder": str(root), "file store": f"filestore://{root}"}.get(place, "memory://hub/kills")
    seen = target if place == "object store" else root

    def cut(at: int) -> int:
        shutil.rmtree(root, ignore_errors=True)
        objects.clear()
        root.mkdir()
        if begun:
            hub.push(old, seen)
        if place == "object store":
            return cut_in_memory(lambda: hub.push(new, target), monkeypatch, at)
        return killed("push", (new, target), root, at)

    for at in moments(cut(MOST), most):
        assert cut(at) == at
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
        assert not [path for path in root.rglob("*") if ".part" in path.name]
    objects.clear()


@ALL_OR_SAMPLE
@pytest.mark.parametrize("place", ["folder", "file store"])
def test_a_data_push_killed_anywhere_is_ended_by_the_same_command(tmp_path, place, most):
    old, new = make_shards(tmp_path / "old", "arm"), make_shards(tmp_path / "new", "arm", held_out=0, seed=5)
    root, base, out = tmp_path / "hub", tmp_path / "base", tmp_path / "out"
    target = f"filestore://{root}" if place == "file store" else str(root)
    push_data(old, base)

    def cut(at: int) -> int:
        for folder in (root, out):
            shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(base, root)
        return killed("push_data", (new, target), root, at)

    for at in moments(cut(MOST), most):
        assert cut(at) == at
        try:
            got = (pull_data(root, out) / "manifest.json").read_bytes()
            assert got in [(one / "manifest.json").read_bytes() for one in (old, new)]
        except (HubError, ShardError) as fault:
            assert "push" in str(fault.remedy), fault
        shutil.rmtree(out, ignore_errors=True)
        push_data(new, target)
        pull_data(root, out)
        for path in (path for path in new.rglob("*") if path.is_file()):
            assert (out / path.relative_to(new)).read_bytes() == path.read_bytes()
        assert not (root / "val/shard-00000.parquet").exists()


@ALL_OR_SAMPLE
def test_a_pull_killed_anywhere_is_ended_by_the_same_command(versions, tmp_path, most):
    old, _ = versions
    out = tmp_path / "out"

    def cut(at: int) -> int:
        shutil.rmtree(out, ignore_errors=True)
        return killed("pull", (old, ["arm"], out), out, at)

    for at in moments(cut(MOST), most):
        assert cut(at) == at
        if (out / "config.json").is_file() and checkpoint.Checkpoint.open(out).embodiments:
            assert parts(out, "arm") == parts(old, "arm")
        hub.pull(old, ["arm"], out)
        assert parts(out, "arm") == parts(old, "arm")
        assert not [path for path in out.rglob("*") if ".part" in path.name]
