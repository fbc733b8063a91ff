"""Order the messages of a topic by one of their clocks, and compare the clocks of topics.

A message has two times: its header stamp, by the clock of the machine that made it, and its time of receipt,
by the clock of the recorder. Messages may arrive in another order than they were made. Either clock may be
set back (NTP), or begin anew (a simulation that is restarted). Sorting repairs the first and spoils the
second: it mixes the messages from before with those from after.

Two topics can be paired only if their times are of one clock. Both clocks of each topic are compared with its
times of receipt, which all topics share.

T messages of a topic in the order of the file; times are int64 nanoseconds, or float64 seconds where named
so.
"""

from dataclasses import dataclass

import numpy as np

from hma_data.arrays import Array, Bools, Floats, Ints
from hma_data.errors import EpisodeError

SECOND_NS = 10**9
MAX_LATE_S = 1.0  # a message that is overtaken by more was not delayed: its clock was set back
ALWAYS_LATE_NS = SECOND_NS // 100  # lateness that threads of a recorder cause
MAX_OVERTAKEN = 3  # messages in a row that may be overtaken by any time, where arrival mixes two runs
CROWDED = 0.75  # of the usual interval: sorted messages closer than this were not made one after the other
CROWDED_SHARE = 0.3  # of such steps beside the messages that sorting moved
AHEAD_S = 0.05  # by which stamps may be later than receipt; more shows a clock ahead of the recorder's
BEHIND_S = 0.1  # of delay between exposure and receipt that cameras and networks cause
DAY_S = 86_400.0


def sorted_by(times: Ints, files: Ints) -> Ints | None:
    """Return the order (T,) of messages by their times; None where the clock was set back.

    Args:
        times: (T,) of one clock, in the order of the files.
        files: (T,) the number of the file of each message. The parts of a recording may be stored in any
            order, so a clock may go back where a file begins.
    """
    latest = np.maximum.accumulate(times)
    behind = latest > times
    order = np.argsort(times, kind="stable")
    if (latest - times).max(initial=0) <= ALWAYS_LATE_NS:
        return order
    for begin, end in _runs(behind):
        lateness = int((latest - times)[begin:end].max())
        new_file = files[begin] != files[begin - 1]
        if lateness > MAX_LATE_S * SECOND_NS and end - begin > MAX_OVERTAKEN and not new_file:
            return None
    return None if _crowded(times, order, behind) else order


def _runs(flags: Bools) -> list[tuple[int, int]]:
    """Return begin and end of each run of True."""
    edges = np.flatnonzero(np.diff(flags.astype(np.int8), prepend=0, append=0))
    return list(zip(edges[::2].tolist(), edges[1::2].tolist(), strict=True))


def _crowded(times: Ints, order: Ints, behind: Bools) -> bool:
    """Check whether the messages that sorting moved come to lie closely beside others.

    A clock that was set back runs through the same times twice: its messages then fall between, or on, those
    from before. Delayed messages leave a gap in which they fit.
    """
    steps = np.diff(times[order])
    usual = float(np.median(steps))
    moved = behind[order]
    beside_moved = moved[1:] | moved[:-1]
    return bool(beside_moved.any() and np.mean(steps[beside_moved] < CROWDED * usual) > CROWDED_SHARE)


@dataclass(frozen=True)
class Clock:
    """The clock by which the messages of a topic are timed, beside their times of receipt.

    Attributes:
        topic: its name.
        by_header: whether header stamps are used.
        delay_s: median from the stamp to receipt; 0 by receipt.
        drift_s: by how much the delay grows over the recording.
    """

    topic: str
    by_header: bool
    delay_s: float = 0.0
    drift_s: float = 0.0

    def __str__(self) -> str:
        """Return how the stamps lie beside receipt."""
        if not self.by_header:
            return f"{self.topic} has only receive times"
        if abs(self.delay_s) > DAY_S:
            return f"header stamps of {self.topic} do not come from the recorder's clock (simulated time?)"
        side = "ahead of" if self.delay_s < 0 else "behind"
        said = f"header stamps of {self.topic} are {abs(self.delay_s):.3g} s {side} receipt"
        if abs(self.drift_s) > AHEAD_S:
            said += f" and drift by {abs(self.drift_s):.3g} s over the recording"
        return said


