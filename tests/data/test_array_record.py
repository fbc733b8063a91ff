"""ArrayRecord: files of its own writer, of one made here from the specification, and damaged ones."""

import json
import struct

import fsspec
import numpy as np
import pytest
import zstandard
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from hma_data.errors import EpisodeError, SourceError
from hma_data.sources import array_record
from hma_data.sources.base import detect, open_source
from hma_data.sources.highway_hash import highway_hash
from hma_data.sources.record_file import open_records
from hma_data.sources.tfds_folder import open_folder
from tests.data import rlds_files
from tests.data.rlds_files import encode, tensor

FILES = fsspec.filesystem("file")
SIGNATURE = bytes.fromhex(  # the first 64 bytes of any Riegeli file, of its specification
    "83af70d10d884a3f0000000000000000400000000000000091bac23c9287e1a9"
    "0000000000000000e19f13c0e9b1c37273000000000000000000000000000000"
)
SIZES = {"none": [], "empty": [0], "even": [10] * 30, "blocks": [200_000, 3, 0, 70_000, 65_512, 65_472] * 2}


@pytest.fixture(autouse=True)
def cache(tmp_path, monkeypatch):
    monkeypatch.setenv("HMA_CACHE", str(tmp_path / "cache"))


def contents(sizes) -> list[bytes]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256 if i % 2 else 3, n, np.uint8).tobytes() for i, n in enumerate(sizes)]


def varint(value: int) -> bytes:
    parts = []
    while value > 0x7F:
        parts.append(value & 0x7F | 0x80)
        value >>= 7
    return bytes([*parts, value])


def chunk(position: int, records: list[bytes], compress: bool) -> bytes:
    """A simple chunk at that position, cut by block headers and padded as the specification says."""

    def packed(data: bytes) -> bytes:
        return varint(len(data)) + zstandard.compress(data) if compress else data

    sizes = packed(b"".join(varint(len(record)) for record in records))
    data = (b"z" if compress else b"\0") + varint(len(sizes)) + sizes + packed(b"".join(records))
    decoded = sum(map(len, records))
    tail = struct.pack(
        "<QQB7sQ", len(data), highway_hash(data), ord("r"), len(records).to_bytes(7, "little"), decoded
    )
    plain, out = struct.pack("<Q", highway_hash(tail)) + tail + data, bytearray()
    for byte in range(len(plain)):
        if (position + len(out)) % 65536 == 0:
            out += bytes(24)  # a block header, whose content readers may skip
        out.append(plain[byte])
    return bytes(out)


def made(records: list[bytes], group: int = 1, compress: bool = True) -> bytes:
    """A whole ArrayRecord file."""
    out, footer = bytearray(SIGNATURE), []
    for start in range(0, len(records), group):
        part = records[start : start + group]
        decoded = sum(map(len, part))
        footer.append(b"\x08" + varint(len(out)) + b"\x10" + varint(decoded) + b"\x18" + varint(len(part)))
        out += chunk(len(out), part, compress)
    about = b"\x08\x01\x10" + varint(len(footer)) + b"\x18" + varint(len(records))
    place = len(out)
    out += chunk(place, [b"\x0a" + varint(len(about)) + about, *footer], compress)
    out += bytes(-len(out) % 65536)
    script = b"\x08" + varint(place) + b"\x10" + varint(array_record.MAGIC)
    out += chunk(len(out), [script] * 3, False)
    return bytes(out + bytes(-len(out) % 65536))


def read_all(path) -> list[bytes]:
    frames = array_record.scan(FILES, str(path), path.stat().st_size)
    assert not frames.fault
    return [array_record.read_record(FILES, str(path), frames, i, "e") for i in range(len(frames))]


def test_the_hash_is_that_of_riegelis_specification():
    for hashed, stored in (
        (SIGNATURE[8:24], SIGNATURE[:8]),
        (SIGNATURE[32:], SIGNATURE[24:32]),
        (b"", SIGNATURE[40:48]),
    ):
        assert highway_hash(hashed) == int.from_bytes(stored, "little")


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize(("group", "compress"), [(1, True), (1, False), (7, True)])
def test_records_are_read_as_they_were_put_in(tmp_path, sizes, group, compress):
    path = tmp_path / "x.array_record"
    path.write_bytes(made(contents(SIZES[sizes]), group, compress))
    assert read_all(path) == contents(SIZES[sizes])


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize(
    "options",
    ["group_size:1", "", "group_size:1,uncompressed", "group_size:3,zstd:9,pad_to_block_boundary:true"],
)
def test_files_of_the_formats_own_writer(tmp_path, sizes, options):
    from array_record.python import array_record_module as module

    path = tmp_path / "x.array_record"
    writer = module.ArrayRecordWriter(str(path), options)
    for record in contents(SIZES[sizes]):
        writer.write(record)
    writer.close()
    assert read_all(path) == contents(SIZES[sizes])


