"""Conversions into object stores: the bytes a folder here would hold, whole shards only, a job at a time."""

import json
import os
import random
import subprocess
import sys
import threading
import time
import uuid
from dataclasses import asdict, replace
from datetime import timedelta
from pathlib import Path

import pytest
from fsspec.implementations.memory import MemoryFileSystem

from hma_data import remote_lock, store
from hma_data.convert import Shared, convert, convert_share
from hma_data.embodiment import Embodiment
from hma_data.errors import MissingDependencyError, OutputError, StorageAwayError, StorageError
from hma_data.files import cache_folder
from hma_data.output import LOCK, Share, locked
from hma_data.plan import Settings
from hma_data.remote_lock import Holder
from hma_data.shards.remake import merge
from hma_data.shards.restat import restat
from hma_data.shards.verify import verify
from hma_data.store import RemotePath, place, put_bytes
from tests.conftest import BlockTokenizer, write_toy

SMALL = Settings(val_fraction=0.2, shard_frames=60)


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """No waiting, and a cache of its own."""
    monkeypatch.setattr(store, "WAITS_S", (0.0, 0.0, 0.0))
    monkeypatch.setattr(remote_lock, "SETTLE_S", 0.02)
    monkeypatch.setenv("HMA_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def out() -> RemotePath:
    path = place(f"memory://{uuid.uuid4().hex}/set")
    assert isinstance(path, RemotePath)
    return path


def local(folder: Path) -> dict[str, bytes]:
    return {
        path.relative_to(folder).as_posix(): path.read_bytes()
        for path in sorted(folder.rglob("*"))
        if path.is_file()
    }


def remote(folder: RemotePath) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in folder.listing()}


def run(arm: Embodiment, recording: Path, out: Path, settings: Settings = SMALL, **options):
    return convert(arm, str(recording), BlockTokenizer(), out, settings=settings, **options)


@pytest.fixture
def whole(toy_arm: Embodiment, toy_recording: Path, tmp_path: Path) -> dict[str, bytes]:
    """What a folder of this machine holds."""
    run(toy_arm, toy_recording, tmp_path / "whole")
    return local(tmp_path / "whole")


# -- the same bytes


def test_a_store_gets_the_bytes_that_a_folder_gets(toy_arm, toy_recording, out, whole) -> None:
    summary = run(toy_arm, toy_recording, Path(str(out)))
    assert summary.out == out
    assert remote(out) == whole
    assert verify(out) == []
    assert not [path for path in cache_folder().rglob("*") if path.is_file()]
    assert run(toy_arm, toy_recording, out).made_shards == 0


def test_a_job_that_was_interrupted_goes_on_where_it_was(toy_arm, toy_recording, out, whole) -> None:
    class Stopping(BlockTokenizer):
        left = 6

        def encode(self, frames):
            self.left -= 1
            if self.left < 0:
                raise KeyboardInterrupt
            return super().encode(frames)

    with pytest.raises(KeyboardInterrupt):
        convert(toy_arm, str(toy_recording), Stopping(), out, settings=SMALL)
    there = {name for name in out.listing() if name.startswith(("train", "val"))}
    assert there and "manifest.json" not in out.listing()
    assert run(toy_arm, toy_recording, out).kept_shards == len(there)
    assert remote(out) == whole


def test_shares_write_into_one_store(toy_arm, toy_recording, out, whole) -> None:
    threads: list[threading.Thread] = []
    done: list[Shared] = []
    for index in range(3):
        share = Share(index, 3)

        def work(share: Share = share) -> None:
            done.append(
                convert_share(toy_arm, str(toy_recording), BlockTokenizer(), out, share, settings=SMALL)
            )

        threads.append(threading.Thread(target=work))
        threads[-1].start()
    for thread in threads:
        thread.join()
    assert min(item.missing for item in done) == 0
    assert remote(out) == whole


def test_extension_and_merge_go_into_a_store(toy_arm, tmp_path, out) -> None:
    recording = tmp_path / "recorded"
    recording.mkdir()
    for day in ("monday", "tuesday"):
        write_toy(recording / f"{day}.hdf5", range(20, 24))
        run(toy_arm, recording, out, extend=day == "tuesday")
        run(toy_arm, recording, tmp_path / "here", extend=day == "tuesday")
        assert remote(out) == local(tmp_path / "here")
    merge([out], tmp_path / "merged")
    merge([tmp_path / "here"], out.with_name("merged"))
    assert remote(out.with_name("merged")) == local(tmp_path / "merged")


def test_overwrite_starts_anew_and_foreign_files_are_never_touched(
    toy_arm, toy_recording, out, whole
) -> None:
    run(toy_arm, toy_recording, out, settings=replace(SMALL, seed=3))
    with pytest.raises(OutputError, match="belongs to another conversion"):
        run(toy_arm, toy_recording, out)
    run(toy_arm, toy_recording, out, overwrite=True)
    assert remote(out) == whole
    put_bytes(b"mine", out.with_name("other") / "notes.txt")
    with pytest.raises(OutputError, match=r"is not a shard set: it holds notes\.txt"):
        run(toy_arm, toy_recording, out.with_name("other"), overwrite=True)
    assert remote(out.with_name("other")) == {"notes.txt": b"mine"}


def test_a_manifest_is_restored_in_place(toy_arm, toy_recording, out, whole) -> None:
    run(toy_arm, toy_recording, out)
    (out / "manifest.json").unlink()
    restat(Path(str(out)))
    assert set(out.listing()) == set(whole)
    assert verify(out) == []


# -- faults


