"""Bags as a source: ROS 1, ROS 2 (sqlite3, MCAP) and plain MCAP, without ROS.

A bag is an episode; a folder of bags holds many. One pass over the bag gathers times and numbers
of the topics the embodiment names; pictures are read again when asked for, so memory does not grow
with the size of a bag. Streams keep their own clocks; `align` brings them together.
"""

from collections import Counter
from pathlib import Path

from hma_data.embodiment import Embodiment
from hma_data.episode import Episode, Signal, Stream
from hma_data.errors import EpisodeError, SourceError
from hma_data.sources.bags.bag import Bag, find_bags
from hma_data.sources.bags.container import Channel, damaged
from hma_data.sources.bags.fields import Column, Field, missing_topic, parse_key
from hma_data.sources.bags.messages import decode
from hma_data.sources.bags.pictures import picture_kind
from hma_data.sources.bags.report import report
from hma_data.sources.bags.streams import camera_stream
from hma_data.sources.bags.track import Track
from hma_data.sources.base import SAMPLE, EpisodeRef, Inspection, component_values, local_path
from hma_data.spec import Camera, Component


def open() -> "RosbagSource":
    """The source of bags."""
    return RosbagSource()


class RosbagSource:
    """See sources.base.Source."""

    def inspect(self, uri: str, episodes: int = SAMPLE) -> Inspection:
        """See Source."""
        return report(uri, local_path(uri), _bags(uri), episodes)

    def index(self, uri: str, embodiment: Embodiment | None = None) -> list[EpisodeRef]:
        """See Source. A bag that cannot be read has no frames here; `read` says why."""
        root = local_path(uri)
        return [_ref(name, path, root, embodiment) for name, path in _bags(uri).items()]

    def episode_ids(self, uri: str) -> list[str]:
        """See Source."""
        return list(_bags(uri))

    def read(self, uri: str, episode_id: str, embodiment: Embodiment) -> Episode:
        """See Source.

        Raises:
            SourceError: no such bag.
            EpisodeError: the bag is damaged, or lacks what the embodiment names.
        """
        bags = _bags(uri)
        if episode_id not in bags:
            raise SourceError(uri, f"has no bag {episode_id!r}", f"it has {', '.join(list(bags)[:10])}")
        return _Reading(Bag(bags[episode_id], local_path(uri)), episode_id, embodiment).episode()


def _bags(uri: str) -> dict[str, Path]:
    bags = find_bags(local_path(uri))
    if not bags:
        raise SourceError(uri, "holds no bags", "expected .bag, .mcap, .db3, or folders with a metadata.yaml")
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


def _frames(counts: Counter[Channel], embodiment: Embodiment | None) -> int:
    """Pictures of the primary camera; without an embodiment, of the camera that has most."""
    topics: Counter[str] = Counter()
    for channel, count in counts.items():
        if embodiment or picture_kind(channel.type):
            topics[channel.topic] += count
    return topics[embodiment.primary_camera.key] if embodiment else max(topics.values(), default=0)


class _Reading:
    """One pass over one bag for one embodiment."""

    def __init__(self, bag: Bag, episode_id: str, embodiment: Embodiment) -> None:
        self._bag, self._id, self._embodiment = bag, episode_id, embodiment
        self._where = str(bag.path)
        self._counts: Counter[str] = Counter()
        for channel, count in bag.counts().items():
            self._counts[channel.topic] += count
        self._tracks: dict[str, Track] = {}
        self._instruction = ""

    def episode(self) -> Episode:
        """The pass, and what came of it."""
        embodiment = self._embodiment
        for camera in embodiment.cameras:
            if camera.key not in self._counts:
                raise missing_topic(camera.key, self._counts, self._where)
            self._track(camera.key)
        actions = self._columns(embodiment.action.components)
        states = self._columns(embodiment.state.components if embodiment.state else ())
        self._scan(self._instruction_field())
        notes = self._bag.notes()
        return Episode(
            id=self._id,
            streams={camera.name: self._stream(camera) for camera in embodiment.cameras},
            actions=tuple(self._signal(column) for column in actions),
            states=tuple(self._signal(column) for column in states),
            rate_stamped=False,
            instruction=self._instruction or notes.get("instruction", ""),
            success={"true": True, "false": False}.get(notes.get("success", "").lower()),
            source=self._where,
            metadata={"clocks": self._clocks(), "notes": notes},
        )

    def _track(self, topic: str) -> Track:
        return self._tracks.setdefault(topic, Track(topic))

    def _columns(self, components: tuple[Component, ...]) -> list[Column]:
        columns = []
        for component in components:
            field = parse_key(component.key, self._counts, self._where)
            column = Column(component, field, self._where)
            self._track(field.topic).columns.append(column)
            columns.append(column)
        return columns

    def _instruction_field(self) -> Field | None:
        key = self._embodiment.source.instruction
        return parse_key(key, self._counts, self._where) if key else None

    def _scan(self, instruction: Field | None) -> None:
        topics = frozenset(self._tracks) | ({instruction.topic} if instruction else frozenset())
        for place, record in self._bag.records(topics):
            topic = record.channel.topic
            message = decode(record.channel, record.data, self._where)
            if instruction and topic == instruction.topic and not self._instruction:
                self._instruction = str(instruction.value(message, self._where))
            if topic in self._tracks:
                self._tracks[topic].add(record.channel, record.log_ns, place, message)
        for topic, track in self._tracks.items():
            if not len(track):
                raise EpisodeError(self._where, f"{topic} has no messages")
            if len(track) != self._counts[topic]:
                fault = f"its index counts {self._counts[topic]} messages of {topic}, it holds {len(track)}"
                raise damaged(self._bag.path, fault)

    def _signal(self, column: Column) -> Signal:
        track, rows = self._tracks[column.field.topic], column.rows()
        order = track.order(rows)
        clock = column.component.stamp or self._embodiment.sync.stamp
        values = component_values(column.component, column.values()[order], self._where)
        return Signal(track.seconds(clock)[rows[order]], values)

    def _stream(self, camera: Camera) -> Stream:
        clock = camera.stamp or self._embodiment.sync.stamp
        return camera_stream(self._bag, self._tracks[camera.key], clock)

    def _clocks(self) -> dict[str, str]:
        """Topic -> header or receive: whose times it has where none are forced."""
        return {topic: "header" if track.stamped else "receive" for topic, track in self._tracks.items()}
