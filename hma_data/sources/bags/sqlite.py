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

from hma_data.sources.bags.container import Channel, Data, Place, Record, damaged, reading

MAGIC = b"SQLite format 3\x00"


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

    def records(self, topics: frozenset[str] | None = None) -> Iterator[Record]:
        """See Container."""
        with reading(self.path), closing(self._open()) as base:
            channels = self._channels(base)
            wanted = [i for i, channel in channels.items() if topics is None or channel.topic in topics]
            query = "SELECT id, topic_id, timestamp, data FROM messages"
            if topics is not None:
                query += f" WHERE topic_id IN ({', '.join('?' * len(wanted))})"
            rows = base.execute(query + " ORDER BY id", wanted if topics is not None else ())
            for row_id, topic_id, log_ns, data in rows:
                if not isinstance(log_ns, int) or not isinstance(data, bytes):
                    raise ValueError(f"message {row_id} has no time or no data")
                yield Record(self._channel(channels, topic_id), log_ns, data, (0, row_id))

    def payloads(self, places: Sequence[Place]) -> Iterator[Data]:
        """See Container."""
        with reading(self.path), closing(self._open()) as base:
            for _, row_id in places:
                (data,) = base.execute("SELECT data FROM messages WHERE id = ?", (row_id,)).fetchone()
                yield data

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
            schema_encoding, schema = definitions.get(kind, ("", ""))
            channels[topic_id] = Channel(
                str(topic), str(kind), str(encoding), str(schema_encoding), str(schema).encode()
            )
        return channels

    def _channel(self, channels: dict[int, Channel], topic_id: Any) -> Channel:
        if topic_id not in channels:
            raise ValueError(f"a message is of topic {topic_id}, which is not declared")
        return channels[topic_id]
