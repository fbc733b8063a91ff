"""Lock a place in an object store by an object that names the holder.

Stores have no locks of their own. The holder writes its name again every half minute. A holder counts as gone
when its object is older than three minutes by the store's own clock, or when its process on this machine has
ended. Where two jobs come at once, a store that can (S3, GCS) lets only one of them write; in any case, the
job whose name is read back after a short wait holds the lock.
"""

import json
import logging
import os
import platform
import threading
import time
import uuid
from contextlib import suppress
from dataclasses import asdict, dataclass, replace
from datetime import UTC, datetime
from pathlib import Path
from types import TracebackType

from hma_data.errors import HMAError, OutputError, StorageAwayError
from hma_data.storage.files import is_running
from hma_data.storage.remote import RemotePath, create_bytes, put_bytes

REFRESH_S, STALE_S, SETTLE_S = 30.0, 180.0, 2.0
PROBE = ".lock-clock-"  # begins the names of objects that only show the store's time

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Holder:
    """The holder of a lock.

    Attributes:
        job: an id, new each time a lock is taken.
        host, pid: the machine and the process.
        machine: distinguishes machines (and containers) of one name.
        since, time: when the lock was taken and when it was last written, in Unix seconds.
    """

    job: str
    host: str
    pid: int
    machine: str
    since: float
    time: float

    @classmethod
    def me(cls) -> "Holder":
        """Return a holder for this process, with the time now."""
        now = time.time()
        return cls(uuid.uuid4().hex, platform.node(), os.getpid(), _machine(), now, now)

    def __str__(self) -> str:
        when = datetime.fromtimestamp(self.since, UTC).strftime("%Y-%m-%d %H:%M:%S UTC")
        return f"process {self.pid} on {self.host or 'a host without name'}, since {when}"


class RemoteLock:
    """A context manager that takes the lock, renews it, and releases it.

    Raises:
        OutputError: another job holds it.
    """

    def __init__(self, path: RemotePath, what: str = "it") -> None:
        self._path, self._what = path, what
        self._me = Holder.me()
        self._ended = threading.Event()
        self._taken = False
        self._written = 0.0
        self._thread = threading.Thread(target=self._keep, name="hma-lock", daemon=True)

    def __enter__(self) -> "RemoteLock":
        held = living_holder(self._path)
        if held:
            raise held_by(self._path, held, self._what)
        if not create_bytes(self._content(), self._path):  # another job came first, or a dead job's is left
            held = living_holder(self._path)
            if held and held.job != self._me.job:
                raise held_by(self._path, held, self._what)
            self._write()
        self._written = time.monotonic()
        time.sleep(SETTLE_S)
        read = _read(self._path)
        if read is None or read.job != self._me.job:
            raise held_by(self._path, read or self._me, self._what)
        self._thread.start()
        return self

    def __exit__(
        self, kind: type[BaseException] | None, fault: BaseException | None, trace: TracebackType | None
    ) -> None:
        self._ended.set()
        self._thread.join()
        with suppress(Exception):  # the work is done; the lock expires by itself
            if isinstance(fault, StorageAwayError):  # one try only: the store has been waited for long enough
                if not self._taken and time.monotonic() - self._written < STALE_S:
                    self._path.files.rm_file(self._path.key)
                return
            read = _read(self._path)
            if read and read.job == self._me.job:
                self._path.unlink(missing_ok=True)

    def _content(self) -> bytes:
        return json.dumps(asdict(replace(self._me, time=time.time()))).encode()

    def _write(self) -> None:
        put_bytes(self._content(), self._path)
        self._written = time.monotonic()

    def _renew(self) -> None:
        read = _read(self._path)
        if read and read.job != self._me.job:
            self._taken = True
        else:
            self._write()

    def _keep(self) -> None:
        while not self._ended.wait(REFRESH_S) and not self._taken:
            try:
                self._renew()
            except (HMAError, OSError) as fault:  # the next turn may succeed
                log.info("%s: not refreshed: %s", self._path, fault)


def held_by(path: RemotePath, holder: Holder, what: str = "it") -> OutputError:
    """Return the error for a lock that another job holds."""
    remedy = f"wait for it, or choose another --out; a killed job is forgotten after {STALE_S / 60:g} min"
    return OutputError(path.parent, f"another job is writing {what}: {holder}", remedy)


def living_holder(path: RemotePath) -> Holder | None:
    """Return the holder of a lock; None where there is no lock, or its holder is gone."""
    holder = _read(path)
    if holder is None:
        return None
    if holder.machine == _machine() and holder.machine and not is_running(holder.pid):
        return None
    age = _age(path, holder)
    return holder if age is not None and age < STALE_S else None


def _read(path: RemotePath) -> Holder | None:
    try:
        content = path.read_bytes()
    except FileNotFoundError:
        return None
    try:
        values = json.loads(content)
        job, host, machine = (str(values[name]) for name in ("job", "host", "machine"))
        return Holder(job, host, int(values["pid"]), machine, float(values["since"]), float(values["time"]))
    except (ValueError, TypeError, KeyError, OverflowError):
        return Holder("", "unknown", 0, "", 0.0, 0.0)


def _age(path: RemotePath, holder: Holder) -> float | None:
    """Return the seconds since a lock was written, by the store's clock if it has one; None if it is gone."""
    probe = path.with_name(f"{PROBE}{uuid.uuid4().hex}")
    try:
        put_bytes(b"", probe)
        now, then = (path.files.modified(item.key) for item in (probe, path))
        return float((now - then).total_seconds())
    except FileNotFoundError:
        return None
    except (NotImplementedError, TypeError, AttributeError, KeyError):  # a store without times
        return time.time() - holder.time
    finally:
        probe.unlink(missing_ok=True)


def _machine() -> str:
    """Return a text that is equal for processes that can see one another; empty where that is unknown."""
    try:
        boot = Path("/proc/sys/kernel/random/boot_id").read_text(encoding="ascii").strip()
        return f"{boot} {Path('/proc/self/ns/pid').readlink()}"
    except OSError:
        return ""