def test_uploads_that_fail_now_and_then_change_nothing(
    toy_arm, toy_recording, out, whole, monkeypatch: pytest.MonkeyPatch
) -> None:
    draws, failed = random.Random(0), 0

    def sometimes(name: str) -> None:
        real = getattr(MemoryFileSystem, name)

        def stumbling(self, *args, **options):
            nonlocal failed
            if draws.random() < 0.35:
                failed += 1
                raise draws.choice([ConnectionResetError("cut"), TimeoutError("slow"), OSError(16, "busy")])
            return real(self, *args, **options)

        monkeypatch.setattr(MemoryFileSystem, name, stumbling)

    monkeypatch.setattr(store, "WAITS_S", (0.0,) * 12)
    for name in ("put_file", "pipe_file", "cat_file", "info", "find", "ls"):
        sometimes(name)
    run(toy_arm, toy_recording, out)
    monkeypatch.undo()
    assert failed > 20
    assert remote(out) == whole


def test_a_store_that_goes_away_is_one_error_and_what_was_put_is_kept(
    toy_arm, toy_recording, out, whole, monkeypatch: pytest.MonkeyPatch
) -> None:
    real, left = MemoryFileSystem.put_file, 2

    def away(self, *args, **options):
        nonlocal left
        left -= 1
        if left < 0:
            raise ConnectionResetError("cut")
        return real(self, *args, **options)

    with monkeypatch.context() as patch:
        patch.setattr(MemoryFileSystem, "put_file", away)
        with pytest.raises(StorageAwayError, match="cannot be written: .* run the same command again"):
            run(toy_arm, toy_recording, out)
    assert {name.split("/")[0] for name in out.listing()} <= {"train", "val"}
    assert run(toy_arm, toy_recording, out).kept_shards == 2
    assert remote(out) == whole


def test_a_store_that_refuses_is_one_error(toy_arm, toy_recording, out, monkeypatch) -> None:
    def refuse(self, *args, **options):
        raise PermissionError("403 Forbidden")

    monkeypatch.setattr(MemoryFileSystem, "pipe_file", refuse)
    with pytest.raises(StorageError, match="403 Forbidden — check the credentials, and what they allow"):
        run(toy_arm, toy_recording, out)


def test_a_driver_that_is_not_installed_is_named(toy_arm, toy_recording, monkeypatch) -> None:
    monkeypatch.setitem(sys.modules, "adlfs", None)
    with pytest.raises(
        MissingDependencyError, match="az://box/set: needs the package of az:// — pip install"
    ):
        run(toy_arm, toy_recording, Path("az://box/set"))


# -- the lock


def holder(**facts: object) -> Holder:
    return replace(Holder.me(), **{"job": "theirs", "host": "far", "machine": "other", "pid": 7, **facts})


def hold(path: RemotePath, who: Holder, age_s: float = 0.0) -> None:
    put_bytes(json.dumps(asdict(who)).encode(), path)
    path.files.store[path.key].modified -= timedelta(seconds=age_s)


def test_another_job_on_one_output_is_told_who_writes(out: RemotePath) -> None:
    hold(out / LOCK, holder())
    said = r"another job is writing it: process 7 on far, since 20\S+ \S+ UTC — wait for it"
    with pytest.raises(OutputError, match=said), locked(out):
        pass
    assert json.loads((out / LOCK).read_bytes())["job"] == "theirs"


def test_a_job_that_was_not_heard_of_for_three_minutes_is_forgotten(out: RemotePath) -> None:
    hold(out / LOCK, holder(), age_s=170)
    with pytest.raises(OutputError, match="another job"), locked(out):
        pass
    hold(out / LOCK, holder(), age_s=181)
    with locked(out):
        assert json.loads((out / LOCK).read_bytes())["pid"] == os.getpid()
    assert out.listing() == {}


def test_a_job_whose_process_on_this_machine_has_ended_is_forgotten_at_once(out: RemotePath) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    hold(out / LOCK, replace(Holder.me(), job="theirs", pid=ended.pid))
    with locked(out):
        pass
    hold(out / LOCK, replace(Holder.me(), job="theirs"))
    with pytest.raises(OutputError, match="another job"), locked(out):
        pass


def test_of_two_that_come_at_once_one_has_it(out: RemotePath, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote_lock, "SETTLE_S", 0.2)
    inside, most, refused, start = 0, 0, 0, threading.Barrier(4)

    def one() -> None:
        nonlocal inside, most, refused
        start.wait()
        try:
            with locked(out):
                inside += 1
                most = max(most, inside)
                time.sleep(0.3)
                inside -= 1
        except OutputError:
            refused += 1

    threads = [threading.Thread(target=one) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (most, refused) == (1, 3)


def test_a_lock_is_written_again_and_its_loss_is_noticed(
    out: RemotePath, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(remote_lock, "REFRESH_S", 0.05)
    with locked(out) as lock:
        first = json.loads((out / LOCK).read_bytes())["time"]
        time.sleep(0.5)
        assert json.loads((out / LOCK).read_bytes())["time"] > first
        lock.check()
        hold(out / LOCK, holder())
        time.sleep(0.5)
        with pytest.raises(OutputError, match="another job is writing it: process 7 on far"):
            lock.check()
    assert json.loads((out / LOCK).read_bytes())["job"] == "theirs"


def test_shares_go_beside_each_other_and_not_beside_a_whole_job(out: RemotePath) -> None:
    with locked(out, Share(0, 2)), locked(out, Share(1, 2)):
        with (
            pytest.raises(OutputError, match="another job is writing share 1-of-2"),
            locked(out, Share(1, 2)),
        ):
            pass
        with pytest.raises(OutputError, match="another job is writing it"), locked(out):
            pass
    with locked(out), pytest.raises(OutputError, match="another job"), locked(out, Share(0, 2)):
        pass
    assert out.listing() == {}
