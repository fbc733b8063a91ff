"""Shard sets on S3, against moto's server on loopback: kills, lost connections, busy answers, no access."""

import http.client
import os
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from dataclasses import replace
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from pathlib import Path

import fsspec
import numpy as np
import pytest
import torch

from hma_data.conversion.job import convert
from hma_data.errors import HMAError, OutputError, ShardError, StorageAwayError, StorageError
from hma_data.shards.reader import ShardSet
from hma_data.shards.verify import verify
from hma_data.storage import remote as store
from hma_data.storage.files import cache_folder
from hma_data.storage.remote import RemotePath, place, put_file
from tests.conftest import ARM_YAML, SMALL, BlockTokenizer
from tests.conftest import contents as local
from tests.conftest import convert_toy as run

pytestmark = pytest.mark.slow

ROOT = Path(__file__).parents[3]
KEYS = {"AWS_ACCESS_KEY_ID": "key", "AWS_SECRET_ACCESS_KEY": "secret", "AWS_DEFAULT_REGION": "us-east-1"}


class Proxy(ThreadingHTTPServer):
    """Hands requests on to the server, and lets some go wrong.

    Attributes:
        trouble: called with (method, path, number); a status, "cut" (half an answer), "drop" (not handed on),
            "lost" (handed on, not answered) or None.
        log: (method, path, range) of every request.
    """

    daemon_threads = True

    def __init__(self, port: int) -> None:
        super().__init__(("127.0.0.1", 0), _Hand)
        self.port, self.lock = port, threading.Lock()
        self.trouble = lambda method, path, number: None
        self.log: list[tuple[str, str, str | None]] = []

    @property
    def url(self) -> str:
        return f"http://127.0.0.1:{self.server_address[1]}"

    def handle_error(self, request, client_address) -> None:
        pass  # connections are cut on purpose


