"""Work that an interrupted command kept: read whole, or taken as not done."""

from pathlib import Path

import numpy as np
import pytest

from hma_data.storage.kept import kept_arrays


@pytest.mark.parametrize("save", [np.savez, np.savez_compressed])
def test_arrays_come_back_and_damaged_ones_do_not(tmp_path: Path, save) -> None:  # type: ignore[no-untyped-def]
    path = tmp_path / "part 1.npz"
    assert kept_arrays(path) is None
    values = np.random.default_rng(0).integers(0, 9, 4_000)
    save(path, values=values)
    found = kept_arrays(path)
    assert found is not None and (found["values"] == values).all()
    whole = path.read_bytes()
    for cut in (0, 1, 100, len(whole) // 2, len(whole) - 1):
        path.write_bytes(whole[:cut])
        assert kept_arrays(path) is None, cut
    for place in range(200, len(whole) - 200, len(whole) // 20):
        flipped = bytearray(whole)
        flipped[place] ^= 8
        path.write_bytes(bytes(flipped))
        assert kept_arrays(path) is None, place
