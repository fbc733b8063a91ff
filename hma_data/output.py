"""The folder a conversion writes: locked while it runs, never mixed with anything else."""

import errno
import fcntl
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from hma_data.errors import OutputError
from hma_data.files import remove_parts
from hma_data.plan import Plan, differences
from hma_data.shards.manifest import EPISODES, MANIFEST, Manifest
from hma_data.shards.schema import read_footer

LOCK = ".lock"


@contextmanager
def locked(out: Path) -> Iterator[None]:
    """Only one job writes a folder; the lock goes with the process, however it ends."""
    made = not out.exists()
    try:
        out.mkdir(parents=True, exist_ok=True)
        handle = os.open(out / LOCK, os.O_RDWR | os.O_CREAT, 0o644)
    except OSError as fault:
        raise OutputError(out, f"cannot be written: {fault.strerror}", "choose another --out") from fault
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        if not (out / LOCK).exists():  # its last owner deleted it between our two calls
            raise OSError(errno.EAGAIN, "")
    except OSError as fault:
        os.close(handle)
        if fault.errno not in (errno.EACCES, errno.EAGAIN):
            raise
        raise OutputError(
            out, "is being written by another job", "wait for it, or choose another --out"
        ) from fault
    try:
        yield
    finally:
        (out / LOCK).unlink(missing_ok=True)
        os.close(handle)
        if made and not any(out.iterdir()):
            out.rmdir()


def clear(out: Path) -> None:
    """Empty a folder that holds a shard set.

    Raises:
        OutputError: it holds something else.
    """
    _refuse_foreign(out)
    for item in out.iterdir():
        if item.name != LOCK:
            shutil.rmtree(item) if item.is_dir() else item.unlink()


OURS = {"train", "val", MANIFEST, EPISODES, "embodiment.yaml", "quarantine.jsonl", LOCK}


def _refuse_foreign(out: Path) -> None:
    foreign = [
        item.name for item in out.iterdir() if item.name not in OURS and not item.name.endswith(".part")
    ]
    if foreign:
        raise OutputError(
            out,
            f"is not a shard set: it holds {', '.join(sorted(foreign)[:3])}",
            "choose an empty or new --out",
        )


def finished_shards(out: Path, plan: Plan) -> set[str]:
    """Names of the plan's shards that are there and whole.

    Raises:
        OutputError: the folder holds another conversion's shards, or something else.
    """
    _refuse_foreign(out)
    remove_parts(out)
    done: set[str] = set()
    planned = {unit.name for unit in plan.units}
    for path in sorted([*out.glob("train/*"), *out.glob("val/*")]):
        name = path.relative_to(out).as_posix()
        footer, _ = read_footer(path, str(path))
        if footer.plan["hash"] != plan.facts["hash"] or name not in planned:
            raise OutputError(
                out,
                f"belongs to another conversion; different: {differences(plan.facts, footer.plan)}",
                "choose another --out, or --overwrite to start anew",
            )
        done.add(name)
    if not done and (out / MANIFEST).is_file():
        theirs = Manifest.load(out).plan
        if theirs["hash"] != plan.facts["hash"]:
            raise OutputError(
                out,
                f"belongs to another conversion; different: {differences(plan.facts, theirs)}",
                "choose another --out, or --overwrite to start anew",
            )
    return done
