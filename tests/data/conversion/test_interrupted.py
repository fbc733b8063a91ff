"""Conversions that are stopped, killed or shared by jobs, here and in stores: the same bytes at the end."""

import json
import os
import random
import signal
import time
import uuid
from contextlib import suppress
from dataclasses import replace
from pathlib import Path

import pytest

from hma_data.conversion.job import Conversion
from hma_data.conversion.output import PLAN, Share
from hma_data.conversion.report import Summary
from hma_data.shards.manifest import Manifest, shard_sizes
from hma_data.shards.verify import verify
from hma_data.storage.files import cache_folder
from hma_data.storage.remote import place
from tests.conftest import SMALL, BlockTokenizer
from tests.conftest import convert_toy as run
from tests.data.conversion.jobs import ends, files, start
from tests.hostile import at_once

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
        if method != "PUT" or f"shard-0000{wanted}" not in path:
            return None
        process.kill()
        return "drop"

    proxy.trouble = kill
    for wanted in (1, 2):  # noqa: B007
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


@pytest.mark.slow  # test_engines has both, quickly, without a conversion around them
@pytest.mark.parametrize("out", ["folder"], indirect=True)
@pytest.mark.parametrize("kind", ["SIGSEGV", "hang"])
def test_an_episode_that_crashes_or_hangs_its_reader_is_refused_and_the_rest_kept(
    kind: str, toy_recording: Path, out: Path, tmp_path: Path
) -> None:
    ends(start(tmp_path, toy_recording, out, quiet_s=30, demo_5=kind))
    lines = [json.loads(line) for line in (out / "quarantine.jsonl").read_text().splitlines()]
    assert [line["id"] for line in lines] == ["demo_5"]
    said = "made no progress for 30 s" if kind == "hang" else "ended the process by SIGSEGV"
    assert said in lines[0]["message"]
    assert verify(out) == []
    splits = Manifest.load(out).splits
    assert splits["train"]["episodes"] + splits["val"]["episodes"] == 11


# -- several jobs in one place of a store, which has no lock


@pytest.mark.parametrize("out", [S3], indirect=True)
def test_two_equal_jobs_at_once_only_waste_work(toy_file, out, whole, tmp_path) -> None:
    for process in [start(tmp_path, toy_file, out, workers=0) for _ in range(2)]:
        ends(process)
    assert files(out) == whole


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
