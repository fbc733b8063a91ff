"""Pushes to folders and file stores, killed at each file operation, and the same command again."""

import os
import shutil
import signal
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import fsspec
import pytest
from fsspec.implementations.local import LocalFileSystem
from fsspec.implementations.memory import MemoryFileSystem

from hma_data import remote_lock
from hma_data.errors import CheckpointError, HubError, ShardError
from hma_model import checkpoint, hub, hub_swap
from hma_model.checkpoint import PARTS
from hma_model.hub_data import pull_data, push_data
from tests.model.robots import make_model, save
from tests.model.shards import make_shards

WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT
CHANGES = ("os.rename", "os.link", "os.mkdir", "os.remove", "os.rmdir", "os.truncate", "exchange")
MOST = 300  # operations of a push


class FileStore(LocalFileSystem):
    """A store that keeps files and folders, as one behind SFTP: what is put is there before it is whole."""

    protocol = "filestore"

    @classmethod
    def _strip_protocol(cls, path: Any) -> str:
        text = str(path).removeprefix("filestore://")
        return str(super()._strip_protocol("/" + text.lstrip("/")))


@pytest.fixture(autouse=True)
def stores(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[None]:
    fsspec.register_implementation("filestore", FileStore, clobber=True)
    monkeypatch.setattr(remote_lock, "SETTLE_S", 0.001)
    monkeypatch.setattr(remote_lock, "STALE_S", 0.0)  # one cut short names nobody, and counts so long
    monkeypatch.setattr(os, "fsync", lambda handle: None)  # a killed process loses nothing by it
    monkeypatch.setattr(hub, "require_publishable", lambda *given: None)  # reads only; has tests of its own
    monkeypatch.setenv("HMA_CACHE", str(tmp_path / "cache"))
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


def killed(act: Callable[[], object], root: Path, at: int) -> bool:
    """Run an act in a process that ends at its operation number `at` in a folder; whether it got there.

    A file that is opened to be written is left empty; all else is left undone.
    """
    child = os.fork()
    if child == 0:
        done = 0

        def watch(event: str, given: Any) -> None:
            nonlocal done
            if event == "open" and not (isinstance(given[2], int) and given[2] & WRITES):
                return
            if event not in ("open", *CHANGES) or not str(given[0]).startswith((str(root), ".")):
                return
            done += 1
            if done == at + 1:
                if event == "open":
                    os.open(given[0], given[2], 0o644)
                os._exit(7)

        signal.alarm(30)
        try:
            plain = hub_swap.exchange
            hub_swap.exchange = lambda one, other: sys.audit("exchange", str(one)) or plain(one, other)
            sys.addaudithook(watch)
            act()
            os._exit(0)
        finally:
            os._exit(1)
    code = os.waitstatus_to_exitcode(os.waitpid(child, 0)[1])
    assert code in (0, 7)
    return code == 7


def parts(folder: Path, name: str) -> list[bytes]:
    return [(folder / "embodiments" / name / part).read_bytes() for part in PARTS]


@pytest.mark.parametrize(
    ("place", "begun"),
    [
        ("folder", False),
        ("folder", True),
        ("folder without exchange", True),
        ("file store", False),
        ("file store", True),
    ],
)
def test_a_push_killed_anywhere_is_ended_by_the_same_command(versions, tmp_path, monkeypatch, place, begun):
    old, new = versions
    root, base = tmp_path / "hub", tmp_path / "base"
    target = f"filestore://{root}" if place == "file store" else str(root)
    if place == "folder without exchange":
        monkeypatch.setattr(hub_swap, "exchange", lambda first, second: False)
    base.mkdir()
    if begun:
        hub.push(old, base)
    for at in range(MOST):
        shutil.rmtree(root, ignore_errors=True)
        shutil.copytree(base, root)
        cut = killed(lambda: hub.push(new, target), root, at)
        if begun:
            assert parts(hub.pull(root, ["hand"]), "hand") == parts(old, "hand")
        try:
            assert parts(hub.pull(root, ["arm"]), "arm") in (parts(old, "arm"), parts(new, "arm"))
        except (HubError, CheckpointError) as fault:
            assert not begun or (place != "folder" and "again" in str(fault.remedy)), fault
        hub.push(new, target)
        assert parts(hub.pull(root, ["arm"]), "arm") == parts(new, "arm")
        assert "| `arm` |" in (root / "README.md").read_text()
        left = [path.name for path in root.rglob("*") if ".part" in path.name or path.name.endswith(".lock")]
        assert not left
        if not cut:
            break
    assert 10 < at < MOST - 1


@pytest.mark.parametrize("place", ["folder", "file store"])
def test_a_data_push_killed_anywhere_is_ended_by_the_same_command(tmp_path, place):
    old, new = make_shards(tmp_path / "old", "arm"), make_shards(tmp_path / "new", "arm", held_out=0, seed=5)
    root, base, out = tmp_path / "hub", tmp_path / "base", tmp_path / "out"
    target = f"filestore://{root}" if place == "file store" else str(root)
    push_data(old, base)
    for at in range(MOST):
        for folder in (root, out):
            shutil.rmtree(folder, ignore_errors=True)
        shutil.copytree(base, root)
        cut = killed(lambda: push_data(new, target), root, at)
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
        if not cut:
            break
    assert 10 < at < MOST - 1


def test_a_pull_killed_anywhere_is_ended_by_the_same_command(versions, tmp_path):
    old, _ = versions
    out = tmp_path / "out"
    for at in range(MOST):
        shutil.rmtree(out, ignore_errors=True)
        cut = killed(lambda: hub.pull(old, ["arm"], out), out, at)
        if (out / "config.json").is_file() and checkpoint.Checkpoint.open(out).embodiments:
            assert parts(out, "arm") == parts(old, "arm")
        hub.pull(old, ["arm"], out)
        assert parts(out, "arm") == parts(old, "arm")
        assert not [path for path in out.rglob("*") if ".part" in path.name]
        if not cut:
            break
    assert 10 < at < MOST - 1


class Killed(BaseException):
    """Nothing comes after it."""


def cut_in_memory(act: Callable[[], object], monkeypatch: pytest.MonkeyPatch, at: int) -> bool:
    """Run an act whose store does nothing from its change number `at` on; whether it got there."""
    done = 0
    with monkeypatch.context() as patched:
        for name in ("pipe_file", "put_file", "cp_file", "rm_file"):
            plain = getattr(MemoryFileSystem, name)

            def change(self: Any, *given: Any, plain: Any = plain, **options: Any) -> Any:
                nonlocal done
                done += 1
                if done > at:
                    raise Killed
                return plain(self, *given, **options)

            patched.setattr(MemoryFileSystem, name, change)
        try:
            act()
        except Killed:
            return True
    return False


@pytest.mark.parametrize("begun", [False, True])
def test_a_push_to_an_object_store_killed_anywhere_is_ended_by_the_same_command(
    versions, tmp_path, monkeypatch, begun
):
    old, new = versions
    target, objects = "memory://hub/kills", fsspec.filesystem("memory").store
    for at in range(MOST):
        objects.clear()
        if begun:
            hub.push(old, target)
        cut = cut_in_memory(lambda: hub.push(new, target), monkeypatch, at)
        got = tmp_path / f"got{at}"
        if begun:
            assert parts(hub.pull(target, ["hand"], got), "hand") == parts(old, "hand")
        try:
            assert parts(hub.pull(target, ["arm"], got), "arm") in (parts(old, "arm"), parts(new, "arm"))
        except (HubError, CheckpointError) as fault:
            assert not begun or "again" in str(fault.remedy)
        hub.push(new, target)
        assert parts(hub.pull(target, ["arm"], tmp_path / f"new{at}"), "arm") == parts(new, "arm")
        if not cut:
            break
    objects.clear()
    assert 10 < at < MOST - 1
