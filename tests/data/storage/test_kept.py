"""Work that an interrupted command kept: read whole, or taken as not done."""

from pathlib import Path

import numpy as np
import pytest

from hma_data.errors import OutputError
from hma_data.storage.kept import SETTINGS, KeptParts, keep_arrays, kept_arrays


def test_arrays_come_back_and_damaged_ones_do_not(tmp_path: Path) -> None:
    path = tmp_path / "part 1.npz"
    assert kept_arrays(path) is None
    values = np.random.default_rng(0).integers(0, 9, 400)
    keep_arrays(path, {"values": values, "words": np.array("{}")})
    found = kept_arrays(path)
    assert found is not None and (found["values"] == values).all()
    with np.load(path) as arrays:  # as any reader of .npz
        assert (arrays["values"] == values).all()
    whole = path.read_bytes()
    for cut in (0, 1, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:cut])
        assert kept_arrays(path) is None, cut
    for place in range(0, len(whole), 7):  # the zip's own sums miss some: a member is lost, or "encrypted"
        flipped = bytearray(whole)
        flipped[place] ^= 1
        path.write_bytes(bytes(flipped))
        assert kept_arrays(path) is None, place
    np.savez(path, values=values)  # as another version may have kept them
    assert kept_arrays(path) is None


@pytest.mark.parametrize("damaged", [b"", b"\xff\xfe", b'{"seed": 1}', None])
def test_parts_without_their_settings_are_not_taken(tmp_path: Path, damaged: bytes | None) -> None:
    KeptParts(tmp_path / "parts", {"seed": 0}).part("one", lambda: {"values": np.ones(2)})
    (tmp_path / "parts" / SETTINGS).unlink()
    if damaged is not None:
        (tmp_path / "parts" / SETTINGS).write_bytes(damaged)
    with pytest.raises(OutputError, match="started with other settings — .* or delete .*parts"):
        KeptParts(tmp_path / "parts", {"seed": 0})
