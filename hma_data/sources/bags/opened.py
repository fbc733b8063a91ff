"""Bags that were parted into episodes, kept for the next of their episodes.

A few bags stay open to reading (no file does), with what was found out about them; another process,
or a file that changed, begins anew.
"""

import os
from collections import OrderedDict
from pathlib import Path
from typing import Any

from hma_data.embodiment import Embodiment
from hma_data.sources.bags.bag import Bag
from hma_data.sources.bags.segments import Table, part
from hma_data.spec import Segments

KEPT_BAGS = 2
KEPT_TABLES = 512
Key = tuple[Any, ...]

# by process: a child that was forked must not clean up after its parent
_bags: dict[int, OrderedDict[Key, Bag]] = {}
_tables: OrderedDict[Key, Table] = OrderedDict()


def parted(path: Path, root: Path, embodiment: Embodiment, segments: Segments) -> tuple[Bag, Table]:
    """The bag and its episodes.

    Raises:
        EpisodeError: the bag cannot be read, or holds no episode.
    """
    bag = Bag(path, root)
    state = bag.state()
    kept = _bags.setdefault(os.getpid(), OrderedDict())
    bag = kept.pop((path, root, state), bag)
    kept[(path, root, state)] = bag
    cameras = tuple((camera.key, camera.stamp) for camera in embodiment.cameras)
    key = (path, state, segments, cameras, embodiment.primary_camera.name, embodiment.sync.stamp)
    table = _tables.pop(key, None) or part(bag, embodiment, segments)
    _tables[key] = table
    while len(kept) > KEPT_BAGS:
        kept.popitem(last=False)
    while len(_tables) > KEPT_TABLES:
        _tables.popitem(last=False)
    return bag, table
