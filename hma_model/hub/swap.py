"""Replace an embodiment's folder by another in one step, so that no reader ever sees half of each."""

import ctypes
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

from hma_data.hub.partial import beside, is_partial

_HERE, _EXCHANGE = -100, 2  # AT_FDCWD, RENAME_EXCHANGE of renameat2(2)


def swap_in(root: Path, home: Path, staged: Mapping[str, Path]) -> None:
    """Give staged files their names in a folder that has older ones; what is not staged stays.

    Where the folder holds more than files, or the file system cannot do it, they are renamed one by one.

    Args:
        root: of the hub, where the new folder is put together.
        home: the embodiment's folder.
        staged: name -> file on the same file system, the card last.
    """
    new = beside(root / home.name)
    new.mkdir()
    try:
        for name, path in staged.items():
            path.replace(new / name)
        others = [old for old in home.iterdir() if old.name not in staged and not is_partial(old.name)]
        plain = all(old.is_file() and not old.is_symlink() for old in others)
        for old in others if plain else ():
            os.link(old, new / old.name)
        if not plain or not exchange(new, home):
            for name in staged:
                (new / name).replace(home / name)
    finally:
        shutil.rmtree(new, ignore_errors=True)


def exchange(first: Path, second: Path) -> bool:
    """Let two folders change places in one step; False where the system or its file system cannot."""
    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if call is None:
        return False
    done: int = call(_HERE, os.fsencode(first), _HERE, os.fsencode(second), ctypes.c_uint(_EXCHANGE))
    return done == 0
