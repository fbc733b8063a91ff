"""The files of a recording that a recorder split: with metadata that names them, or only some, or without."""

import tempfile
from pathlib import Path
from typing import Any

import pytest
import zstandard

from hma_data.episodes.align import to_clip
from hma_data.errors import EpisodeError
from hma_data.sources.bags import bag
from hma_data.sources.bags import source as bags_source
from hma_data.sources.bags.clocks import SECOND_NS
from tests.data import ros2
from tests.data.bag_files import SOURCE
from tests.data.sources.bags.test_bag_pairing import at, pairs, robot

KINDS = ("db3", "mcap")
METADATA = "rosbag2_bagfile_information:\n  relative_file_paths: [{}]\n  topics_with_message_count: []\n"


def part(target: Path, frames: range, later_ns: int = 0, packed: bool = False) -> Path:
    messages = []
    for i in frames:
        ns = at(i) + later_ns
        messages += [("/cam", ros2.image(ns, i), ns), ("/cmd", ros2.array([i]), ns + 10**6)]
    folder = ros2.write(target.parent / "made", messages, mcap=".mcap" in target.name)
    (made,) = [item for item in folder.iterdir() if item.name != "metadata.yaml"]
    if packed:
        target.write_bytes(zstandard.ZstdCompressor().compress(made.read_bytes()))
    else:
        made.rename(target)
    for rest in folder.iterdir():
        rest.unlink()
    folder.rmdir()
    return target


def split(folder: Path, suffix: str, count: int = 12, pause_ns: int = 0, packed: bool = False) -> Path:
    """Twelve parts by default, so that their numbers sort otherwise than their names."""
    folder.mkdir()
    for k in range(count):
        part(folder / f"rec_{k}.{suffix}", range(3 * k, 3 * k + 3), k * pause_ns, packed)
    return folder


def same(count: int) -> list[tuple[int, int]]:
    return [(i, i) for i in range(count)]


@pytest.mark.parametrize("kind", KINDS)
def test_parts_without_metadata_are_one_recording_and_that_is_said(kind: str, tmp_path: Path, caplog) -> None:
    folder = split(tmp_path / "run", kind)
    (ref,) = SOURCE.index(str(folder), robot())
    assert (ref.id, ref.frames) == ("rec", 36)
    assert pairs(folder, robot(), "rec") == same(36)
    (line,) = {record.message for record in caplog.records}
    assert line.startswith(f"rec_0.{kind} to rec_11.{kind} follow each other") and "12 files" in line
    found = SOURCE.inspect(str(folder))
    assert (found.episodes, found.frames) == (1, 36)
    assert any("one recording" in one.message for one in found.findings)


@pytest.mark.parametrize("kind", KINDS)
def test_numbered_episodes_with_pauses_between_stay_apart(kind: str, tmp_path: Path) -> None:
    folder = split(tmp_path / "run", kind, 3, pause_ns=2 * SECOND_NS)
    assert SOURCE.episode_ids(str(folder)) == ["rec_0", "rec_1", "rec_2"]


def test_a_part_given_alone_is_read_alone_and_a_missing_one_divides_the_recording(tmp_path: Path) -> None:
    folder = split(tmp_path / "run", "mcap", 5)
    assert len(pairs(folder / "rec_1.mcap", robot(), "rec_1")) == 3
    (folder / "rec_2.mcap").unlink()
    ids = SOURCE.episode_ids(str(folder))
    assert len(ids) == 2
    found = [pairs(folder, robot(), name) for name in ids]
    assert sorted(found) == [same(6), [(i, i) for i in range(9, 15)]]


def test_a_part_that_is_there_packed_too_does_not_hide_the_others(tmp_path: Path) -> None:
    folder = split(tmp_path / "run", "mcap", 3)
    part(folder / "rec_1.mcap.zstd", range(3, 6), packed=True)
    assert SOURCE.episode_ids(str(folder)) == ["rec", "rec_1.mcap"]
    assert pairs(folder, robot(), "rec") == same(9)


