"""Reads the bits of video headers."""

HEAD = 96  # bytes of a unit that are looked at: its header's beginning


class Bits:
    """Reads the syntax elements of a unit's payload.

    Args:
        escaped: whether bytes were put in to keep start codes unique, as in H.264 and H.265.

    Raises:
        IndexError: it ends before.
    """

    def __init__(self, unit: bytes, escaped: bool = True) -> None:
        self._data = unit.replace(b"\x00\x00\x03", b"\x00\x00") if escaped else unit
        self._at = 0

    def u(self, bits: int) -> int:
        """Unsigned, of that many bits."""
        end = self._at + bits
        if end > 8 * len(self._data):
            raise IndexError("the unit ends in its header")
        first, last = self._at // 8, -(-end // 8)
        value = int.from_bytes(self._data[first:last], "big") >> (8 * last - end)
        self._at = end
        return value & ((1 << bits) - 1)

    def ue(self) -> int:
        """Unsigned Exp-Golomb."""
        zeros = 0
        while not self.u(1):
            zeros += 1
            if zeros > 32:
                raise IndexError("no number has so many zeros")
        return (1 << zeros) - 1 + self.u(zeros)

    def se(self) -> int:
        """Signed Exp-Golomb."""
        code = self.ue()
        return (code + 1) // 2 if code % 2 else -(code // 2)
