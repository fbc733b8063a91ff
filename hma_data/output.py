"""The folder a conversion writes: locked while it runs, never mixed with anything else."""

import errno
import fcntl
import json
import os
import shutil
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager, suppress
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from hma_data.errors import OutputError
from hma_data.extend import hashes, ways
from hma_data.files import PART, file_sha256, remove_parts
from hma_data.plan import Plan, differences
from hma_data.shards.manifest import EMBODIMENT, EPISODES, MANIFEST, QUARANTINE, Manifest
from hma_data.shards.schema import read_footer

LOCK, JOURNAL = ".lock", ".journal"
OURS = {"train", "val", MANIFEST, EPISODES, EMBODIMENT, QUARANTINE}


@dataclass(frozen=True)
class Share:
    """This job does every `count`-th shard from `index` on; others, on any machine, do the rest."""

    index: int
    count: int

    @property
    def name(self) -> str:
        """For files that each share has of its own."""
        return f"{self.index}-of-{self.count}"


# -- locks


@contextmanager
def locked(out: Path, share: Share | None = None) -> Iterator[None]:
    """Only one job writes a folder, or a share of it; a lock goes with its process, however that ends.

    Raises:
        OutputError: another job is writing, or the folder cannot be written.
    """
    made = not out.exists()
    with ExitStack() as held:
        try:
            out.mkdir(parents=True, exist_ok=True)
            held.enter_context(_lock(out / LOCK, fcntl.LOCK_SH if share else fcntl.LOCK_EX))
            if share:
                held.enter_context(_lock(out / f"{LOCK}-{share.name}", fcntl.LOCK_EX))
        except OSError as fault:
            if fault.errno not in (errno.EACCES, errno.EAGAIN) or not (out / LOCK).exists():
                reason = fault.strerror or str(fault)
                raise OutputError(out, f"cannot be written: {reason}", "choose another --out") from fault
            what = f"share {share.name} of it" if share else "it"
            raise OutputError(
                out, f"another job is writing {what}", "wait for it, or choose another --out"
            ) from fault
        try:
            yield
        finally:
            if made and all(item.name.startswith(LOCK) for item in out.iterdir()):
                shutil.rmtree(out, ignore_errors=True)


@contextmanager
def _lock(path: Path, kind: int) -> Iterator[None]:
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o644)
    try:
        fcntl.flock(handle, kind | fcntl.LOCK_NB)
        if not path.exists():  # its last owner deleted it between our two calls
            raise OSError(errno.EAGAIN, "")
        try:
            yield
        finally:
            if kind == fcntl.LOCK_EX or _nobody_else(handle):
                path.unlink(missing_ok=True)
    finally:
        os.close(handle)


def _nobody_else(handle: int) -> bool:
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except OSError:
        return False
    return True


# -- what is there


def clear(out: Path) -> None:
    """Empty a folder that holds a shard set.

    Raises:
        OutputError: it holds something else.
    """
    _refuse_foreign(out)
    for item in out.iterdir():
        if not item.name.startswith(LOCK):
            shutil.rmtree(item) if item.is_dir() else item.unlink()


def _refuse_foreign(out: Path) -> None:
    foreign = [item.name for item in out.iterdir() if item.name not in OURS and not _working(item.name)]
    if foreign:
        raise OutputError(
            out,
            f"is not a shard set: it holds {', '.join(sorted(foreign)[:3])}",
            "choose an empty or new --out",
        )


def _working(name: str) -> bool:
    return name.endswith(PART) or name.startswith((LOCK, JOURNAL))


def base_manifest(out: Path) -> Manifest | None:
    """The manifest of the set that is there, when there is one."""
    _refuse_foreign(out)
    return Manifest.load(out) if (out / MANIFEST).is_file() else None


def finished_shards(out: Path, plan: Plan, base: Manifest | None, shared: bool) -> set[str]:
    """Names of the plan's shards that are there and whole.

    Args:
        base: the set the plan extends; its shards belong.
        shared: others may be writing, so what is unfinished is left alone.

    Raises:
        OutputError: the folder holds another conversion's shards, or something else.
    """
    _refuse_foreign(out)
    if not shared:
        remove_parts(out)
    kept = {shard.path for shard in base.shards} if base else set()
    planned = {unit.name for unit in plan.units}
    done: set[str] = set()
    for path in sorted([*out.glob("train/[!.]*"), *out.glob("val/[!.]*")]):
        name = path.relative_to(out).as_posix()
        if name in kept:
            continue
        footer, _ = read_footer(path, str(path))
        if footer.plan["hash"] == plan.facts["hash"] and name in planned:
            done.add(name)
        elif base and footer.plan.get("extends") and hashes(base.plan) & hashes(footer.plan):
            path.unlink()  # of an extension that was not finished, and differs from this one
        else:
            raise _other(out, plan, footer.plan)
    if not done and base is None and (out / MANIFEST).is_file():
        theirs = Manifest.load(out).plan
        if theirs["hash"] != plan.facts["hash"]:
            raise _other(out, plan, theirs)
    return done


def _other(out: Path, plan: Plan, theirs: dict[str, Any]) -> OutputError:
    words = differences(plan.facts, theirs)
    remedy = "choose another --out, or --overwrite to start anew"
    if ways(plan.facts) == ways(theirs):
        remedy = "--extend adds the episodes that are new, --overwrite starts anew"
    return OutputError(out, f"belongs to another conversion; different: {words}", remedy)


# -- the journal


@dataclass(frozen=True)
class Made:
    """A shard that was made: what the manifest needs and the footer cannot hold."""

    name: str
    bytes: int
    sha256: str


class Journal:
    """What this job's shards hash to, so that finishing reads none of them again; lines are only appended."""

    def __init__(self, out: Path, share: Share | None) -> None:
        self._path = out / (f"{JOURNAL}-{share.name}" if share else JOURNAL)

    def add(self, made: Made) -> None:
        """Note a shard."""
        with self._path.open("a", encoding="utf-8") as file:
            file.write(json.dumps(asdict(made)) + "\n")


def known_hashes(out: Path) -> dict[str, str]:
    """Shard -> sha256, of every journal's shards whose size still is what it was; the rest must be read."""
    found: dict[str, str] = {}
    for path in sorted(out.glob(f"{JOURNAL}*")):
        for line in path.read_text(encoding="utf-8").splitlines():
            with suppress(ValueError, TypeError, OSError):  # a line cut short by a kill
                made = Made(**json.loads(line))
                if (out / made.name).stat().st_size == made.bytes:
                    found[made.name] = made.sha256
    return found


def remove_journals(out: Path) -> None:
    """After the manifest is there."""
    for path in out.glob(f"{JOURNAL}*"):
        path.unlink(missing_ok=True)


def made(out: Path, name: str) -> Made:
    """Hash a shard that was just written, while it is in memory."""
    path = out / name
    return Made(name, path.stat().st_size, file_sha256(path))