class _Hand(BaseHTTPRequestHandler):
    server: Proxy
    protocol_version = "HTTP/1.1"

    def setup(self) -> None:
        super().setup()
        self.connection.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)

    def _any(self) -> None:
        with self.server.lock:
            self.server.log.append((self.command, self.path, self.headers.get("Range")))
            what = self.server.trouble(self.command, self.path, len(self.server.log))
        if what == "drop":
            self.close_connection = True
            return
        body = self.rfile.read(int(self.headers.get("Content-Length", 0)))
        if isinstance(what, int):
            said = b"<Error><Code>SlowDown</Code><Message>busy</Message></Error>" if what == 503 else b""
            self._answer(what, [], said)
            return
        asked = http.client.HTTPConnection("127.0.0.1", self.server.port)
        asked.request(self.command, self.path, body, dict(self.headers))
        answer = asked.getresponse()
        data = answer.read()
        asked.close()
        if what == "lost":
            self.close_connection = True
            return
        self._answer(answer.status, answer.getheaders(), data, cut=what == "cut")

    def _answer(self, status: int, headers: list[tuple[str, str]], data: bytes, cut: bool = False) -> None:
        self.send_response_only(status)
        stated = {name.lower() for name, _ in headers}
        for name, value in headers:
            if name.lower() not in ("connection", "transfer-encoding"):
                self.send_header(name, value)
        if "content-length" not in stated:
            self.send_header("Content-Length", str(len(data)))
        self.end_headers()
        if self.command != "HEAD":
            self.wfile.write(data[: len(data) // 2] if cut else data)
        if cut:
            self.close_connection = True

    do_GET = do_PUT = do_POST = do_HEAD = do_DELETE = _any

    def log_message(self, *args: object) -> None:
        pass


@pytest.fixture(scope="module")
def server() -> Iterator[int]:
    import moto.server

    running = moto.server.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    running.start()
    yield running.get_host_and_port()[1]
    running.stop()


@pytest.fixture
def proxy(server: int, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Iterator[Proxy]:
    """A way to the server; every store made in the test goes through it, and nothing is kept after."""
    running = Proxy(server)
    threading.Thread(target=running.serve_forever, daemon=True).start()
    for name, value in KEYS.items():
        monkeypatch.setenv(name, value)
    monkeypatch.setenv("AWS_ENDPOINT_URL", running.url)
    monkeypatch.setenv("AWS_EC2_METADATA_DISABLED", "true")
    monkeypatch.setenv("HMA_CACHE", str(tmp_path / "cache"))
    monkeypatch.setenv("AWS_MAX_ATTEMPTS", "1")
    monkeypatch.setattr(store, "WAITS_S", (0.0, 0.05, 0.1))
    files = fsspec.get_filesystem_class("s3")
    monkeypatch.setattr(files, "retries", 1)  # the driver's own tries take long
    files.clear_instance_cache()
    yield running
    running.trouble = lambda *asked: None
    files.clear_instance_cache()
    running.shutdown()
    running.server_close()


@pytest.fixture
def out(proxy: Proxy, request: pytest.FixtureRequest) -> RemotePath:
    bucket = f"bucket-{abs(hash(request.node.name)) % 10**9}"
    path = place(f"s3://{bucket}/some/set")
    assert isinstance(path, RemotePath)
    path.files.mkdir(bucket)
    return path


def remote(folder: RemotePath) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in folder.listing()}


# -- the same bytes


def test_s3_gets_the_bytes_that_a_folder_gets_and_gives_them_back(
    toy_arm, toy_recording, out, whole, tmp_path
) -> None:
    run(toy_arm, toy_recording, out)
    assert remote(out) == whole
    assert verify(out) == []
    here = ShardSet(tmp_path / "whole")
    for cache in (True, False):
        there = ShardSet(str(out), cache=cache)
        for index in here.episodes["episode_index"].to_pylist():
            for name, values in here.episode_rows(index).items():
                np.testing.assert_array_equal(there.episode_rows(index)[name], values)


def test_the_manifest_is_put_last(toy_arm, toy_recording, out, proxy) -> None:
    run(toy_arm, toy_recording, out)
    puts = [path for method, path, _ in proxy.log if method == "PUT" and not path.endswith(".plan")]
    assert puts[-1].endswith("manifest.json")
    assert sum("shard-" in path for path in puts) == len(ShardSet(out).manifest.shards)


def test_a_row_group_costs_one_request_after_the_footer(toy_arm, toy_recording, out, proxy) -> None:
    run(toy_arm, toy_recording, out)
    shards = ShardSet(out, cache=False)
    name = shards.manifest.shards[0].path
    shards.read(name, [0], shards.columns())
    proxy.log.clear()
    shards.read(name, [0], shards.columns())
    assert [(method, bool(asked)) for method, _, asked in proxy.log] == [("GET", True)]


@pytest.mark.slow
def test_a_large_shard_goes_up_in_parts_and_appears_whole(out, proxy, tmp_path) -> None:
    data = np.random.default_rng(0).bytes(120 << 20)
    (tmp_path / "large").write_bytes(data)
    cuts = iter([True])

    def once(method: str, path: str, number: int) -> str | None:
        return "drop" if method == "PUT" and "partNumber=2" in path and next(cuts, False) else None

    proxy.trouble = once
    put_file(tmp_path / "large", out / "large")
    assert sum("partNumber" in path for _, path, _ in proxy.log) >= 3
    assert (out / "large").stat().st_size == len(data)
    assert (out / "large").open("rb").read(100) == data[:100]


@pytest.mark.slow
def test_forked_readers_of_a_dataloader_see_the_same_batches(
    toy_arm, toy_recording, out, tmp_path, whole
) -> None:
    from hma_data.loading.dataset import WindowDataset

    run(toy_arm, toy_recording, out)
    ours, theirs = WindowDataset(tmp_path / "whole", "train", 4), WindowDataset(str(out), "train", 4)
    _ = theirs[0]  # the parent has connections already
    batches = torch.utils.data.DataLoader(
        theirs, batch_size=None, num_workers=1, multiprocessing_context="fork"
    )
    for found, expected in zip(list(batches)[:5], (ours[i] for i in range(5))):
        assert torch.equal(found.tokens, expected.tokens)


# -- faults


def test_busy_answers_and_lost_connections_change_nothing(
    toy_arm, toy_recording, out, whole, proxy, monkeypatch
) -> None:
    monkeypatch.setattr(store, "WAITS_S", (0.0,) * 9)
    draws = random.Random(1)
    failed: list[str] = []

    def sometimes(method: str, path: str, number: int) -> int | str | None:
        if draws.random() > 0.12:
            return None
        what = draws.choice([500, 503, "cut" if method == "GET" else "drop", "drop"])
        failed.append(str(what))
        return what

    proxy.trouble = sometimes
    run(toy_arm, toy_recording, out)
    proxy.trouble = lambda *asked: None
    assert len(failed) >= 5
    assert remote(out) == whole


def test_a_server_that_went_away_is_one_error_and_the_job_goes_on_later(
    toy_arm, toy_recording, out, whole, proxy
) -> None:
    def away(method: str, path: str, number: int) -> str | None:
        done = sum(asked == "PUT" and "shard-" in at for asked, at, _ in proxy.log)
        return "drop" if done > 2 else None

    proxy.trouble = away
    with pytest.raises(
        StorageAwayError, match=r"s3://\S+/shard-\S+ cannot be written: .* run the same command"
    ):
        run(toy_arm, toy_recording, out)
    proxy.trouble = lambda *asked: None
    there = set(out.listing())
    assert "manifest.json" not in there and sum("shard-" in name for name in there) == 2
    assert not [path for path in cache_folder().rglob("*") if path.is_file()]
    assert run(toy_arm, toy_recording, out).kept_shards == 2
    assert remote(out) == whole


def test_a_bucket_that_is_not_there_is_named(toy_arm, toy_recording, proxy) -> None:
    with pytest.raises(StorageError, match="s3://no-such-bucket/set/.plan: cannot be written: .*bucket"):
        run(toy_arm, toy_recording, place("s3://no-such-bucket/set"))
    with pytest.raises(ShardError, match="s3://no-such-bucket/set: is not a folder"):
        ShardSet("s3://no-such-bucket/set")


def test_refused_credentials_are_one_error(toy_arm, toy_recording, out, proxy) -> None:
    proxy.trouble = lambda method, path, number: 403
    with pytest.raises(StorageError, match=f"{out}.* — check the credentials, and what they allow"):
        run(toy_arm, toy_recording, out)
    with pytest.raises(StorageError, match="check the credentials"):
        ShardSet(out)


def test_missing_credentials_are_one_error(proxy, monkeypatch, tmp_path) -> None:
    for name in KEYS:
        monkeypatch.delenv(name)
    for name in ("AWS_CONFIG_FILE", "AWS_SHARED_CREDENTIALS_FILE"):
        monkeypatch.setenv(name, str(tmp_path / "none"))
    fsspec.get_filesystem_class("s3").clear_instance_cache()
    with pytest.raises(StorageError, match="NoCredentialsError.* — give credentials"):
        ShardSet("s3://some-bucket/set")


def test_a_shard_cut_short_is_an_error_and_no_hang(toy_arm, toy_recording, out, tmp_path) -> None:
    run(toy_arm, toy_recording, out)
    name = ShardSet(out).manifest.shards[0].path
    (tmp_path / "cut").write_bytes((out / name).read_bytes()[:-100])
    put_file(tmp_path / "cut", out / name)
    for cache in (True, False):
        with pytest.raises(HMAError, match=name):
            ShardSet(out, cache=cache).read(name, [0], ["action"])
    assert any("the manifest says" in problem for problem in verify(out))


# -- kills

COMMAND = f"""
import os, sys, time
from pathlib import Path
from hma_data.conversion import worker as shard_work
import hma_data.conversion.job
from hma_data.storage.remote import place
from hma_data.registry.embodiment import Embodiment
from hma_data.conversion.plan import Settings
from hma_data.sources.hdf5.source import Hdf5Source
from tests.conftest import BlockTokenizer

read = Hdf5Source.read
def slowly(self, uri, episode_id, embodiment):
    time.sleep(0.1)
    if "STOP_AT" in os.environ:  # so many shards: whoever wants to kill the job then is never too late
        if sum("shard-" in name for name in place(sys.argv[2]).listing()) >= int(os.environ["STOP_AT"]):
            time.sleep(600)
    return read(self, uri, episode_id, embodiment)
Hdf5Source.read = slowly
shard_work.get_tokenizer = lambda *a, **k: BlockTokenizer()
hma_data.conversion.job.get_tokenizer = shard_work.get_tokenizer
hma_data.conversion.job.get_spec = lambda *a, **k: BlockTokenizer().spec
if __name__ == "__main__":
    hma_data.conversion.job.convert(
        Embodiment.from_yaml({ARM_YAML!r}), sys.argv[1], "block", Path(sys.argv[2]),
        workers=int(sys.argv[3]), settings=Settings(val_fraction=0.2, shard_frames=60, seed=int(sys.argv[4])),
    )
"""


def job(
    folder: Path, recording: Path, out: RemotePath, workers: int, seed: int = 0, **more: str
) -> subprocess.Popen:
    script = folder / "job.py"
    script.write_text(COMMAND)
    return subprocess.Popen(
        [sys.executable, str(script), str(recording), str(out), str(workers), str(seed)],
        env={**os.environ, "PYTHONPATH": str(ROOT), **more},
        cwd=ROOT,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


@pytest.mark.slow
def test_a_killed_job_is_continued_by_the_same_command(toy_recording, out, whole, proxy, tmp_path) -> None:
    for wanted in (1, 3):
        process = job(tmp_path, toy_recording, out, workers=0, STOP_AT=str(wanted))
        while process.poll() is None:
            if sum("shard-" in name for name in out.listing()) >= wanted:
                process.send_signal(signal.SIGKILL)
            time.sleep(0.02)
        process.communicate()
        assert process.returncode == -signal.SIGKILL
    assert (out / ".plan").is_file()
    process = job(tmp_path, toy_recording, out, workers=0)
    _, errors = process.communicate(timeout=100)
    assert process.returncode == 0, errors
    assert remote(out) == whole
    assert not list(cache_folder().rglob("*.part"))


@pytest.mark.slow
def test_two_equal_jobs_at_once_on_one_output_only_waste_work(toy_recording, out, whole, tmp_path) -> None:
    jobs = [job(tmp_path, toy_recording, out, workers=0) for _ in range(2)]
    said = [process.communicate(timeout=100)[1] for process in jobs]
    assert [process.returncode for process in jobs] == [0, 0], said
    assert remote(out) == whole


@pytest.mark.slow
def test_of_two_jobs_of_different_plans_at_once_one_is_refused(
    toy_arm, toy_recording, out, whole, tmp_path
) -> None:
    convert(
        toy_arm,
        str(toy_recording),
        BlockTokenizer(),
        tmp_path / "other",
        settings=replace(SMALL, seed=3),
    )
    jobs = {seed: job(tmp_path, toy_recording, out, 0, seed) for seed in (0, 3)}
    said = {seed: process.communicate(timeout=100)[1] for seed, process in jobs.items()}
    (winner,) = (seed for seed, process in jobs.items() if process.returncode == 0)
    loser = 3 - winner
    assert jobs[loser].returncode == 1
    assert "OutputError" in said[loser] and "different: settings" in said[loser], said[loser]
    assert remote(out) == {0: whole, 3: local(tmp_path / "other")}[winner]
    assert verify(out) == []


@pytest.mark.slow
def test_a_job_of_another_plan_is_refused_at_its_start(toy_arm, toy_recording, out, whole, tmp_path) -> None:
    first = job(tmp_path, toy_recording, out, workers=0)
    while first.poll() is None and not (out / ".plan").is_file():
        time.sleep(0.01)
    with pytest.raises(OutputError, match="different: settings"):
        convert(toy_arm, str(toy_recording), BlockTokenizer(), out, settings=replace(SMALL, seed=3))
    _, errors = first.communicate(timeout=100)
    assert first.returncode == 0, errors
    assert remote(out) == whole


def test_a_claim_whose_answer_was_lost_is_ones_own(toy_arm, toy_recording, out, whole, proxy) -> None:
    lost = []

    def lose_first(method: str, path: str, number: int) -> str | None:
        if method == "PUT" and path.endswith("/.plan") and not lost:
            lost.append(path)
            return "lost"
        return None

    proxy.trouble = lose_first
    run(toy_arm, toy_recording, out)
    assert lost and remote(out) == whole


@pytest.mark.slow
def test_workers_of_their_own_put_shards_too(toy_recording, out, whole, tmp_path) -> None:
    process = job(tmp_path, toy_recording, out, workers=2)
    _, errors = process.communicate(timeout=200)
    assert process.returncode == 0, errors
    assert remote(out) == whole
