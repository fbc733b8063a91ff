"""A packed recording is told with what unpacks it."""

from pathlib import Path

import pytest

from hma_data.errors import SourceError
from hma_data.sources.detect import detect


@pytest.mark.parametrize(
    ("name", "tool"),
    [("run.bag.gz", "gunzip"), ("x.h5.gz", "gunzip"), ("a.mcap.GZ", "gunzip"), ("all.zip", "unzip"),
     ("all.tar", "tar xf"), ("all.tar.gz", "tar xf"), ("all.tgz", "tar xf"), ("run.bag.zst", "unzstd")],
)  # fmt: skip
def test_a_packed_recording_is_to_be_unpacked(tmp_path: Path, name: str, tool: str) -> None:
    (tmp_path / "notes.txt").write_text("day one")
    (tmp_path / name).write_bytes(b"\x1f\x8b\x08" + bytes(40))
    for uri in (tmp_path, tmp_path / name):
        with pytest.raises(SourceError) as told:
            detect(str(uri))
        assert f"{name} is packed: unpack it first, as with `{tool} {name}`" in str(told.value)


def test_what_is_not_packed_is_not_called_so(tmp_path: Path) -> None:
    (tmp_path / "notes.txt").write_text("day one")
    with pytest.raises(SourceError, match=r"not a recording of a known format — expected RLDS"):
        detect(str(tmp_path))
