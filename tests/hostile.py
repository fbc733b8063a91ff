"""What a hostile world does: files are cut, changed or replaced, and jobs run at the same time.

Each format has one table of hostile recordings: name -> how it is made, and what the one line says.
"""

import json
import os
import re
import shutil
import tempfile
import threading
from collections.abc import Callable, Iterable, Mapping
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

from hma_data.errors import HMAError
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import open_source

type Edit = Callable[[Path], object]  # what spoils a file or a folder


# -- edits


def cut(size: int) -> Edit:
    """Return an edit that keeps the first bytes of a file, or with -size leaves out the last."""
    return lambda path: path.write_bytes(path.read_bytes()[:size])


def flip(at: int = -5, bits: int = 4) -> Edit:
    """Return an edit that changes bits of one byte."""

    def edit(path: Path) -> None:
        content = bytearray(path.read_bytes())
        content[at] ^= bits
        path.write_bytes(content)

    return edit


def whole(content: bytes | str) -> Edit:
    """Return an edit that gives a file this content."""
    return lambda path: path.write_bytes(content.encode() if isinstance(content, str) else content)


def swap(old: str, new: str) -> Edit:
    """Return an edit that replaces the first occurrence of a text."""
    return lambda path: path.write_text(path.read_text().replace(old, new, 1))


def values(part: str = "", **changes: object) -> Edit:
    """Return an edit that changes keys of a JSON file, or of an object in it."""

    def edit(path: Path) -> None:
        found = json.loads(path.read_text())
        (found[part] if part else found).update(changes)
        path.write_text(json.dumps(found))

    return edit


def linked_away(path: Path) -> None:
    """Move a file out of the recording and leave a link to it."""
    elsewhere = Path(tempfile.mkdtemp()) / path.name
    shutil.move(path, elsewhere)
    path.symlink_to(elsewhere)


class Touch:
    """Make a file when it is unpickled: what a hostile pickle can do."""

    def __init__(self, path: Path | str) -> None:
        self.path = path

    def __reduce__(self) -> tuple[Callable[[str], int], tuple[str]]:
        return os.system, (f"touch '{self.path}'",)


def untouched(path: Path) -> None:
    """Leave a recording as it is: the robot's YAML does not fit it."""


def of(name: str, edit: Edit) -> Edit:
    """Return an edit of one file of a recording, by its path or a pattern that the first one matches."""
    return lambda folder: edit(next(iter(sorted(folder.glob(name))), folder / name))


# -- recordings


type Row = tuple[Edit, str] | tuple[Edit, str, Mapping[str, Any]]  # the edit, the line, what the YAML changes


def check_refused(
    row: Row, recording: Path, robot: Embodiment, out: Path, *, one: bool, inspected: str = ""
) -> None:
    """Convert a hostile recording: it ends in one line that says what is wrong, and nothing is half-written.

    Args:
        row: of a format's table; the pattern of its line holds the place, the fault and the remedy.
        recording: that the row spoils.
        robot: with the changes of the row.
        out: a new folder for shards.
        one: whether one episode goes to quarantine and the others are converted; else none can be used.
        inspected: pattern of what `hma inspect` says of it; empty where it says nothing of its own.
    """
    from hma_data.conversion.job import convert
    from hma_data.shards.verify import verify
    from tests.conftest import BlockTokenizer

    spoil, said = row[:2]
    spoil(recording)
    try:
        convert(robot, str(recording), BlockTokenizer(), out, max_quarantine=1)
    except HMAError as fault:
        line, where = str(fault), str(fault)
        assert not one and not [path for path in out.rglob("*") if path.is_file()], line
    else:
        refused = [json.loads(line) for line in (out / "quarantine.jsonl").read_text().splitlines()]
        assert one and len(refused) == 1 and verify(out) == [], refused
        line, where = refused[0]["message"], refused[0]["uri"]
    assert re.search(said, line), line
    assert str(recording) in where
    assert "\n" not in line and "Traceback" not in line and len(line) < 1000
    if inspected:
        findings = open_source(robot.source.format).inspect(str(recording)).findings
        assert re.search(inspected, " | ".join(map(str, findings)))


def use_all(uri: Path, robot: Embodiment) -> None:
    """Do with a recording whatever a job would do: inspect and index it, and read each episode."""
    open_source(robot.source.format).inspect(str(uri))
    read_all(uri, robot)


def read_all(uri: Path, robot: Embodiment) -> None:
    """Index a recording and read each episode, with its first and last frames."""
    source = open_source(robot.source.format)
    for ref in source.index(str(uri), robot):
        for stream in source.read(str(uri), ref.id, robot).streams.values():
            stream.frames([0, len(stream.timestamps) - 1])


# -- bytes and threads


def damage(data: st.DataObject, path: Path) -> bool:
    """Cut a file at any byte, change that byte or fill it and seven more; return whether it was cut."""
    content = bytearray(path.read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    if cut := data.draw(st.booleans()):
        content = content[:at]
    elif change := data.draw(st.integers(0, 255)):
        content[at] ^= change
    else:
        content[at : at + 8] = b"\xff" * 8
    path.write_bytes(content)
    return cut


def at_once(act: Callable[[Any], object], each: Iterable[Any]) -> None:
    """Do something with each value at the same time, and wait until all have ended."""
    threads = [threading.Thread(target=act, args=(one,)) for one in each]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()


def without_index(bag: bytes) -> bytes:
    """Return a ROS 1 bag as a recorder that was killed leaves it."""
    data = bytearray(bag)
    at = data.index(b"index_pos=") + len(b"index_pos=")
    data = data[: int.from_bytes(data[at : at + 8], "little")]
    data[at : at + 8] = bytes(8)
    return bytes(data)
