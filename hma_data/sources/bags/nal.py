"""Whether a message of H.264 or H.265 video lacks pictures that it is made from: those were never recorded.

A decoder goes on without a lost picture and says nothing. The headers tell: H.264 counts its reference
pictures (frame_num; ITU-T H.264, 7.3.2.1, 7.3.3 and 7.4.3), H.265 lists by their order those that a picture
needs (reference picture sets; ITU-T H.265, 7.3.2.2, 7.3.6.1, 7.3.7 and 8.3.2).
"""

import re
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass
from typing import Protocol

from hma_data.sources.bags.av1 import Av1
from hma_data.sources.bags.bits import HEAD, Bits

UNIT = re.compile(b"\x00\x00\x01")
_HIGH = {100, 110, 122, 244, 44, 83, 86, 118, 128, 138, 139, 134, 135}  # profiles that state a chroma format


class Order(Protocol):
    """Follows the messages of one video from a key frame on."""

    def complete(self, data: bytes) -> bool:
        """Whether all that this message's pictures are made from came before; True where nothing tells."""
        ...


class Anything:
    """Of codecs that are not looked into."""

    def complete(self, data: bytes) -> bool:
        return True


def order(codec: str) -> Order:
    """For h264, h265 and av1; of other codecs every message is taken for complete."""
    kinds: dict[str, type[Order]] = {"h264": Avc, "h265": Hevc, "av1": Av1}
    return kinds.get(codec, Anything)()


def _units(data: bytes) -> Iterator[bytes]:
    """The units of a message in Annex B form, without their start codes."""
    starts = [found.end() for found in UNIT.finditer(data)]
    for start, end in zip(starts, [*starts[1:], len(data) + 3]):
        if start < len(data):
            yield data[start : end - 3]


def _all_complete(complete: Callable[[bytes], bool], data: bytes) -> bool:
    """Whether every unit of a message is; each is looked at. What cannot be read tells nothing."""
    whole = True
    for unit in _units(data):
        with suppress(IndexError):  # the decoder will say what is wrong with it
            whole &= complete(unit)
    return whole


# -- H.264


@dataclass(frozen=True)
class _AvcSequence:
    bits: int  # of frame_num
    gaps: bool  # numbers may be left out
    planes: bool  # colours are coded apart


class Avc:
    """Counts reference pictures: one more each, or as many as before."""

    def __init__(self) -> None:
        self._sequences: dict[int, _AvcSequence] = {}
        self._of: dict[int, int] = {}  # picture parameter set -> sequence parameter set
        self._last: int | None = None  # frame_num of the reference picture before

    def complete(self, data: bytes) -> bool:
        """See `Order`."""
        return _all_complete(self._unit, data)

    def _unit(self, unit: bytes) -> bool:
        kind, reference = unit[0] & 31, bool(unit[0] >> 5 & 3)
        if kind == 7:
            number, sequence = _avc_sequence(Bits(unit[1:]))
            self._sequences[number] = sequence
        elif kind == 8:
            bits = Bits(unit[1:HEAD])
            number = bits.ue()
            self._of[number] = bits.ue()
        elif kind in (1, 2, 5):
            return self._slice(Bits(unit[1:HEAD]), kind == 5, reference)
        return True

    def _slice(self, bits: Bits, first: bool, reference: bool) -> bool:
        if bits.ue():  # not the picture's first
            return True
        bits.ue()  # its type
        sequence = self._sequences.get(self._of.get(bits.ue(), 0))
        if sequence is None:
            return True
        if sequence.planes:
            bits.u(2)
        number, before = bits.u(sequence.bits), self._last
        if reference or first:
            self._last = number
        if first or before is None or sequence.gaps:
            return True
        return number in (before, (before + 1) % (1 << sequence.bits))


def _avc_sequence(bits: Bits) -> tuple[int, _AvcSequence]:
    profile = bits.u(8)
    bits.u(16)
    number, planes = bits.ue(), False
    if profile in _HIGH:
        chroma = bits.ue()
        planes = chroma == 3 and bool(bits.u(1))
        bits.ue(), bits.ue(), bits.u(1)  # depths, transform bypass
        if bits.u(1):
            for i in range(12 if chroma == 3 else 8):
                if bits.u(1):
                    _avc_scaling(bits, 16 if i < 6 else 64)
    size = bits.ue() + 4
    counting = bits.ue()
    if counting == 0:
        bits.ue()
    elif counting == 1:
        bits.u(1), bits.se(), bits.se()
        for _ in range(bits.ue()):
            bits.se()
    bits.ue()  # reference frames
    return number, _AvcSequence(size, bool(bits.u(1)), planes)


def _avc_scaling(bits: Bits, size: int) -> None:
    last = following = 8
    for _ in range(size):
        if following:
            following = (last + bits.se()) % 256
        last = following or last


# -- H.265

References = tuple[tuple[int, bool], ...]  # (order less the picture's, whether the picture itself uses it)


@dataclass(frozen=True)
class _HevcSequence:
    bits: int  # of the order's low part
    planes: bool
    sets: tuple[References, ...]


@dataclass(frozen=True)
class _HevcPicture:
    sequence: int
    extra: int  # bits in a slice's header that are reserved
    shown: bool  # slices say whether they are shown


