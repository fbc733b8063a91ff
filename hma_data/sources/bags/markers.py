"""Messages of a bag that begin or end an episode: `source.segments.start` and `stop`.

A message counts by its arrival, or at the moments at which a field becomes a value. Of a service
every call counts once, whichever of its events were recorded. M messages of the marker's topic.
"""

from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.errors import EpisodeError
from hma_data.sources.bags.bag import Place
from hma_data.sources.bags.container import FAULTS, Record
from hma_data.sources.bags.fields import Field, parse_key
from hma_data.sources.bags.messages import child, decode, is_list
from hma_data.sources.bags.services import OF_A_CALL, event_type, is_service_event
from hma_data.sources.bags.track import Track
from hma_data.spec import Marker

SHOWN = 8  # values in an error


class MarkerTrack:
    """A marker's topic over one pass.

    Attributes:
        track: times of the messages, as they lie in the file.

    Raises:
        EpisodeError: the bag has no such topic.
    """

    def __init__(self, marker: Marker, topics: list[str], where: str) -> None:
        self.marker, self._where = marker, where
        self._field = parse_key(marker.key, topics, where)
        self.track = Track(self._field.topic)
        self._kinds = bytearray()  # of each message: whether it fits, or which event of a call it is
        self._service = False
        self._seen: dict[str, None] = {}

    def add(self, place: Place, record: Record) -> None:
        """Takes the next message of the topic."""
        self._service = self._service or is_service_event(record.channel)
        message = None
        if self.marker.equals is not None:
            message = decode(record.channel, record.data, self._where)
            self._kinds.append(self._fits(message))
        elif self._service:
            self._kinds.append(self._event(record))
        else:
            self._kinds.append(True)
            message = self._decoded(record)
        self.track.add(record.channel, record.log_ns, place, message)

    def moments(self) -> NDArray[np.int64]:
        """Indices of the messages that count, in order of receipt."""
        order = self.track.order()
        kinds = np.frombuffer(self._kinds, np.uint8)[order]
        if self.marker.equals is not None:
            becomes = (kinds == 1) & (np.concatenate([[0], kinds[:-1]]) != 1)
            return order[becomes]
        if self._service and len(kinds):
            return order[kinds == next(kind for kind in OF_A_CALL if kind in kinds)]
        return order

    def never(self) -> str:
        """That the marker did not come, with what did."""
        if self.marker.equals is None:
            return f"{self.marker.key} never comes"
        known = f"it is {', '.join(list(self._seen)[:SHOWN])}" if self._seen else "it has no messages"
        return f"{self.marker.key} never becomes {self.marker.equals!r}, {known}"

    def _event(self, record: Record) -> int:
        try:
            return event_type(record.data)
        except ValueError as fault:
            raise EpisodeError(self._where, f"{self._field.topic}: {fault}") from fault

    def _decoded(self, record: Record) -> Any:
        """The message for its stamp; a marker that only has to come need not be understood."""
        try:
            return decode(record.channel, record.data, self._where)
        except EpisodeError:
            return None

    def _fits(self, message: Any) -> bool:
        value = self._value(message)
        if value is None:
            return False
        if len(self._seen) < SHOWN:
            self._seen[str(value)] = None
        wanted = self.marker.equals
        if isinstance(wanted, str) or isinstance(value, str):
            if not (isinstance(wanted, str) and isinstance(value, str)):
                raise EpisodeError(
                    self._where,
                    f"{self.marker.key} is {value!r}, which cannot equal {wanted!r}",
                    "mend equals",
                )
            return value == wanted
        return self._number(value) == float(wanted or 0)

    def _number(self, value: Any) -> float:
        try:
            return float(value)
        except (*FAULTS, TypeError) as fault:
            raise EpisodeError(
                self._where, f"{self.marker.key} is no single value", "name one field of it"
            ) from fault

    def _value(self, message: Any) -> Any:
        """What is at the key; None in an event of a service that holds no request or no response."""
        field = self._field
        if self._service and field.steps and field.steps[0] in ("request", "response"):
            held = child(message, str(field.steps[0]))
            if is_list(held) and not len(held):
                return None
            if is_list(held) and (len(field.steps) < 2 or isinstance(field.steps[1], str)):
                field = Field(field.key, field.topic, (field.steps[0], 0, *field.steps[1:]))
        return field.value(message, self._where)