def test_a_folder_is_listed_once_for_all_its_bags(tmp_path: Path, monkeypatch) -> None:
    folder = split(tmp_path / "run", "mcap", 6, pause_ns=2 * SECOND_NS)
    listed: list[Path] = []
    named: list[str] = []  # the hub's file system lists all folders again when a place is named
    find, existing = bags_source.find_bags, bags_source.existing_path
    monkeypatch.setattr(bags_source, "find_bags", lambda path: listed.append(path) or find(path))
    monkeypatch.setattr(bags_source, "existing_path", lambda uri: named.append(uri) or existing(uri))
    source = bags_source.open()
    for number in range(6):
        assert len(to_clip(source.read(str(folder), f"rec_{number}", robot()), robot())) == 3
    assert listed == [folder] and named == [str(folder)]
    part(folder / "rec_6.mcap", range(18, 21), 12 * SECOND_NS)  # a bag that is not known is looked for
    assert len(to_clip(source.read(str(folder), "rec_6", robot()), robot())) == 3


def test_an_inspection_keeps_few_bags_unpacked_and_unpacks_the_only_one_once(tmp_path, monkeypatch) -> None:
    kept: list[int] = []
    unpack, temporary = bag._unpack_file, tmp_path / "temporary"

    def counted(*args: Any) -> None:
        unpack(*args)
        kept.append(len(list(temporary.iterdir())))

    temporary.mkdir()
    monkeypatch.setattr(tempfile, "tempdir", str(temporary))
    monkeypatch.setattr(bag, "_unpack_file", counted)
    folder = split(tmp_path / "run", "mcap.zstd", 8, pause_ns=2 * SECOND_NS, packed=True)
    bags_source.find_bags(folder)  # to tell that no bag continues another, each is unpacked
    kept.clear()
    found = SOURCE.inspect(str(folder), 4)
    assert (found.episodes, found.frames, found.lengths) == (8, 24, (3,) * 8)
    assert len(kept) == 8 + 4 and max(kept) <= 3  # the first of the sample, the one before, and this one
    kept.clear()
    assert SOURCE.inspect(str(folder / "rec_5.mcap.zstd")).frames == 3
    assert len(kept) == 1


@pytest.mark.parametrize("kind", KINDS)
def test_stale_metadata_leaves_no_part_out(kind: str, tmp_path: Path, caplog) -> None:
    folder = split(tmp_path / "run", kind)
    (folder / "metadata.yaml").write_text(METADATA.format(f"rec_0.{kind}"))
    assert SOURCE.index(str(folder), robot())[0].frames == 36
    assert pairs(folder, robot(), "run") == same(36)
    assert any("names 1 of its 12 files: all are read" in record.message for record in caplog.records)
    assert any("names 1 of its 12" in problem for problem in SOURCE.inspect(str(folder)).problems)


def test_metadata_are_parsed_once_until_they_change(tmp_path: Path, monkeypatch) -> None:
    parsed: list[Path] = []
    read = bag.read_yaml
    monkeypatch.setattr(bag, "read_yaml", lambda path, error: parsed.append(path) or read(path, error))
    folder = split(tmp_path / "run", "mcap", 2)
    for names, frames in (("rec_0.mcap, rec_1.mcap", 6), ("rec_0.mcap", 6), ("gone.mcap", 0)):
        (folder / "metadata.yaml").write_text(METADATA.format(names))
        parsed.clear()
        source = bags_source.open()
        for _ in range(3):
            assert source.index(str(folder), robot())[0].frames == frames
        assert parsed == [folder / "metadata.yaml"]
    (folder / "metadata.yaml").unlink()
    with pytest.raises(EpisodeError, match="metadata.yaml"):
        bag.Bag(folder)


def test_a_file_of_another_name_is_left_out_and_named(tmp_path: Path) -> None:
    folder = split(tmp_path / "run", "db3", 2)
    (folder / "metadata.yaml").write_text(METADATA.format("rec_0.db3, rec_1.db3"))
    part(folder / "backup.db3", range(40, 43))
    assert pairs(folder, robot(), "run") == same(6)
    (problem,) = SOURCE.inspect(str(folder)).problems
    assert "does not name backup.db3: left out" in problem


@pytest.mark.parametrize("named", ["rec_{}.db3", "rec_{}.db3.zstd", "old/rec_{}.db3"])
@pytest.mark.parametrize("stale", [False, True])
def test_packed_parts_are_found_by_either_name(named: str, stale: bool, tmp_path: Path) -> None:
    folder = split(tmp_path / "run", "db3.zstd", 2, packed=True)
    names = [named.format(k) for k in range(1 if stale else 2)]
    (folder / "metadata.yaml").write_text(METADATA.format(", ".join(names)))
    assert pairs(folder, robot(), "run") == same(6)