@pytest.mark.parametrize(
    ("options", "message"),
    [("group_size:1,transpose", "transpose"), ("group_size:1,brotli", "brotli"), ("snappy", "snappy")],
)
def test_other_ways_of_writing_are_named(tmp_path, options, message):
    from array_record.python import array_record_module as module

    path = tmp_path / "x.array_record"
    writer = module.ArrayRecordWriter(str(path), options)
    writer.write(b"one" * 100)
    writer.close()
    with pytest.raises(EpisodeError, match=message):
        open_records(FILES, str(path)).read(0, "e")


STEPS = {"a": tensor((2,))}


def dataset(folder, count=5):
    records = [{"steps/a": np.full(4, i, np.float32)} for i in range(count)]
    rlds_files.write(folder, {"toy-train.array_record-00000-of-00001": []}, STEPS)
    (folder / "toy-train.array_record-00000-of-00001").write_bytes(made([encode(r) for r in records]))
    info = {
        "name": "toy",
        "fileFormat": "array_record",
        "splits": [{"name": "train", "shardLengths": [str(count)]}],
    }
    (folder / "dataset_info.json").write_text(json.dumps(info))
    return folder


@pytest.mark.parametrize("stated", [True, False])
def test_a_dataset_of_array_records_is_read_like_any(tmp_path, stated):
    folder = dataset(tmp_path / "d")
    if not stated:
        (folder / "dataset_info.json").unlink()
    refs = open_source("rlds").index(str(folder))
    assert detect(str(folder)) == "rlds"
    assert [(ref.id, ref.frames) for ref in refs] == [(f"train/{i:06d}", 2) for i in range(5)]
    assert len({ref.fingerprint for ref in refs}) == 5
    example, _ = open_folder(str(folder)).example("train/000004")
    assert example.numbers("steps/a").tolist() == [4, 4, 4, 4]


def test_over_a_remote_file_system(tmp_path):
    folder, files = dataset(tmp_path / "d"), fsspec.filesystem("memory")
    for path in folder.iterdir():
        files.pipe(f"/{tmp_path.name}/{path.name}", path.read_bytes())
    uri = f"memory://{tmp_path.name}"
    assert len(open_source("rlds").index(uri)) == 5
    assert open_folder(uri).example("train/000003")[0].numbers("steps/a").tolist() == [3] * 4


QUICK = settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
WHOLE = made(contents([40, 300, 5]))


@QUICK
@given(st.data())
def test_cut_or_flipped_anywhere_the_records_that_come_are_right(tmp_path, data):
    content = bytearray(WHOLE)
    used = [i for i in range(len(content)) if content[i] or i % 997 == 0]
    at = data.draw(st.sampled_from(used))
    if data.draw(st.booleans()):
        content[at] ^= data.draw(st.integers(1, 255))
    else:
        content = content[:at]
    path = tmp_path / "x.array_record"
    path.write_bytes(content)
    frames = array_record.scan(FILES, str(path), len(content))
    assert frames.fault or len(frames) == 3
    for i in range(len(frames)):
        try:
            assert array_record.read_record(FILES, str(path), frames, i, "e") == contents([40, 300, 5])[i]
        except EpisodeError as fault:
            assert str(path) in str(fault)


def test_a_cut_file_is_quarantined_episode_by_episode(tmp_path):
    folder = dataset(tmp_path / "d")
    path = next(folder.glob("*.array_record*"))
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(EpisodeError, match=r"no chunk|ends within|footer"):
        open_folder(str(folder)).example("train/000002")
    with pytest.raises(SourceError, match="no readable episode"):
        open_source("rlds").index(str(folder))


def test_a_chunk_that_claims_more_than_it_is_stays_small(tmp_path):
    bomb = zstandard.compress(bytes(200_000_000))
    data = b"z" + varint(4) + varint(3) + b"abc" + varint(200_000_000) + bomb
    with pytest.raises(ValueError, match="claims 200,000,000 bytes, its header says 50"):
        array_record._plain(varint(200_000_000) + bomb, ord("z"), 50)
    with pytest.raises(ValueError, match="contradict"):
        array_record._plain(varint(50) + bomb, ord("z"), 50)
    with pytest.raises(ValueError):
        array_record._simple(data, array_record.Header(len(data), 0, ord("r"), 1, 200_000_000))
