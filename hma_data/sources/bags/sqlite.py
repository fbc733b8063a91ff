"""ROS 2 bags in sqlite3 (.db3), every version of rosbag2's tables.

Opened read-only; nothing is written beside the file. Definitions of the messages are inside the
file since ROS 2 Iron; before it only their names are.
"""

import sqlite3
from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any
from urllib.parse import quote

from hma_data.sources.bags.container import (
    HEAD,
    Channel,
    Data,
    Place,
    Record,
    Wanted,
    damaged,
    reading,
)
from hma_data.sources.bags.pieces import take_last

MAGIC = b"SQLite format 3\x00"
LATEST = 2**63 - 1  # of an sqlite3 integer


class SqliteFile:
    """One .db3 file; see Container."""

    def __init__(self, path: Path) -> None:
        self.path = path

    def counts(self) -> Counter[Channel]:
        """See Container."""
        with reading(self.path), closing(self._open()) as base:
            channels = self._channels(base)
            total: Counter[Channel] = Counter(dict.fromkeys(channels.values(), 0))
            for topic_id, count in base.execute("SELECT topic_id, count(*) FROM messages GROUP BY topic_id"):
                total[self._channel(channels, topic_id)] += count
        return total

    def records(self, wanted: Wanted) -> Iterator[Record]:
        """See Container."""
        with reading(self.path), closing(self._open()) as base:
            channels = self._channels(base)
            for row_id, topic_id, log_ns in self._rows(base, channels, wanted):
                channel = self._channel(channels, topic_id)
                data = self._data(base, row_id, HEAD if channel.topic in wanted.heads else None)
                if not isinstance(log_ns, int):
                    raise ValueError(f"message {row_id} has no time")
                yield Record(channel, log_ns, data, (0, row_id))

    def before(self, topics: frozenset[str], log_ns: int) -> dict[str, Record]:
        """See Container."""
        found: dict[str, Record] = {}
        query = (
            "SELECT id, topic_id, timestamp FROM messages WHERE timestamp < ? AND topic_id = ? "
            "ORDER BY timestamp DESC, id DESC LIMIT 1"
        )
        with reading(self.path), closing(self._open()) as base:
            for topic_id, channel in self._channels(base).items():
                rows = base.execute(query, (min(log_ns, LATEST), topic_id)) if channel.topic in topics else ()
                take_last(
                    found,
                    (Record(channel, at, self._data(base, row, None), (0, row)) for row, _, at in rows),
                )
        return found

    def _rows(
        self, base: sqlite3.Connection, channels: dict[int, Channel], wanted: Wanted
    ) -> Iterator[tuple[int, int, Any]]:
        """id, topic and time of the wanted messages; data is left out, for sorting would gather it."""
        ids = [number for number, channel in channels.items() if wanted.topic(channel.topic)]
        conditions, values = [], []
        if wanted.topics is not None:
            conditions.append(f"topic_id IN ({', '.join('?' * len(ids))})")
            values += ids
        if wanted.bounded:
            conditions.append("timestamp BETWEEN ? AND ?")
            values += [wanted.first_ns, min(wanted.last_ns, LATEST)]
        where = f" WHERE {' AND '.join(conditions)}" if conditions else ""
        return base.execute(f"SELECT id, topic_id, timestamp FROM messages{where} ORDER BY id", values)

    def _data(self, base: sqlite3.Connection, row_id: int, limit: int | None) -> bytes:
        """A message's bytes, or the first of them, without reading the others."""
        if limit is None:
            return self._payload(base, row_id)
        with base.blobopen("messages", "data", row_id, readonly=True) as blob:
            return blob.read(limit)

    def _payload(self, base: sqlite3.Connection, row_id: int) -> bytes:
        (data,) = base.execute("SELECT data FROM messages WHERE id = ?", (row_id,)).fetchone() or (None,)
        if not isinstance(data, bytes):
            raise ValueError(f"message {row_id} has no data")
        return data

    def payloads(self, places: Sequence[Place]) -> Iterator[Data]:
        """See Container."""
        with reading(self.path), closing(self._open()) as base:
            for _, row_id in places:
                yield self._payload(base, row_id)

    def _open(self) -> sqlite3.Connection:
        """A connection that writes nothing, not even a lock, unless there is a log still to be read."""
        self._check_size()
        log = self.path.with_name(self.path.name + "-wal")
        pending = log.is_file() and log.stat().st_size > 0
        place = f"file:{quote(str(self.path))}?mode=ro" + ("" if pending else "&immutable=1")
        return sqlite3.connect(place, uri=True)

    def _check_size(self) -> None:
        """sqlite3 notices a missing end only where it happens to read it."""
        with self.path.open("rb") as file:
            head = file.read(100)
            size = file.seek(0, 2)
        if not head.startswith(MAGIC):
            raise damaged(self.path, "does not begin as an sqlite3 file does" if head else "is empty")
        page = int.from_bytes(head[16:18], "big")
        page = 65536 if page == 1 else page
        pages = int.from_bytes(head[28:32], "big")
        if head[24:28] == head[92:96] and size < page * pages:
            raise damaged(self.path, f"is cut off: it has {size:,} of {page * pages:,} bytes")

    def _channels(self, base: sqlite3.Connection) -> dict[int, Channel]:
        tables = {name for (name,) in base.execute("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            raise damaged(self.path, "is an sqlite3 file without rosbag2's tables topics and messages")
        definitions: dict[str, tuple[Any, Any]] = {}
        if "message_definitions" in tables:
            query = "SELECT topic_type, encoding, encoded_message_definition FROM message_definitions"
            definitions = {name: (kind, text) for name, kind, text in base.execute(query)}
        channels = {}
        for topic_id, topic, kind, encoding in base.execute(
            "SELECT id, name, type, serialization_format FROM topics ORDER BY id"
        ):
            service = str(kind).removesuffix(
                "_Event"
            )  # rosbag2 keeps the definition of a service's events there
            schema_encoding, schema = definitions.get(kind) or definitions.get(service) or ("", "")
            channels[topic_id] = Channel(
                str(topic), str(kind), str(encoding), str(schema_encoding), str(schema).encode()
            )
        return channels

    def _channel(self, channels: dict[int, Channel], topic_id: Any) -> Channel:
        if topic_id not in channels:
            raise ValueError(f"a message is of topic {topic_id}, which is not declared")
        return channels[topic_id]
