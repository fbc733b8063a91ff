"""ArrayRecord: files of its own writer, whole and cut."""

import sys

import fsspec
import numpy as np
import pytest
from array_record.python.array_record_module import ArrayRecordWriter

from hma_data.errors import EpisodeError, MissingDependencyError, SourceError
from hma_data.sources.base import open_source
from hma_data.sources.detect import detect
from hma_data.sources.rlds.folder import open_folder
from hma_data.sources.rlds.records import open_records
from tests.data import rlds_files
from tests.data.rlds_files import encode, tensor

SIZES = {"none": [], "empty": [0], "even": [10] * 30, "blocks": [200_000, 3, 0, 70_000, 65_512, 65_472] * 2}


def contents(sizes) -> list[bytes]:
    rng = np.random.default_rng(0)
    return [rng.integers(0, 256 if i % 2 else 3, n, np.uint8).tobytes() for i, n in enumerate(sizes)]


def write(path, records, options="group_size:1"):
    writer = ArrayRecordWriter(str(path), options)
    for record in records:
        writer.write(record)
    writer.close()
    return path


def read_all(path) -> list[bytes]:
    records = open_records(path)
    assert not records.framing().fault
    return [records.read(i, "e") for i in range(len(records.framing()))]


@pytest.mark.parametrize("sizes", SIZES)
@pytest.mark.parametrize(
    "options",
    [
        "group_size:1",
        "",
        "group_size:1,uncompressed",
        "group_size:3,zstd:9,pad_to_block_boundary:true",
        "group_size:1,transpose",
        "brotli",
        "snappy",
    ],
)
def test_records_are_read_as_they_were_put_in(tmp_path, sizes, options):
    path = write(tmp_path / "x.array_record", contents(SIZES[sizes]), options)
    assert read_all(path) == contents(SIZES[sizes])


STEPS = {"a": tensor((2,))}


def dataset(folder):
    name, records = (
        "toy-train.array_record-00000-of-00001",
        [{"steps/a": np.full(4, i, np.float32)} for i in range(5)],
    )
    rlds_files.write(folder, {name: records}, STEPS, file_format="array_record")
    write(folder / name, [encode(record) for record in records])
    return folder


def test_a_dataset_of_array_records_is_read_like_any(tmp_path):
    folder = dataset(tmp_path / "d")
    refs = open_source("rlds").index(str(folder))
    assert detect(str(folder)) == "rlds"
    assert [(ref.id, ref.frames) for ref in refs] == [(f"train/{i:06d}", 2) for i in range(5)]
    assert len({ref.fingerprint for ref in refs}) == 5
    example, _ = open_folder(str(folder)).example("train/000004")
    assert example.numbers("steps/a").tolist() == [4, 4, 4, 4]


def test_a_remote_dataset_of_array_records_is_refused(tmp_path):
    folder, files = dataset(tmp_path / "d"), fsspec.filesystem("memory")
    for path in folder.iterdir():
        files.pipe(f"/{tmp_path.name}/{path.name}", path.read_bytes())
    uri = f"memory://{tmp_path.name}"
    with pytest.raises(SourceError, match="ArrayRecord is read from local disks.*copy it here"):
        open_source("rlds").index(uri)


def test_without_the_package_the_error_says_how_to_install_it(tmp_path, monkeypatch):
    folder = dataset(tmp_path / "d")
    monkeypatch.setitem(sys.modules, "array_record.python.array_record_module", None)
    with pytest.raises(MissingDependencyError, match="uv sync --inexact --extra arrayrecord") as caught:
        open_source("rlds").index(str(folder))
    assert "\n" not in str(caught.value)


def test_a_cut_file_is_quarantined_episode_by_episode(tmp_path):
    folder = dataset(tmp_path / "d")
    path = next(folder.glob("*.array_record*"))
    path.write_bytes(path.read_bytes()[:-7])
    with pytest.raises(EpisodeError, match="chunk boundary"):
        open_folder(str(folder)).example("train/000002")
    with pytest.raises(SourceError, match="no readable episode"):
        open_source("rlds").index(str(folder))
