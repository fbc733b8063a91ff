"""Let only one job write a folder at a time."""

import fcntl
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

from hma_data.errors import OutputError
from hma_data.storage.remote import RemotePath

LOCK = ".lock"


@contextmanager
def locked(out: Path, share: str = "") -> Iterator[None]:
    """Let only one job write a folder, or a share of it; the kernel releases the lock when the process ends.

    A store has no such lock. There, jobs of one plan write the same bytes, and a conversion refuses another
    plan.

    Args:
        out: the folder; it is made, and removed again if the job writes nothing. The job may delete it.
        share: name of the part that this job writes; jobs of other parts may write at the same time.
    """
    if isinstance(out, RemotePath):
        if out.scheme == "hf":
            remedy = "write a folder, then upload it"
            raise OutputError(out, "is a repository of the hub, which takes whole conversions only", remedy)
        yield
        return
    with ExitStack() as held:
        try:
            made = not out.exists()
            out.mkdir(parents=True, exist_ok=True)
            # A share holds the folder's lock with the others, and its own alone.
            held.enter_context(_lock(out / LOCK, fcntl.LOCK_SH if share else fcntl.LOCK_EX))
            if share:
                held.enter_context(_lock(out / f"{LOCK}-{share}", fcntl.LOCK_EX))
        except BlockingIOError as fault:
            what = f"share {share} of it" if share else "it"
            remedy = "wait for it, or choose another --out"
            raise OutputError(out, f"another job is writing {what}", remedy) from fault
        except OSError as fault:
            reason = fault.strerror or str(fault)
            raise OutputError(out, f"cannot be written: {reason}", "choose another --out") from fault
        try:
            yield
        finally:
            if made and out.is_dir() and all(item.name.startswith(LOCK) for item in out.iterdir()):
                shutil.rmtree(out, ignore_errors=True)


@contextmanager
def _lock(path: Path, kind: int) -> Iterator[None]:
    with path.open("a") as file:
        fcntl.flock(file, kind | fcntl.LOCK_NB)
        if not path.exists():  # its last owner deleted it between the two calls above
            raise BlockingIOError
        try:
            yield
        finally:
            if kind == fcntl.LOCK_EX:
                path.unlink(missing_ok=True)
