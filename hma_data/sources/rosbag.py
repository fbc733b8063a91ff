"""Bags as a source: ROS 1, ROS 2 (sqlite3, MCAP) and plain MCAP, without ROS.

A bag is an episode, or with `source.segments` several; a folder of bags holds many. One pass over
an episode gathers times and numbers of the topics the embodiment names; pictures are read again when
asked for, so memory does not grow with the size of a bag. Streams keep their own clocks; `align`
brings them together.
"""

import re
from collections import Counter
from dataclasses import replace
from pathlib import Path

from hma_data.embodiment import Embodiment
from hma_data.episode import Episode
from hma_data.errors import EpisodeError, SourceError
from hma_data.paths import StrPath, as_text
from hma_data.sources.bags.bag import Bag, find_bags
from hma_data.sources.bags.container import Channel
from hma_data.sources.bags.opened import parted
from hma_data.sources.bags.pictures import picture_kind
from hma_data.sources.bags.reading import Reading
from hma_data.sources.bags.report import report
from hma_data.sources.base import SAMPLE, EpisodeRef, Inspection, local_path
from hma_data.sources.links import nothing_there
from hma_data.spec import Segments

PART = re.compile(r"[0-9]{4,9}")


def open() -> "RosbagSource":
    """The source of bags."""
    return RosbagSource()


class RosbagSource:
    """See sources.base.Source."""

    def inspect(self, uri: StrPath, episodes: int = SAMPLE) -> Inspection:
        """See Source."""
        uri = as_text(uri)
        return report(uri, local_path(uri), _bags(uri), episodes)

    def index(self, uri: StrPath, embodiment: Embodiment | None = None) -> list[EpisodeRef]:
        """See Source. A bag that cannot be read has no frames here; `read` says why.

        With an embodiment that parts bags, an episode of the bag `run` is `run/0000`, `run/0001` …
        """
        uri = as_text(uri)
        root = local_path(uri)
        found: list[EpisodeRef] = []
        for name, path in _bags(uri).items():
            if embodiment and embodiment.source.segments:
                found += _part_refs(name, path, root, embodiment, embodiment.source.segments)
            else:
                found.append(_ref(name, path, root, embodiment))
        return found

    def episode_ids(self, uri: StrPath) -> list[str]:
        """See Source: whole bags, whatever an embodiment may part them into."""
        return list(_bags(as_text(uri)))

    def read(self, uri: StrPath, episode_id: str, embodiment: Embodiment) -> Episode:
        """See Source. A bag's own id reads the whole of it, also where the embodiment parts bags.

        Raises:
            SourceError: no such bag, or no such episode in it.
            EpisodeError: the bag is damaged, holds no episode, or lacks what the embodiment names.
        """
        uri = as_text(uri)
        bags, root, segments = _bags(uri), local_path(uri), embodiment.source.segments
        if episode_id in bags:
            path = bags[episode_id]
            bag = parted(path, root, embodiment, segments)[0] if segments else Bag(path, root)
            return Reading(bag, episode_id, embodiment).episode()
        name, number = _part_of(episode_id)
        if not segments or name not in bags:
            raise SourceError(uri, f"has no bag {episode_id!r}", f"it has {', '.join(list(bags)[:10])}")
        bag, table = parted(bags[name], root, embodiment, segments)
        if not 0 <= number < len(table.segments):
            held = f"{name} holds {_part_id(name, 0)} to {_part_id(name, len(table.segments) - 1)}"
            raise SourceError(uri, f"has no episode {episode_id!r}", held)
        return Reading(bag, episode_id, embodiment, table, number).episode()


def _bags(uri: str) -> dict[str, Path]:
    path = local_path(uri)
    if path.is_file() and path.name == "metadata.yaml":
        raise SourceError(uri, "only describes a bag", f"give the bag's folder, {path.parent}")
    bags = find_bags(path)
    if not bags:
        remedy = "expected .bag, .mcap, .db3, or folders with a metadata.yaml"
        raise nothing_there(uri, path, "holds no bags", remedy)
    return bags


def _ref(name: str, path: Path, root: Path, embodiment: Embodiment | None) -> EpisodeRef:
    frames, fingerprint = 0, ""
    try:
        bag = Bag(path, root)
        fingerprint = bag.fingerprint()
        frames = _frames(bag.counts(), embodiment)
    except (EpisodeError, OSError):
        pass  # `read` meets it again and says what it is
    return EpisodeRef(name, frames, fingerprint=fingerprint)


def _part_id(name: str, number: int) -> str:
    return f"{name}/{number:04d}"


def _part_of(episode_id: str) -> tuple[str, int]:
    """The bag of that episode, and its number; -1 where it names none."""
    name, _, digits = episode_id.rpartition("/")
    return name, int(digits) if PART.fullmatch(digits) else -1


def _part_refs(
    name: str, path: Path, root: Path, embodiment: Embodiment, segments: Segments
) -> list[EpisodeRef]:
    """The episodes of one bag; one without frames where none can be told, of which `read` says why."""
    try:
        bag, table = parted(path, root, embodiment, segments)
        fingerprint = bag.fingerprint()
    except (EpisodeError, OSError):
        return [replace(_ref(name, path, root, embodiment), frames=0)]
    return [
        EpisodeRef(_part_id(name, i), len(segment), None, fingerprint, group=name, left_out=table.left_out)
        for i, segment in enumerate(table.segments)
    ]


def _frames(counts: Counter[Channel], embodiment: Embodiment | None) -> int:
    """Pictures of the primary camera; without an embodiment, of the camera that has most."""
    topics: Counter[str] = Counter()
    for channel, count in counts.items():
        if embodiment or picture_kind(channel.type):
            topics[channel.topic] += count
    return topics[embodiment.primary_camera.key] if embodiment else max(topics.values(), default=0)
