"""Batch jobs: shares of an array, kills, several jobs, storage that fails; the same bytes in the end."""

import json
import os
import random
import signal
import subprocess
import sys
import time
import uuid
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import cv2
import h5py
import numpy as np
import pytest

from hma_data.conversion import reading
from hma_data.conversion import worker as shard_work
from hma_data.conversion.job import Conversion, convert
from hma_data.conversion.output import PLAN, Share
from hma_data.conversion.report import Summary
from hma_data.errors import OutputError
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.manifest import Manifest, shard_sizes
from hma_data.shards.verify import verify
from hma_data.sources.hdf5.source import Hdf5Source
from hma_data.storage.files import cache_folder
from hma_data.storage.locks import locked
from hma_data.storage.remote import place
from tests.command import hma
from tests.conftest import SMALL, BlockTokenizer, contents, write_toy
from tests.conftest import convert_toy as run
from tests.data.conversion.jobs import ends, files, start
from tests.data.fresh import ROOT
from tests.hostile import at_once


@pytest.mark.parametrize(
    ("options", "devices"),
    [({"workers": 0}, ["cuda:7"]), ({"workers": 2}, []), ({"workers": 0, "engine": "ray"}, [])],
)
def test_only_who_tokenizes_opens_the_tokenizer(
    options, devices: list[str], toy_arm: Embodiment, toy_recording: Path, tmp_path: Path, monkeypatch
) -> None:
    opened = []

    def get(name: str, *, weights: str | None, device: str) -> BlockTokenizer:
        opened.append(device)
        return BlockTokenizer()

    def stop(*given: object) -> None:
        raise OutputError("plan", "enough")

    monkeypatch.setattr("hma_data.conversion.job.get_tokenizer", get)
    monkeypatch.setattr("hma_data.conversion.job.Conversion.plan", stop)
    with pytest.raises(OutputError, match="enough"):
        convert(toy_arm, toy_recording, "fsq-8", tmp_path / "out", device="cuda:7", **options)
    assert opened == devices


@pytest.mark.slow
def test_workers_without_a_shard_are_told_before_the_work_and_by_a_dry_run(toy_arm, tmp_path) -> None:
    (tmp_path / "toy_arm.yaml").write_text(toy_arm.to_yaml())
    write_toy(tmp_path / "toy.hdf5", [20] * 8)
    words = ["convert", "-e", tmp_path / "toy_arm.yaml", "--source", tmp_path / "toy.hdf5"]
    words += ["--tokenizer", "fsq-8", "--out", tmp_path / "out", "--workers", "3"]
    line = "2 of 3 workers have work; --shard-frames 20 gives more"
    planned = hma(*words, "--dry-run")
    assert planned.stdout.splitlines()[-1] == line
    empty = "0 of 3 workers have work; --shard-frames 20 in every task gives more"
    shared = hma(*words, "--shard-index", "2", "--shard-count", "4", "--dry-run").stdout
    assert shared.splitlines()[-1] == empty and "with --workers 3 in each of 4 tasks" in shared
    assert line in hma(*words).stderr.splitlines()


UNGUARDED = """
from hma_data.conversion.job import convert
from hma_data.registry.embodiment import Embodiment
from hma_data.storage.paths import as_path
print("imported", flush=True)
robot = Embodiment.from_yaml(as_path("toy_arm.yaml").read_text())
convert(robot, "toy.hdf5", "fsq-8", "out", workers=2)
"""


@pytest.mark.slow
def test_a_script_that_every_worker_would_run_is_told_to_guard_its_call(toy_arm, toy_recording, tmp_path):
    (tmp_path / "toy_arm.yaml").write_text(toy_arm.to_yaml())
    (tmp_path / "bare.py").write_text(UNGUARDED)
    done = subprocess.run(
        [sys.executable, "bare.py"],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        capture_output=True,
        text=True,
        timeout=200,
    )
    assert done.returncode == 1
    assert done.stderr.count("Traceback") == 1, done.stderr
    last = done.stderr.splitlines()[-1]
    assert "bare.py: starts workers when it is imported" in last
    assert last.endswith('put the call under `if __name__ == "__main__":`')
    assert done.stdout.count("imported") <= 3  # this process and its two workers: none was started again
    assert not (tmp_path / "out").exists()


def test_one_share_is_done_by_one_job_and_a_whole_job_waits_for_none(toy_arm, toy_recording, tmp_path):
    out = tmp_path / "out"
    with locked(out, "0-of-2"):
        with pytest.raises(OutputError, match="another job is writing share 0-of-2"), locked(out, "0-of-2"):
            pass
        with locked(out, "1-of-2"):
            pass
        with pytest.raises(OutputError, match="another job is writing it"):
            run(toy_arm, toy_recording, out)
    assert not out.exists()


