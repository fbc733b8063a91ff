"""What a hostile world does: bytes of files are cut or changed anywhere, and jobs run at the same time."""

import threading
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

from hypothesis import strategies as st

type Edit = Callable[[Path], object]  # what spoils a file or a folder


def damage(data: st.DataObject, path: Path) -> bool:
    """Cut a file at any byte, or change any byte of it, as `data` draws it; return whether it was cut."""
    content = bytearray(path.read_bytes())
    at = data.draw(st.integers(0, len(content) - 1))
    if cut := data.draw(st.booleans()):
        content = content[:at]
    else:
        content[at] ^= data.draw(st.integers(1, 255))
    path.write_bytes(content)
    return cut


def flip(at: int, bits: int = 4) -> Edit:
    """Return an edit that changes bits of one byte."""

    def edit(path: Path) -> None:
        content = bytearray(path.read_bytes())
        content[at] ^= bits
        path.write_bytes(content)

    return edit


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
