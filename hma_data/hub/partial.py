"""Name unfinished files after the process that writes them, to recognise those of dead processes."""

import hashlib
import os
import re
import shutil
import time
import uuid
from pathlib import Path

from hma_data.storage.files import PART
from hma_data.storage.remote_lock import Holder, is_running

STALE = 86_400.0  # seconds after which a file of another machine's process counts as abandoned
_NAME = re.compile(r"\.partial-(?:([0-9a-f]{8})-(\d{1,10})-)?[0-9a-f]{12}")


def beside(path: Path) -> Path:
    """Return a name beside a file's, for this process to write to before it renames to the final name."""
    mark = f"{_machine()}-{os.getpid()}-" if _machine() else ""
    return path.with_name(f".{path.name}.partial-{mark}{uuid.uuid4().hex[:12]}")


def is_partial(name: str) -> bool:
    """Check whether a name is one that `beside` gives, or one of an older release."""
    return ".partial-" in name


def is_abandoned(name: str, modified: float | None) -> bool:
    """Check whether a file is abandoned: its process has ended, or it has not changed for a day.

    Args:
        name: with or without its folder.
        modified: Unix seconds; None if the store does not state it.
    """
    found = _NAME.search(name)
    if not found or found.end() != len(name):
        return False
    if found[1] and found[1] == _machine():
        return not is_running(int(found[2]))
    return modified is not None and time.time() - modified > STALE


def remove_abandoned(path: Path) -> None:
    """Delete unfinished versions of a file that dead processes left on this machine."""
    for left in path.parent.glob(f".{path.name}.partial-*"):
        if not left.is_dir() and is_abandoned(left.name, left.lstat().st_mtime):
            left.unlink(missing_ok=True)


def remove_abandoned_folders(root: Path) -> None:
    """Delete temporary folders that dead processes left."""
    for left in root.glob(".*.partial-*"):
        if left.is_dir() and not left.is_symlink() and is_abandoned(left.name, left.stat().st_mtime):
            shutil.rmtree(left, ignore_errors=True)


def remove_dead_parts(path: Path) -> None:
    """Delete the temporary files of `write_atomic` that dead processes of this machine left beside a file."""
    for left in path.parent.glob(f".{path.name}.*{PART}"):
        pid = left.name.removesuffix(PART).rpartition(".")[2]
        if pid.isdecimal() and not is_running(int(pid)):
            left.unlink(missing_ok=True)


def _machine() -> str:
    """Return eight hex digits, the same for all processes that see each other; empty if it cannot be told."""
    machine = Holder.me().machine
    return hashlib.sha256(machine.encode()).hexdigest()[:8] if machine else ""