def test_a_read_error_that_goes_away_costs_nothing(toy_arm, toy_file, tmp_path, whole, monkeypatch) -> None:
    monkeypatch.setattr(reading, "WAITS_S", (0.0, 0.0, 0.0))
    failures = {"demo_3": [OSError(5, "Input/output error")] * 2, "demo_7": [TimeoutError("slow")] * 3}
    read = Hdf5Source.read

    def failing(self, uri, episode_id, embodiment):
        if failures.get(episode_id):
            raise failures[episode_id].pop()
        return read(self, uri, episode_id, embodiment)

    monkeypatch.setattr(Hdf5Source, "read", failing)
    run(toy_arm, toy_file, tmp_path / "out")
    assert contents(tmp_path / "out") == whole
    assert not any(failures.values())


def test_storage_that_stays_away_ends_the_job_and_quarantines_nobody(
    toy_arm: Embodiment, toy_file: Path, tmp_path: Path, whole: dict[str, bytes], monkeypatch
) -> None:
    monkeypatch.setattr(reading, "WAITS_S", (0.0,))
    read, away = Hdf5Source.read, True

    def failing(self, uri, episode_id, embodiment):
        if away and episode_id == "demo_7":
            raise ConnectionResetError("by peer")
        return read(self, uri, episode_id, embodiment)

    monkeypatch.setattr(Hdf5Source, "read", failing)
    with pytest.raises(OutputError, match=r"storage does not answer: by peer .* run the same command again"):
        run(toy_arm, toy_file, tmp_path / "out")
    away = False
    run(toy_arm, toy_file, tmp_path / "out")
    assert contents(tmp_path / "out") == whole


@pytest.mark.parametrize("refused", [["__init__"], ["write_table", "close"]], ids=["at once", "later"])
def test_a_disk_that_refuses_any_byte_is_one_error_without_a_remnant(
    refused: list[str], toy_arm: Embodiment, toy_file: Path, tmp_path: Path, monkeypatch
) -> None:
    def full(*arguments: object, **options: object) -> None:
        raise OSError(28, "No space left on device")

    for method in refused:
        monkeypatch.setattr(f"pyarrow.parquet.ParquetWriter.{method}", full)
    with pytest.raises(OutputError, match=r"shard-00000.parquet: .*No space left on device .* free space"):
        run(toy_arm, toy_file, tmp_path / "out")
    assert not list((tmp_path / "out").rglob("*.part"))


def test_a_full_disk_is_one_error_and_what_was_made_is_kept(toy_arm, toy_file, tmp_path, whole, monkeypatch):
    add, calls = shard_work.ShardWriter.add, 0

    def full(self, episode, columns):
        nonlocal calls
        calls += 1
        if calls == 9:
            raise OSError(28, "No space left on device")
        add(self, episode, columns)

    monkeypatch.setattr(shard_work.ShardWriter, "add", full)
    with pytest.raises(OutputError, match=r"No space left on device .* free space"):
        run(toy_arm, toy_file, tmp_path / "out")
    assert list((tmp_path / "out").rglob("shard-*"))
    assert not list((tmp_path / "out").rglob("*.part"))
    run(toy_arm, toy_file, tmp_path / "out")
    assert contents(tmp_path / "out") == whole


def test_an_episode_that_breaks_off_in_the_middle_leaves_nothing_of_itself(
    toy_arm, toy_recording, tmp_path, monkeypatch
) -> None:
    with h5py.File(toy_recording, "a") as file:
        pictures = file["data/demo_4/obs/image"][()]
        del file["data/demo_4/obs/image"]
        kind = h5py.vlen_dtype(np.uint8)
        encoded = file.create_dataset("data/demo_4/obs/image", (len(pictures),), dtype=kind)
        for i, picture in enumerate(pictures):
            encoded[i] = cv2.imencode(".png", picture)[1].ravel() if i < 20 else np.zeros(9, np.uint8)
    monkeypatch.setattr(shard_work, "FRAMES_A_BATCH", 4)
    summary = run(toy_arm, toy_recording, tmp_path / "out")
    assert summary.manifest.quarantined == 1
    assert verify(tmp_path / "out") == []
    assert summary.manifest.splits["train"]["episodes"] + summary.manifest.splits["val"]["episodes"] == 11


S3 = pytest.param("s3", marks=pytest.mark.slow)
IN_PROCESS = pytest.mark.parametrize("out", ["folder", "memory"], indirect=True)


