"""Acts in processes that are killed at one of their file operations.

They are forked from a process of their own without threads and without torch (multiprocessing's forkserver).
"""

import multiprocessing
import os
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import fsspec
import safetensors  # noqa: F401 (a killed push imports it; here once)
from fsspec.implementations.local import LocalFileSystem

from hma_model.hub import publish as hub
from hma_model.hub.datasets import push_data

WRITES = os.O_WRONLY | os.O_RDWR | os.O_CREAT
CHANGES = ("os.rename", "os.link", "os.mkdir", "os.remove", "os.rmdir", "os.truncate")
ACTS = {"push": hub.push, "pull": hub.pull, "push_data": push_data}


class FileStore(LocalFileSystem):
    """A store that keeps files and folders, as one behind SFTP: what is put is there before it is whole."""

    protocol = "filestore"

    @classmethod
    def _strip_protocol(cls, path: Any) -> str:
        text = str(path).removeprefix("filestore://")
        return str(super()._strip_protocol("/" + text.lstrip("/")))


def make_quick(setattr_: Callable[[Any, str, Any], None]) -> None:
    """Make stores known and writes quick, here or in a process to be killed."""
    fsspec.register_implementation("filestore", FileStore, clobber=True)
    setattr_(os, "fsync", lambda handle: None)  # a killed process loses nothing by it
    setattr_(hub, "_require_publishable", lambda *given: None)  # reads only; has tests of its own


def killed(act: str, given: tuple[Any, ...], root: Path, at: int) -> int:
    """Run an act in a process that ends at its operation number `at` in a folder.

    A file that is opened to be written is left empty; all else is left undone.

    Returns:
        How many operations it did: `at`, or fewer where it came to its end.
    """
    context = multiprocessing.get_context("forkserver")
    context.set_forkserver_preload([__name__])
    counted = context.Value("i", 0)
    process = context.Process(
        target=act_until, args=(act, given, str(root), at, counted, os.environ["HMA_CACHE"])
    )
    process.start()
    process.join(60)
    assert process.exitcode == (7 if counted.value > at else 0)
    return min(counted.value, at)


def act_until(act: str, given: tuple[Any, ...], root: str, at: int, counted: Any, cache: str) -> None:
    """Do what `killed` says, in its process."""

    def watch(event: str, about: Any) -> None:
        if event == "open" and not (isinstance(about[2], int) and about[2] & WRITES):
            return
        if event not in ("open", *CHANGES) or not str(about[0]).startswith((root, ".")):
            return
        counted.value += 1
        if counted.value == at + 1:
            if event == "open":
                os.open(about[0], about[2], 0o644)
            os._exit(7)

    os.environ["HMA_CACHE"] = cache
    make_quick(setattr)
    sys.addaudithook(watch)
    ACTS[act](*given)
