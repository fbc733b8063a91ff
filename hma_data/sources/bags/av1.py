"""Whether a message of AV1 video lacks frames that it is made from, where the stream itself says so.

Streams coded to survive losses state with every frame what the reference slots must hold: order hints of all
eight (error_resilient_mode), or numbers of the frames it refers to (frame_id_numbers_present_flag). AV1
specification, sections 5.3, 5.5 and 5.9.2. Other streams refer to slots alone. A jump of their order hints
shows that a frame is missing, and not whether any other is made from it: every second one of some encoders
is not kept for others. So it is not taken for a loss.
"""

from collections.abc import Iterator
from dataclasses import dataclass

from hma_data.sources.bags.bits import HEAD, Bits

SLOTS, REFERENCES = 8, 7
SEQUENCE, FRAME_HEADER, FRAME = 1, 3, 6  # kinds of units
KEY, INTER, INTRA_ONLY, SWITCH = range(4)  # kinds of frames


def units(data: bytes) -> Iterator[tuple[int, bytes]]:
    """Kind and payload of the units (OBUs) of a message; a size that leads beyond its end ends it there."""
    at = 0
    while at < len(data):
        kind, extended, sized = data[at] >> 3 & 15, data[at] & 4, data[at] & 2
        at += 2 if extended else 1
        size, shift = (0, 0) if sized else (len(data), 0)
        while sized and at < len(data):
            size |= (data[at] & 0x7F) << shift
            at, shift = at + 1, shift + 7
            if not data[at - 1] & 0x80:
                break
        yield kind, data[at : at + size]
        at += size


@dataclass(frozen=True)
class _Sequence:
    """What a sequence header says of the frames' headers.

    Attributes:
        closed: is not looked into: still pictures, and layers whose removal is timed apart.
        hint, number, delta: bits of an order hint, a frame's number, a difference of two; 0: none stated.
        screen, whole_vectors: of the tools for screens; 2 lets each frame say.
        shown_at, removed_at: bits of a frame's time of presentation and of removal; 0: none stated.
        models: how many of the operating points have a decoder model.
    """

    closed: bool
    hint: int = 0
    number: int = 0
    delta: int = 0
    screen: int = 2
    whole_vectors: int = 2
    shown_at: int = 0
    removed_at: int = 0
    models: int = 0


@dataclass(frozen=True)
class _Slot:
    """What a reference slot holds."""

    hint: int
    number: int
    kind: int


class Av1:
    """Follows what the slots hold, and looks at what the frames say they must."""

    def __init__(self) -> None:
        self._sequence: _Sequence | None = None
        self._slots: list[_Slot | None] = [None] * SLOTS

    def complete(self, data: bytes) -> bool:
        """See `hma_data.sources.bags.nal.Order`."""
        whole = True
        for kind, payload in units(data):
            try:
                if kind == SEQUENCE:
                    self._sequence = _sequence(Bits(payload, escaped=False))
                elif kind in (FRAME_HEADER, FRAME) and self._sequence and not self._sequence.closed:
                    whole &= self._frame(Bits(payload[:HEAD], escaped=False), self._sequence)
            except IndexError:
                continue  # the decoder will say what is wrong with it
        return whole

    def _frame(self, bits: Bits, sequence: _Sequence) -> bool:
        if bits.u(1):  # shows a frame that is there
            held = self._slots[bits.u(3)]
            if held and held.kind == KEY:
                self._slots = [held] * SLOTS
            return True
        kind, shown = bits.u(2), bits.u(1)
        if shown:
            bits.u(sequence.shown_at)
        else:
            bits.u(1)  # whether it may be shown later
        resilient = kind == SWITCH or (kind == KEY and shown) or bits.u(1)
        bits.u(1)
        screen = bits.u(1) if sequence.screen == 2 else sequence.screen
        if screen and sequence.whole_vectors == 2:
            bits.u(1)
        number = bits.u(sequence.number)
        if kind != SWITCH:
            bits.u(1)  # whether its size is its own
        hint = bits.u(sequence.hint)
        if not (resilient or kind in (KEY, INTRA_ONLY)):
            bits.u(3)
        if sequence.removed_at and bits.u(1):
            bits.u(sequence.models * sequence.removed_at)
        refreshed = 0xFF if kind == SWITCH or (kind == KEY and shown) else bits.u(8)
        lost = set[int]()
        if sequence.hint and resilient and (kind in (INTER, SWITCH) or refreshed != 0xFF):
            lost = {slot for slot in range(SLOTS) if self._differs(slot, hint=bits.u(sequence.hint))}
        whole = kind in (KEY, INTRA_ONLY) or self._refers_to_what_is_there(bits, sequence, number, lost)
        for slot in range(SLOTS):
            if refreshed >> slot & 1:
                self._slots[slot] = _Slot(hint, number, kind)
        return whole

    def _differs(self, slot: int, **stated: int) -> bool:
        """Whether a slot holds another frame than is stated; of one that nothing is known of, no."""
        held = self._slots[slot]
        return held is not None and any(getattr(held, name) != value for name, value in stated.items())

    def _refers_to_what_is_there(self, bits: Bits, sequence: _Sequence, number: int, lost: set[int]) -> bool:
        short = bool(sequence.hint and bits.u(1))
        if short:  # the slots follow from all hints
            bits.u(6)
        whole = not (short and lost)
        for _ in range(REFERENCES):
            slot = None if short else bits.u(3)
            if slot in lost:
                whole = False
            if sequence.number:
                before = (number - bits.u(sequence.delta) - 1) % (1 << sequence.number)
                whole &= slot is None or not self._differs(slot, number=before)
        return whole


def _sequence(bits: Bits) -> _Sequence:
    bits.u(4)  # profile, still picture
    if bits.u(1):
        return _Sequence(closed=True)
    shown_at = removed_at = delay = 0
    if bits.u(1):
        bits.u(64)  # ticks
        equal = bits.u(1)
        if equal:
            bits.ue()
        if bits.u(1):
            delay = bits.u(5) + 1
            bits.u(32)
            removed_at, shown_at = bits.u(5) + 1, bits.u(5) + 1
            shown_at = 0 if equal else shown_at
    models, layered = _points(bits, delay)
    if models and layered:
        return _Sequence(closed=True)
    width, height = bits.u(4) + 1, bits.u(4) + 1
    bits.u(width + height)
    number = delta = hint = 0
    if bits.u(1):
        delta = bits.u(4) + 2
        number = bits.u(3) + delta + 1
    bits.u(3 + 4)
    ordered = bits.u(1)
    if ordered:
        bits.u(2)
    screen = 2 if bits.u(1) else bits.u(1)
    whole_vectors = 2
    if screen:
        whole_vectors = 2 if bits.u(1) else bits.u(1)
    if ordered:
        hint = bits.u(3) + 1
    return _Sequence(False, hint, number, delta, screen, whole_vectors, shown_at, removed_at, models)


def _points(bits: Bits, delay: int) -> tuple[int, bool]:
    """How many operating points have a decoder model, and whether any is of some layers alone.

    Args:
        delay: bits of the models' delays, 0 where there are none.
    """
    models, layered = 0, False
    displayed = bits.u(1)
    for _ in range(bits.u(5) + 1):
        layered |= bool(bits.u(12))
        if bits.u(5) > 7:
            bits.u(1)
        if delay and bits.u(1):
            bits.u(2 * delay + 1)
            models += 1
        if displayed and bits.u(1):
            bits.u(4)
    return models, layered
