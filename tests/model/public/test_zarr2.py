"""Zarr arrays are read without the zarr package, frames of its own writer among them."""

import base64
import json
import zlib
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from hma_data.errors import SourceError
from recipes.public.zarr2 import ZarrArray, unblosc
from tests.model.public.look_alikes import write_zarr

# (300, 2) float32, compressed by numcodecs 0.15; LZ4 in blocks of 1,024 bytes, which are split in streams
FRAMES = {
    "lz4": "AgEhBGAJAABgCQAAewAAABQAAAANAAAAHwABAP//QVAAAAAAAA0AAAAfAAEA//9BUAAAAAAAIwAAAB8AAQBkH4ACAG"
    "QP7wBkLwBAAgAVH4ACADsPAQBgUICAgICAGgAAAB8AAQBkHz8CAD0PAQAUH0ACAP9QUD9AP0A/",
    "zstd": "AgGRBGAJAABgCQAARAAAABQAAAAsAAAAKLUv/WBgCBUBAEAAgECAAD9APwqgoPgBYPdj1FS2aDq9pgu65fUpLU3S71c=",
    "zlib": "AgFgBGAJAABgCQAAgAAAABQAAAASAAAAeNpjYBgFwxs02A8EDQC0owsyGAAAAHjaY2BosGcAg2FB2w9emsFhJNEAVx"
    "k1YhoAAAB42mNgYHBgYGCwZxgxtMMQoBuGPA0AQ5089hgAAAB42mNgcHBgYGiwZ6A73TBKD2MaAHKKbHY=",
}
CLAIMS = (
    b"\x28\xb5\x2f\xfd\xe0" + (1 << 40).to_bytes(8, "little") + b"\1\0\0"
)  # Zstandard that claims 2^40 bytes
REFUSED = {  # the same values; only the header counts
    "bit shuffle": "AgEkBGAJAABgCQAAngAAAA==",
    "blosclz": "AgEBBGAJAABgCQAAiQAAAA==",
}


@pytest.mark.parametrize("codec", FRAMES)
def test_frames_of_the_usual_writer_are_read(codec: str) -> None:
    row = np.arange(300)
    expected = np.stack([row // 60, 0.5 * (row // 100)], axis=1).astype("<f4")
    found = unblosc(base64.b64decode(FRAMES[codec]), expected.nbytes, Path("0.0"))
    assert np.array_equal(np.frombuffer(found, "<f4").reshape(300, 2), expected)


@pytest.mark.parametrize("codec", REFUSED)
def test_a_codec_that_is_not_read_is_named(codec: str) -> None:
    frame = base64.b64decode(REFUSED[codec]).ljust(158, b"\0")
    with pytest.raises(SourceError, match=f"Blosc with {codec}.*convert it with the zarr package"):
        unblosc(frame, 2400, Path("0.0"))


@pytest.mark.parametrize("compressor", [None, "zlib", "blosc"])
def test_rows_are_put_together_from_chunks(compressor: str | None, tmp_path: Path) -> None:
    values = np.arange(7 * 5, dtype=np.int32).reshape(7, 5)
    write_zarr(tmp_path / "a", values, (3, 2), compressor)
    array = ZarrArray(tmp_path / "a")
    assert array.shape == (7, 5) and array.dtype == np.int32
    assert np.array_equal(array.rows(0, 7), values)
    assert np.array_equal(array.rows(2, 4), values[2:4])
    (tmp_path / "a" / "1.0").unlink()  # a chunk that was never written holds the fill value
    found = ZarrArray(tmp_path / "a").rows(3, 6)
    assert (found[:, :2] == 0).all() and np.array_equal(found[:, 2:], values[3:6, 2:])


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"filters": [{"id": "delta"}]}, "has filters"),
        ({"order": "F"}, "order F"),
        ({"dtype": "|O"}, "type object"),
        ({"chunks": [1 << 20, 1 << 20]}, "has chunks"),
        ({"compressor": {"id": "lzma"}}, "compressed by lzma"),
        ({"shape": None}, "no array of Zarr's format 2"),
        ({"shape": []}, "no array of Zarr's format 2"),
        ({"shape": [-4, 2]}, "no array of Zarr's format 2"),
        ({"chunks": ["4", 2]}, "no array of Zarr's format 2"),
        ({"compressor": "zlib"}, "no array of Zarr's format 2"),
        ({"fill_value": "words"}, "no array of Zarr's format 2"),
        ({"dimension_separator": "/../"}, "no array of Zarr's format 2"),
        ({"shape": [1 << 40, 2]}, "has rows 0 to 1099511627776"),
        ({"shape": [4, 1 << 40]}, "more than 1,073,741,824 bytes"),
    ],
)
def test_other_forms_are_refused(changes: dict[str, Any], said: str, tmp_path: Path) -> None:
    write_zarr(tmp_path / "a", np.zeros((4, 2), np.float32), (4, 2))
    facts = json.loads((tmp_path / "a" / ".zarray").read_text()) | changes
    (tmp_path / "a" / ".zarray").write_text(json.dumps(facts))
    with pytest.raises(SourceError, match=said):
        array = ZarrArray(tmp_path / "a")
        array.rows(0, len(array))


@pytest.mark.parametrize(
    "content", [b"", b"\2\1\x21\4", zlib.compress(b"short"), b"x" * 40, CLAIMS, bytes(1 << 17)]
)
@pytest.mark.parametrize("compressor", ["zlib", "blosc", "zstd", None])
def test_a_damaged_chunk_is_named(content: bytes, compressor: str | None, tmp_path: Path) -> None:
    write_zarr(tmp_path / "a", np.ones((4, 2), np.float32), (4, 2), compressor)
    (tmp_path / "a" / "0.0").write_bytes(content)
    with pytest.raises(SourceError, match=r"0\.0: is damaged"):
        ZarrArray(tmp_path / "a").rows(0, 4)


@pytest.mark.parametrize("frame", ["lz4", "zstd", "zlib"])
def test_damaged_frames_are_refused_whatever_is_damaged(frame: str, tmp_path: Path) -> None:
    whole = base64.b64decode(FRAMES[frame])
    write_zarr(tmp_path / "a", np.ones((300, 2), np.float32), (300, 2), "blosc")
    rng = np.random.default_rng(0)
    for place in (*range(40), *rng.integers(40, len(whole), 20)):
        for value in (0, 255, whole[place] ^ 1):
            damaged = bytearray(whole)
            damaged[place] = value
            (tmp_path / "a" / "0.0").write_bytes(damaged)
            with suppress(SourceError):
                ZarrArray(tmp_path / "a").rows(0, 300)
