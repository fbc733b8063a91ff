"""Replace an embodiment's folder by another in one step, so that no reader sees a mixture of both."""

import ctypes
import os
import shutil
from collections.abc import Mapping
from pathlib import Path

from hma_data.hub.partial import beside, is_partial

_HERE, _EXCHANGE = -100, 2  # AT_FDCWD, RENAME_EXCHANGE of renameat2(2)


def swap_in(root: Path, home: Path, staged: Mapping[str, Path]) -> None:
    """Replace files of an embodiment's folder by staged ones in one step; its other files stay.

    If the folder holds more than plain files, or the file system cannot exchange folders, the files are
    renamed one by one.

    Args:
        root: the hub's folder, in which the new folder is made.
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
    """Exchange two folders in one step; return False if the system or the file system cannot do it."""
    call = getattr(ctypes.CDLL(None, use_errno=True), "renameat2", None)
    if call is None:
        return False
    done: int = call(_HERE, os.fsencode(first), _HERE, os.fsencode(second), ctypes.c_uint(_EXCHANGE))
    return done == 0
