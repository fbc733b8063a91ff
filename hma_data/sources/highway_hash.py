"""HighwayHash-64, by which Riegeli files check their headers and data.

Plain Python, a few MB/s. (Source: HighwayHash's portable implementation and the specification of Riegeli.)
"""

import struct

KEY = struct.unpack("<4Q", b"Riegeli/records\nRiegeli/records\n")
MULTIPLIERS_0 = (0xDBE6D5D5FE4CCE2F, 0xA4093822299F31D0, 0x13198A2E03707344, 0x243F6A8885A308D3)
MULTIPLIERS_1 = (0x3BD39E10CB0EF593, 0xC0ACF169B5F18A8C, 0xBE5466CF34E90C6C, 0x452821E638D01377)
MASK, LOW = 0xFFFFFFFFFFFFFFFF, 0xFFFFFFFF
PACKET = struct.Struct("<4Q")
State = tuple[list[int], list[int], list[int], list[int]]


def highway_hash(data: bytes) -> int:
    """The 64-bit hash of the data under Riegeli's key."""
    v0 = [m ^ key for m, key in zip(MULTIPLIERS_0, KEY)]
    v1 = [m ^ _turned(key) for m, key in zip(MULTIPLIERS_1, KEY)]
    state: State = (v0, v1, list(MULTIPLIERS_0), list(MULTIPLIERS_1))
    whole = len(data) - len(data) % 32
    for packet in PACKET.iter_unpack(memoryview(data)[:whole]):
        _update(state, packet)
    if whole < len(data):
        _remainder(state, data[whole:])
    for _ in range(4):
        _update(state, (_turned(v0[2]), _turned(v0[3]), _turned(v0[0]), _turned(v0[1])))
    return (v0[0] + v1[0] + state[2][0] + state[3][0]) & MASK


def _turned(value: int) -> int:
    return (value >> 32) | (value << 32) & MASK


def _update(state: State, packet: tuple[int, ...]) -> None:
    v0, v1, mul0, mul1 = state
    for i in range(4):
        a = (v1[i] + mul0[i] + packet[i]) & MASK
        b = v0[i]
        mul0[i] ^= (a & LOW) * (b >> 32)
        b = (b + mul1[i]) & MASK
        mul1[i] ^= (b & LOW) * (a >> 32)
        v1[i], v0[i] = a, b
    for goal, source in ((v0, v1), (v1, v0)):
        for i in (0, 2):
            low, high = source[i], source[i + 1]
            goal[i] = (
                goal[i]
                + (
                    ((low & 0xFF000000 | high & 0xFF00000000) >> 24)
                    | ((low & 0xFF0000000000 | high & 0xFF000000000000) >> 16)
                    | (low & 0xFF0000)
                    | ((low & 0xFF00) << 32)
                    | ((high & 0xFF00000000000000) >> 8)
                    | ((low & 0xFF) << 56)
                )
            ) & MASK
            goal[i + 1] = (
                goal[i + 1]
                + (
                    ((high & 0xFF000000 | low & 0xFF00000000) >> 24)
                    | (high & 0xFF0000)
                    | ((high & 0xFF0000000000) >> 16)
                    | ((high & 0xFF00) << 24)
                    | ((low & 0xFF000000000000) >> 8)
                    | ((high & 0xFF) << 48)
                    | (low & 0xFF00000000000000)
                )
            ) & MASK


def _remainder(state: State, rest: bytes) -> None:
    v0, v1, _, _ = state
    size, whole = len(rest), len(rest) & ~3
    for i in range(4):
        v0[i] = (v0[i] + (size << 32) + size) & MASK
        low, high = v1[i] & LOW, v1[i] >> 32
        v1[i] = _rotated(low, size) | _rotated(high, size) << 32
    packet = bytearray(32)
    packet[:whole] = rest[:whole]
    tail = rest[whole:]
    if size & 16:
        packet[28:32] = rest[size - 4 : size]
    elif tail:
        packet[16:19] = bytes((tail[0], tail[len(tail) >> 1], tail[-1]))
    _update(state, PACKET.unpack(packet))


def _rotated(half: int, bits: int) -> int:
    """32 bits rotated to the left by 0 to 31."""
    return (half << bits | half >> (32 - bits)) & LOW
