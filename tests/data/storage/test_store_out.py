"""Conversions into object stores: the bytes of a folder here, whole shards only, one plan at a time."""

import os
import random
import subprocess
import sys
import threading
import uuid
from dataclasses import replace
from pathlib import Path

import pytest
from fsspec.implementations.memory import MemoryFileSystem

from hma_data.conversion.output import PLAN
from hma_data.conversion.rewrite import merge, restat
from hma_data.errors import OutputError, ShardError, StorageAwayError, StorageError
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.verify import verify
from hma_data.storage import remote as store
from hma_data.storage.files import cache_folder, remove_parts, upload_folder
from hma_data.storage.remote import RemotePath, place, put_bytes
from tests.conftest import SMALL, write_toy
from tests.conftest import convert_toy as run
from tests.data.conversion.jobs import files
from tests.hostile import at_once


@pytest.fixture(autouse=True)
def quick(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.setattr(store, "WAITS_S", (0.0, 0.0, 0.0))
    monkeypatch.setenv("HMA_CACHE", str(tmp_path / "cache"))


@pytest.fixture
def out() -> RemotePath:
    path = place(f"memory://{uuid.uuid4().hex}/set")
    assert isinstance(path, RemotePath)
    return path


def test_a_store_gets_the_bytes_that_a_folder_gets(toy_arm, toy_file, out, whole) -> None:
    summary = run(toy_arm, toy_file, Path(str(out)))
    assert summary.out == out
    assert files(out) == whole
    assert verify(out) == []
    assert not [path for path in cache_folder().rglob("*") if path.is_file()]
    assert run(toy_arm, toy_file, out).made_shards == 0


def test_extension_and_merge_go_into_a_store(toy_arm, tmp_path, out) -> None:
    recording = tmp_path / "recorded"
    recording.mkdir()
    for day in ("monday", "tuesday"):
        write_toy(recording / f"{day}.hdf5", range(20, 24))
        run(toy_arm, recording, out, extend=day == "tuesday")
        run(toy_arm, recording, tmp_path / "here", extend=day == "tuesday")
        assert files(out) == files(tmp_path / "here")
    merge([out], tmp_path / "merged")
    merge([tmp_path / "here"], out.with_name("merged"))
    assert files(out.with_name("merged")) == files(tmp_path / "merged")


def test_overwrite_starts_anew_and_foreign_files_are_never_touched(toy_arm, toy_file, out, whole) -> None:
    run(toy_arm, toy_file, out, settings=replace(SMALL, seed=3))
    with pytest.raises(OutputError, match="belongs to another conversion"):
        run(toy_arm, toy_file, out)
    put_bytes(b"my notes", out / "README.md")
    run(toy_arm, toy_file, out, overwrite=True)
    assert files(out) == whole | {"README.md": b"my notes"} and verify(out) == []
    put_bytes(b"mine", out.with_name("other") / "notes.txt")
    with pytest.raises(OutputError, match=r"holds what is not of a shard set: notes\.txt"):
        run(toy_arm, toy_file, out.with_name("other"), overwrite=True)
    assert files(out.with_name("other")) == {"notes.txt": b"mine"}


def test_a_manifest_is_restored_in_place(toy_arm, toy_file, out, whole) -> None:
    run(toy_arm, toy_file, out)
    (out / "manifest.json").unlink()
    restat(Path(str(out)))
    assert set(out.listing()) == set(whole)
    assert verify(out) == []


def test_uploads_that_fail_now_and_then_change_nothing(toy_arm, toy_file, out, whole, monkeypatch) -> None:
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
    run(toy_arm, toy_file, out)
    monkeypatch.undo()
    assert failed > 20
    assert files(out) == whole


def test_a_store_that_goes_away_is_one_error_and_what_was_put_is_kept(
    toy_arm, toy_file, out, whole, monkeypatch: pytest.MonkeyPatch
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
            run(toy_arm, toy_file, out)
    assert {name.split("/")[0] for name in out.listing()} <= {"train", "val", PLAN}
    assert run(toy_arm, toy_file, out).kept_shards == 2
    assert files(out) == whole


def test_a_store_that_refuses_is_one_error(toy_arm, toy_recording, out, monkeypatch) -> None:
    def refuse(self, *args, **options):
        raise PermissionError("403 Forbidden")

    monkeypatch.setattr(MemoryFileSystem, "pipe_file", refuse)
    with pytest.raises(StorageError, match="403 Forbidden — check the credentials, and what they allow"):
        run(toy_arm, toy_recording, out)


@pytest.fixture
def other(toy_arm: Embodiment, toy_recording: Path, tmp_path: Path) -> dict[str, bytes]:
    run(toy_arm, toy_recording, tmp_path / "other", settings=replace(SMALL, seed=3))
    return files(tmp_path / "other")


def once(act):
    """A progress callback that acts when a job has seen what is there, and made nothing yet."""
    calls = iter([act])

    def on_progress(progress) -> None:
        if call := next(calls, None):
            call()

    return on_progress


def test_another_plan_is_refused_while_a_job_runs(toy_arm, toy_file, out, whole) -> None:
    def differ() -> None:
        assert not [name for name in out.listing() if "shard-" in name]
        said = (
            rf"{out}: another conversion is being written there; different: settings .* delete {out}/\.plan"
        )
        with pytest.raises(OutputError, match=said):
            run(toy_arm, toy_file, out, settings=replace(SMALL, seed=3))

    run(toy_arm, toy_file, out, on_progress=once(differ))
    assert files(out) == whole


def test_a_damaged_claim_is_one_error(toy_arm, toy_recording, out) -> None:
    put_bytes(b'{"hash": ', out / PLAN)
    with pytest.raises(OutputError, match=rf"{out}/\.plan: is damaged: it states no plan — delete it"):
        run(toy_arm, toy_recording, out)


def test_an_equal_job_at_the_same_time_only_wastes_work(toy_arm, toy_file, out, whole) -> None:
    run(toy_arm, toy_file, out, on_progress=once(lambda: run(toy_arm, toy_file, out)))
    assert files(out) == whole


def test_of_several_plans_at_once_one_is_made(toy_arm, toy_recording, out, tmp_path) -> None:
    start, made, refused = threading.Barrier(4), [], []

    def one(seed: int) -> None:
        start.wait()
        try:
            run(toy_arm, toy_recording, out, settings=replace(SMALL, seed=seed))
            made.append(seed)
        except OutputError as fault:
            refused.append(str(fault))

    at_once(one, range(4))
    assert len(made) == 1 and len(refused) == 3
    run(toy_arm, toy_recording, tmp_path / "alone", settings=replace(SMALL, seed=made[0]))
    assert files(out) == files(tmp_path / "alone")


def test_a_shard_of_another_plan_is_found_before_the_manifest(toy_arm, toy_recording, out, other) -> None:
    name = "train/shard-00000.parquet"

    def finished(progress) -> None:
        if (out / name).is_file():
            put_bytes(other[name], out / name)

    with pytest.raises(ShardError, match=rf"{name}: was written under the plan \w+, the set under \w+: two"):
        run(toy_arm, toy_recording, out, on_progress=finished)
    assert not (out / "manifest.json").is_file()


def test_after_a_kill_another_plan_needs_the_claim_deleted(toy_arm, toy_recording, out, other) -> None:
    def stop() -> None:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        run(toy_arm, toy_recording, out, on_progress=once(stop))
    with pytest.raises(OutputError, match=r"delete .*\.plan"):
        run(toy_arm, toy_recording, out, settings=replace(SMALL, seed=3))
    (out / PLAN).unlink()
    run(toy_arm, toy_recording, out, settings=replace(SMALL, seed=3))
    assert files(out) == other


def test_a_part_of_a_running_process_is_left(out: RemotePath) -> None:
    folder = upload_folder(out / "train")
    folder.mkdir(parents=True)
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    for pid in (os.getpid(), ended.pid):
        (folder / f".shard-00000.parquet.{pid}.part").touch()
    remove_parts(out)
    assert [path.name for path in folder.iterdir()] == [f".shard-00000.parquet.{os.getpid()}.part"]
