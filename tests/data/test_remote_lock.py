"""The lock in an object store, by which pushes into a hub there keep apart."""

import json
import os
import subprocess
import sys
import threading
import uuid
from dataclasses import asdict, replace
from datetime import timedelta

import pytest

from hma_data.errors import OutputError
from hma_data.storage import remote_lock
from hma_data.storage.remote import RemotePath, place, put_bytes
from hma_data.storage.remote_lock import Holder, RemoteLock

LOCK = ".lock"


@pytest.fixture
def out(monkeypatch: pytest.MonkeyPatch) -> RemotePath:
    monkeypatch.setattr(remote_lock, "SETTLE_S", 0.02)
    path = place(f"memory://{uuid.uuid4().hex}/set")
    assert isinstance(path, RemotePath)
    return path


def holder(**facts: object) -> Holder:
    return replace(Holder.me(), **{"job": "theirs", "host": "far", "machine": "other", "pid": 7, **facts})


def hold(path: RemotePath, who: Holder, age_s: float = 0.0) -> None:
    put_bytes(json.dumps(asdict(who)).encode(), path)
    path.files.store[path.key].modified -= timedelta(seconds=age_s)


def test_another_job_on_one_output_is_told_who_writes(out: RemotePath) -> None:
    hold(out / LOCK, holder())
    said = r"another job is writing it: process 7 on far, since 20\S+ \S+ UTC — wait for it"
    with pytest.raises(OutputError, match=said), RemoteLock(out / LOCK):
        pass
    assert json.loads((out / LOCK).read_bytes())["job"] == "theirs"


def test_a_job_that_was_not_heard_of_for_three_minutes_is_forgotten(out: RemotePath) -> None:
    hold(out / LOCK, holder(), age_s=170)
    with pytest.raises(OutputError, match="another job"), RemoteLock(out / LOCK):
        pass
    hold(out / LOCK, holder(), age_s=181)
    with RemoteLock(out / LOCK):
        assert json.loads((out / LOCK).read_bytes())["pid"] == os.getpid()
    assert out.listing() == {}


def test_a_job_whose_process_on_this_machine_has_ended_is_forgotten_at_once(out: RemotePath) -> None:
    ended = subprocess.Popen([sys.executable, "-c", ""])
    ended.wait()
    hold(out / LOCK, replace(Holder.me(), job="theirs", pid=ended.pid))
    with RemoteLock(out / LOCK):
        pass
    hold(out / LOCK, replace(Holder.me(), job="theirs"))
    with pytest.raises(OutputError, match="another job"), RemoteLock(out / LOCK):
        pass


def test_of_several_that_come_at_once_one_has_it(out: RemotePath, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(remote_lock, "SETTLE_S", 0.2)
    held, start, tried = [], threading.Barrier(4), threading.Barrier(4)

    def one() -> None:
        start.wait()
        try:
            with RemoteLock(out / LOCK):
                held.append(True)
                tried.wait()
        except OutputError:
            tried.wait()

    threads = [threading.Thread(target=one) for _ in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert len(held) == 1


def test_a_lock_is_written_again_until_another_job_has_it(
    out: RemotePath, monkeypatch: pytest.MonkeyPatch
) -> None:
    written, put = threading.Semaphore(0), remote_lock.put_bytes

    def counted(content: bytes, to: RemotePath) -> None:
        put(content, to)
        written.release()

    monkeypatch.setattr(remote_lock, "put_bytes", counted)
    monkeypatch.setattr(remote_lock, "REFRESH_S", 0.01)
    with RemoteLock(out / LOCK):
        for _ in range(3):
            assert written.acquire(timeout=60)
        hold(out / LOCK, holder())
    assert json.loads((out / LOCK).read_bytes())["job"] == "theirs"