@dataclass(frozen=True)
class MessageTimes:
    """The times of messages of one topic by both clocks, in the order of the files.

    A clock is named `header` (receipt, where there are no header stamps), `receive`, or `stored` for the
    order of the files.

    Attributes:
        received: (T,) of receipt.
        stamps: (T,) of the header stamps; None where they are no clock: a message of the topic has none, or
            they never change.
        files: (T,) the number of the file of each message.
    """

    topic: str
    received: Ints
    stamps: Ints | None
    files: Ints

    def __len__(self) -> int:
        return len(self.received)

    def __getitem__(self, rows: Array) -> "MessageTimes":
        """Return the times of some messages."""
        stamps = None if self.stamps is None else self.stamps[rows]
        return MessageTimes(self.topic, self.received[rows], stamps, self.files[rows])

    def by(self, clock: str) -> Ints:
        """Return the times (T,) by a clock."""
        return self.stamps if clock == "header" and self.stamps is not None else self.received

    def seconds(self, clock: str) -> Floats:
        """Return the times (T,) by a clock, in seconds."""
        nanoseconds = self.by(clock)
        # Whole seconds are divided first, because 61 bits do not fit a float.
        return nanoseconds // SECOND_NS + (nanoseconds % SECOND_NS) / 1e9

    def by_receipt(self) -> Ints:
        """Return the order (T,) of receipt, even where the recorder's clock was set back."""
        return np.argsort(self.received, kind="stable")

    def order(self, clock: str) -> Ints | None:
        """Return the order (T,) by a clock; None where it was set back."""
        return np.arange(len(self)) if clock == "stored" else sorted_by(self.by(clock), self.files)

    def order_or_raise(self, clock: str, where: str) -> Ints:
        """Return the order (T,) by a clock.

        Raises:
            EpisodeError: the clock was set back.
        """
        order = self.order(clock)
        if order is None:
            raise self.set_back_error(clock, where)
        return order

    def set_back_error(self, clock: str, where: str) -> EpisodeError:
        """Return the error of a clock that was set back; its remedy makes no data worse."""
        own, other = "header stamps", "receive"
        if clock != "header" or self.stamps is None:
            own, other = "receive times", "header"
        steps = np.diff(self.by(clock))
        at = int(np.argmin(steps)) + 1
        seconds = -float(steps[at - 1]) / SECOND_NS
        fault = f"{own} go back by {seconds:.3g} s at message {at}: their clock was set back or begun anew"
        remedy = "cut the file there, and put the parts into separate folders"
        if self.stamps is not None and self.order(other) is not None:
            remedy = f"sync: {{stamp: {other}}} uses the other times of the messages"
            if other == "receive" and seconds > 1:  # segments divide where a clock jumps back so far
                remedy = f"source.segments: {{gap_s: 1}} makes the parts episodes of their own; {remedy}"
        return EpisodeError(where, fault, remedy)

    def clock(self, clock: str = "header") -> Clock:
        """Measure the clock that times the messages."""
        if clock != "header" or self.stamps is None or not len(self):
            return Clock(self.topic, False)
        delays = (self.received - self.stamps) / SECOND_NS
        third = max(len(delays) // 3, 1)
        # Medians of the first and last third lie two thirds of the recording apart.
        drift = 1.5 * float(np.median(delays[-third:]) - np.median(delays[:third]))
        return Clock(self.topic, True, float(np.median(delays)), drift if len(delays) >= 9 else 0.0)


def apart(one: Clock, other: Clock, period_s: float) -> str:
    """Return why two topics cannot be paired by their clocks; empty where they can.

    Args:
        one, other: clocks of the two topics.
        period_s: of the camera's frames. Clocks that differ by less change hardly any pair.
    """
    shift = one.delay_s - other.delay_s
    drift = one.drift_s - other.drift_s
    limit = max(period_s, BEHIND_S)
    # A stamp later than its own receipt cannot be a delay.
    ahead = [clock for clock in (one, other) if clock.by_header and clock.delay_s < -AHEAD_S]
    if ahead and one.by_header != other.by_header:
        limit = AHEAD_S
    if max(abs(shift), abs(drift)) <= limit:
        return ""
    return f"{one}, {other}: pairs would be off by {max(abs(shift), abs(drift)):.3g} s"