class Hevc:
    """Looks for the short-term reference pictures that each picture lists."""

    def __init__(self) -> None:
        self._sequences: dict[int, _HevcSequence] = {}
        self._pictures: dict[int, _HevcPicture] = {}
        self._had: set[int] = set()  # orders of the pictures since the key frame
        self._base = 0  # order of the last picture that others count from

    def complete(self, data: bytes) -> bool:
        """See `Order`."""
        return _all_complete(self._unit, data)

    def _unit(self, unit: bytes) -> bool:
        if len(unit) < 3 or (unit[0] & 1) << 5 | unit[1] >> 3:  # another layer's
            return True
        kind, sublayer = unit[0] >> 1 & 63, (unit[1] & 7) - 1
        if kind == 33:
            number, sequence = _hevc_sequence(Bits(unit[2:]))
            self._sequences[number] = sequence
        elif kind == 34:
            bits = Bits(unit[2:HEAD])
            number, sequence_number = bits.ue(), bits.ue()
            bits.u(1)
            shown = bool(bits.u(1))
            self._pictures[number] = _HevcPicture(sequence_number, bits.u(3), shown)
        elif kind <= 9 or 16 <= kind <= 21:
            return self._slice(Bits(unit[2:HEAD]), kind, sublayer)
        return True

    def _slice(self, bits: Bits, kind: int, sublayer: int) -> bool:
        if not bits.u(1):  # not the picture's first
            return True
        if kind >= 16:
            bits.u(1)
        picture = self._pictures.get(bits.ue())
        sequence = self._sequences.get(picture.sequence) if picture else None
        if picture is None or sequence is None:
            return True
        bits.u(picture.extra)
        bits.ue()  # its type
        if picture.shown:
            bits.u(1)
        if sequence.planes:
            bits.u(2)
        if kind in (19, 20):  # IDR
            self._had, self._base = {0}, 0
            return True
        low = bits.u(sequence.bits)
        if kind in (16, 17, 18) or not self._had:  # decoding may begin, or begins, at this one
            self._had, self._base = {low}, low
            return True
        order = self._order(low, 1 << sequence.bits)
        needed = _listed(bits, sequence)
        whole = all(order + less in self._had for less, used in needed if used)
        self._had = {order, *(order + less for less, _ in needed if order + less in self._had)}
        if sublayer == 0 and not (6 <= kind <= 9 or (kind <= 14 and kind % 2 == 0)):
            self._base = order
        return whole or kind in (8, 9)  # skipped leading pictures are not decoded after a random access

    def _order(self, low: int, size: int) -> int:
        """Picture order count: H.265, 8.3.1."""
        high, before = self._base // size * size, self._base % size
        if low < before and before - low >= size // 2:
            high += size
        elif low > before and low - before > size // 2:
            high -= size
        return high + low


def _listed(bits: Bits, sequence: _HevcSequence) -> References:
    """The set of a slice: its own, or one of the sequence's."""
    if not bits.u(1):
        return _set(bits, sequence.sets, own=True)
    count = len(sequence.sets)
    number = bits.u((count - 1).bit_length()) if count > 1 else 0
    if number >= count:
        raise IndexError("no such reference picture set")
    return sequence.sets[number]


def _set(bits: Bits, sets: tuple[References, ...], own: bool) -> References:
    """st_ref_pic_set, the nearest before first, then the nearest after; `own`: of a slice."""
    if sets and bits.u(1):
        back = bits.ue() + 1 if own else 1
        if back > len(sets):
            raise IndexError("a set derived from none")
        sign = bits.u(1)
        return _moved(bits, sets[-back], (bits.ue() + 1) * (1 - 2 * sign))
    counts = bits.ue(), bits.ue()
    if max(counts) > 16:
        raise IndexError("a set of more than 16 pictures")
    found: list[tuple[int, bool]] = []
    for count, sign in zip(counts, (-1, 1)):
        less = 0
        for _ in range(count):
            less += sign * (bits.ue() + 1)
            found.append((less, bool(bits.u(1))))
    return tuple(found)


def _moved(bits: Bits, known: References, by: int) -> References:
    """What a set has of another and of the picture that one belongs to."""
    kept: list[tuple[int, bool]] = []
    for less in [*(less for less, _ in known), 0]:
        used = bool(bits.u(1))
        if used or bits.u(1):
            kept.append((less + by, used))
    before = sorted((item for item in kept if item[0] < 0), reverse=True)
    return (*before, *sorted(item for item in kept if item[0] > 0))


def _hevc_sequence(bits: Bits) -> tuple[int, _HevcSequence]:
    bits.u(4)
    layers = bits.u(3)
    bits.u(1)
    _profile(bits, layers)
    number = bits.ue()
    planes = bits.ue() == 3 and bool(bits.u(1))
    bits.ue(), bits.ue()  # width, height
    if bits.u(1):
        for _ in range(4):
            bits.ue()
    bits.ue(), bits.ue()  # depths
    size = bits.ue() + 4
    for _ in range(layers + 1 if bits.u(1) else 1):
        bits.ue(), bits.ue(), bits.ue()
    for _ in range(6):
        bits.ue()
    if bits.u(1) and bits.u(1):
        _hevc_scaling(bits)
    bits.u(2)
    if bits.u(1):
        bits.u(8), bits.ue(), bits.ue(), bits.u(1)
    count = bits.ue()
    if count > 64:
        raise IndexError("more than 64 reference picture sets")
    sets: tuple[References, ...] = ()
    for _ in range(count):
        sets = (*sets, _set(bits, sets, own=False))
    return number, _HevcSequence(size, planes, sets)


def _profile(bits: Bits, layers: int) -> None:
    """profile_tier_level: 12 bytes, and of each sub-layer what its flags say."""
    bits.u(96)
    flags = [(bits.u(1), bits.u(1)) for _ in range(layers)]
    if layers:
        bits.u(2 * (8 - layers))
    for profile, level in flags:
        bits.u(88 * profile + 8 * level)


def _hevc_scaling(bits: Bits) -> None:
    for size in range(4):
        for _ in range(0, 6, 3 if size == 3 else 1):
            if not bits.u(1):
                bits.ue()
                continue
            if size > 1:
                bits.se()
            for _ in range(min(64, 1 << (4 + 2 * size))):
                bits.se()