@pytest.fixture
def out(request: pytest.FixtureRequest, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("HMA_CACHE", str(tmp_path / "cache"))
    if request.param == "s3":
        return request.getfixturevalue("s3_out")
    return tmp_path / "out" if request.param == "folder" else place(f"memory://{uuid.uuid4().hex}/set")


@pytest.mark.parametrize("out", ["folder"], indirect=True)
@pytest.mark.parametrize("count", [3, 20])
def test_shares_in_any_order_make_what_one_job_makes(count, toy_arm, toy_file, out, whole) -> None:
    order = list(range(count))
    random.Random(count).shuffle(order)
    job = Conversion(toy_arm, toy_file, BlockTokenizer(), out, settings=SMALL)
    for index in order:
        assert isinstance(job.run_share(Share(index, count)), Summary) == (index == order[-1])
    assert files(out) == whole


@IN_PROCESS
def test_shares_run_side_by_side_and_one_of_them_finishes(toy_arm, toy_file, out, whole) -> None:
    job = Conversion(toy_arm, toy_file, BlockTokenizer(), out, settings=SMALL)
    at_once(job.run_share, [Share(i, 3) for i in range(3)])
    assert files(out) == whole


@pytest.mark.parametrize("out", [S3], indirect=True)
def test_a_job_killed_while_a_shard_goes_to_s3_is_continued(toy_file, out, whole, tmp_path, proxy) -> None:
    def kill(method: str, path: str, number: int) -> str | None:
        if method != "PUT" or "shard-00001" not in path:
            return None
        process.kill()
        return "drop"

    proxy.trouble = kill
    process = start(tmp_path, toy_file, out, workers=0)
    _, errors = process.communicate(timeout=200)
    assert process.returncode == -signal.SIGKILL, errors
    assert "manifest.json" not in files(out)
    proxy.trouble = lambda *asked: None
    ends(start(tmp_path, toy_file, out))
    assert files(out) == whole
    assert not list(cache_folder().rglob("*.part"))


def workers_of(pid: int) -> list[int]:
    try:
        children = Path(f"/proc/{pid}/task/{pid}/children").read_text().split()
        names = {child: Path(f"/proc/{child}/cmdline").read_bytes() for child in children}
    except OSError:
        return []
    return [int(child) for child, name in names.items() if b"spawn_main" in name]


@pytest.mark.slow
@pytest.mark.parametrize("out", ["folder"], indirect=True)
def test_a_storm_of_kills_ends_with_the_same_bytes(toy_file, out, whole, tmp_path) -> None:
    """Each run loses two workers, then is killed, each at a drawn number of shards; the last one ends."""
    draws = random.Random(0)
    for last in (False, False, True):
        process = start(tmp_path, toy_file, out)
        for victim in ("worker", "worker", "job"):
            wanted = len(shard_sizes(out)) + draws.choice([0, 1])
            while process.poll() is None and (len(shard_sizes(out)) < wanted or not workers_of(process.pid)):
                time.sleep(0.01)
            alive = workers_of(process.pid)
            if victim == "worker" and alive:
                with suppress(ProcessLookupError):
                    os.kill(draws.choice(alive), signal.SIGKILL)
            elif victim == "job" and not last:
                process.kill()
        _, errors = process.communicate(timeout=200)
        assert process.returncode in (0, -signal.SIGKILL), errors
    assert process.returncode == 0, errors
    assert files(out) == whole


@pytest.mark.slow  # test_engines has it, and hangs, without a conversion around them
@pytest.mark.parametrize("out", ["folder"], indirect=True)
def test_an_episode_that_crashes_its_reader_is_refused_and_the_rest_kept(toy_recording, out, tmp_path):
    ends(start(tmp_path, toy_recording, out, demo_5="SIGSEGV"))
    lines = [json.loads(line) for line in (out / "quarantine.jsonl").read_text().splitlines()]
    assert [line["id"] for line in lines] == ["demo_5"]
    assert "ended the process by SIGSEGV" in lines[0]["message"]
    assert verify(out) == []
    splits = Manifest.load(out).splits
    assert splits["train"]["episodes"] + splits["val"]["episodes"] == 11


# -- several jobs in one place of a store, which has no lock


@pytest.mark.parametrize("out", [S3], indirect=True)
def test_of_two_jobs_of_different_plans_at_once_one_is_refused(toy_arm, toy_file, out, whole, tmp_path):
    run(toy_arm, toy_file, tmp_path / "other", settings=replace(SMALL, seed=3))
    jobs = {seed: start(tmp_path, toy_file, out, workers=0, seed=seed) for seed in (0, 3)}
    said = {seed: process.communicate(timeout=100)[1] for seed, process in jobs.items()}
    (winner,) = (seed for seed, process in jobs.items() if process.returncode == 0)
    loser = 3 - winner
    assert jobs[loser].returncode == 1
    assert "OutputError" in said[loser] and "different: settings" in said[loser], said[loser]
    assert files(out) == {0: whole, 3: files(tmp_path / "other")}[winner]
    assert not (out / PLAN).is_file()
    assert verify(out) == []
