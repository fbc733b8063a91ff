"""Several episodes in one bag: by pauses, by messages."""

import tracemalloc
from pathlib import Path

import numpy as np
import pytest

from hma_data.conversion.plan import Settings
from hma_data.episodes.align import to_clip
from hma_data.errors import EpisodeError, SourceError
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from hma_data.sources.bags import segments
from tests.command import hma
from tests.conftest import convert_toy
from tests.data.bag_files import SOURCE, START_NS
from tests.data.bag_parts import KINDS, STATE, TASK, Said, make_run, parted, ros1

GAP = "{gap_s: 1}"
RECORDING = "{start: {key: /state.data, equals: true}, stop: {key: /state.data, equals: false}}"


def states(*changes: tuple[float, bool]) -> list[Said]:
    said = []
    for at in np.arange(0, 7, 0.2).tolist():
        value = [value for since, value in ((-1, False), *changes) if since <= at + 1e-6][-1]
        said.append(Said(STATE, at + 0.01, value))
    return said


def lengths(path: Path, embodiment: Embodiment) -> list[int]:
    return [ref.frames for ref in SOURCE.index(str(path), embodiment)]


@pytest.mark.parametrize("kind", KINDS)
def test_a_pause_parts_every_kind_of_bag(kind: str, tmp_path: Path) -> None:
    run = make_run(60, pause_after=(25, 40))
    path = KINDS[kind](tmp_path, run)
    refs = SOURCE.index(str(path), parted(GAP))
    assert [(ref.id, ref.frames, ref.group) for ref in refs] == [
        ("run/0000", 25, "run"), ("run/0001", 15, "run"), ("run/0002", 20, "run"),
    ]  # fmt: skip
    assert len({ref.fingerprint for ref in refs}) == 1 and refs[0].fingerprint
    for ref, (begin, stop) in zip(refs, [(0, 25), (25, 40), (40, 60)], strict=True):
        episode = SOURCE.read(str(path), ref.id, parted(GAP))
        stream = episode.streams["cam"]
        np.testing.assert_array_equal(stream.frames(range(stop - begin)), run.pictures[begin:stop])
        np.testing.assert_allclose(stream.timestamps, START_NS / 1e9 + run.times[begin:stop], atol=1e-6)
        assert episode.id == ref.id


def test_a_bag_of_which_a_limited_set_has_a_part_stays_in_one_split(tmp_path: Path) -> None:
    (tmp_path / "bags").mkdir()
    for name in "abc":
        ros1(tmp_path, make_run(30, pause_after=(15,))).rename(tmp_path / "bags" / f"{name}.bag")
    for limit, extend in ((3, False), (None, True)):
        convert_toy(parted(GAP), tmp_path / "bags", tmp_path / "out", Settings(limit=limit), extend=extend)
    rows = ShardSet(tmp_path / "out").episodes.to_pylist()
    splits = {(row["group"], row["split"]) for row in rows}
    assert splits == {("a", "train"), ("b", "val"), ("c", "val")}


@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("segments", [GAP, RECORDING])
def test_an_episode_in_a_bag_is_that_part_of_the_whole(kind: str, segments: str, tmp_path: Path) -> None:
    """Commands in force, also one said long before, are those of the bag read as one episode."""
    run = make_run(60, pause_after=(30,), said=states((1.0, True), (2.4, False), (6.2, True)))
    path = KINDS[kind](tmp_path, run)
    embodiment = parted(segments)
    whole = to_clip(SOURCE.read(str(path), "run", embodiment), embodiment)
    assert len(whole) == 60
    for ref in SOURCE.index(str(path), embodiment):
        clip = to_clip(SOURCE.read(str(path), ref.id, embodiment), embodiment)
        (first,) = np.flatnonzero(
            [np.array_equal(one, clip.frames_at("cam", np.arange(1))[0]) for one in run.pictures]
        )
        assert len(clip) == ref.frames
        np.testing.assert_array_equal(clip.actions, whole.actions[first : first + ref.frames])
        np.testing.assert_array_equal(clip.actions[:, 1], np.float32(0.7))
        np.testing.assert_array_equal(clip.frames_at("cam", np.arange(2)), run.pictures[first : first + 2])


def test_start_and_stop_are_the_moments_at_which_a_value_becomes_theirs(tmp_path: Path) -> None:
    path = ros1(tmp_path, make_run(60, said=states((1.0, True), (2.4, False), (4.0, True))))
    refs = SOURCE.index(str(path), parted(RECORDING))
    assert [ref.frames for ref in refs] == [
        14,
        19,
    ]  # pictures received between 1.01 and 2.41 s, and from 4.01 s
    assert {ref.left_out for ref in refs} == {27}
    (tmp_path / "arm.yaml").write_text(parted(RECORDING).to_yaml())
    words = ["convert", "-e", tmp_path / "arm.yaml", "--source", path, "--tokenizer", "fsq-8", "--dry-run"]
    planned = hma(*words, "--out", tmp_path / "out")
    assert "in no episode: 27 recorded frames" in planned.stdout


@pytest.mark.parametrize(
    ("segments", "expected", "left_out"),
    [
        ("{start: {key: /task}}", [20, 30], 10),  # what comes before the first start is in none
        ("{stop: {key: /task}}", [10, 20, 30], 0),
        ("{start: {key: /task.data, equals: go}}", [30], 30),
        ("{start: {key: /task.data, equals: wait}, stop: {key: /task.data, equals: go}}", [20], 40),
        ("{start: {key: /task}, gap_s: 1}", [20, 15, 15], 10),
        ("{gap_s: 10}", [60], 0),
    ],
)
def test_markers_and_pauses_part_as_their_description_says(segments, expected, left_out, tmp_path) -> None:
    said = [Said(TASK, 0.99, "wait"), Said(TASK, 2.99, "go")]
    path = ros1(tmp_path, make_run(60, pause_after=(45,), said=said))
    refs = SOURCE.index(str(path), parted(segments))
    assert [ref.frames for ref in refs] == expected
    assert {ref.left_out for ref in refs} == {left_out}


def test_a_clock_that_begins_anew_parts_episodes_and_keeps_commands_apart(tmp_path: Path) -> None:
    times = np.arange(40) / 10
    stamps = np.concatenate([times[:20] + 100, times[:20]])
    run = make_run(40, stamps=stamps)
    stamped = (
        parted(GAP, "").to_yaml().replace("key: /command.data", "key: /command.data\n    stamp: receive")
    ).replace("key: /cam\n", "key: /cam\n  stamp: header\n")  # the gripper's clock is another
    path = ros1(tmp_path, run)
    episode = SOURCE.read(str(path), "run/0001", Embodiment.from_yaml(stamped))
    np.testing.assert_allclose(episode.streams["cam"].timestamps, START_NS / 1e9 + stamps[20:], atol=1e-6)
    assert lengths(path, parted(GAP)) == [20, 20]


def test_receive_times_part_where_the_embodiment_says_so(tmp_path: Path) -> None:
    run = make_run(40, pause_after=(20,), stamps=np.arange(40) / 10)  # stamped without the pause
    path = ros1(tmp_path, run)
    forced = parted(GAP).to_yaml() + "\nsync: {stamp: receive}\n"
    assert lengths(path, parted(GAP)) == [40]
    assert lengths(path, Embodiment.from_yaml(forced)) == [20, 20]


@pytest.mark.parametrize(
    ("segments", "says"),
    [
        (RECORDING, r"/state\.data never becomes True, it is False"),
        ("{start: {key: /task}}", r"no topic for /task"),
        ("{start: {key: /state.dato, equals: true}}", r"no field 'dato'.*data"),
        ("{start: {key: /state.data, equals: on}}", r"never becomes True|cannot equal"),
        ("{start: {key: /command.data, equals: go}}", r"is 0\.0, which cannot equal 'go'"),
        ("{start: {key: /late}}", "no topic for /late"),
    ],
)
def test_a_bag_without_an_episode_is_told_with_what_came(segments: str, says: str, tmp_path: Path) -> None:
    path = ros1(tmp_path, make_run(20, said=states()))
    embodiment = parted(segments)
    (ref,) = SOURCE.index(str(path), embodiment)
    assert (ref.id, ref.frames) == ("run", 0)
    with pytest.raises(EpisodeError, match=says) as fault:
        SOURCE.read(str(path), ref.id, embodiment)
    assert "\n" not in str(fault.value)


def test_a_marker_after_the_last_picture_begins_no_episode(tmp_path: Path) -> None:
    path = ros1(tmp_path, make_run(20, said=[Said(TASK, 50.0, "go")]))
    with pytest.raises(EpisodeError, match="no episode in it holds a frame of /cam"):
        SOURCE.read(str(path), "run", parted("{start: {key: /task}}"))


def test_an_episode_that_is_not_there_is_told_with_those_that_are(tmp_path: Path) -> None:
    path = ros1(tmp_path, make_run(20, pause_after=(10,)))
    for name in ("run/0002", "run/1", "run/-001", "other/0000", "run/x", "run/"):
        with pytest.raises(SourceError, match=f"has no (episode|bag) '{name}'"):
            SOURCE.read(str(path), name, parted(GAP))
    unparted = Embodiment.from_yaml(parted(GAP).to_yaml().replace("  segments:\n    gap_s: 1.0\n", ""))
    with pytest.raises(SourceError, match="has no bag 'run/0000'"):
        SOURCE.read(str(path), "run/0000", unparted)


def test_each_episode_has_the_instruction_said_nearest_to_its_beginning(tmp_path: Path) -> None:
    said = [Said(TASK, 0.0, "reach"), Said(TASK, 4.9, "push"), Said(TASK, 10.1, "pull")]
    path = ros1(tmp_path, make_run(60, pause_after=(20, 40), said=said))
    embodiment = parted(GAP, ", instruction: /task.data")
    refs = SOURCE.index(str(path), embodiment)
    told = [SOURCE.read(str(path), ref.id, embodiment).instruction for ref in refs]
    assert told == ["reach", "push", "pull"]


@pytest.mark.parametrize("episode_id, first", [("run", "0 "), ("run/0001", "1201 ")])
def test_memory_does_not_grow_with_what_is_said(tmp_path: Path, episode_id: str, first: str) -> None:
    said = [Said(TASK, 0.005 * i, f"{i} {'push ' * 4000}") for i in range(1600)]
    path = ros1(tmp_path, make_run(60, pause_after=(30,), said=said), chunk=1 << 16)
    embodiment = parted(GAP, ", instruction: /task.data")
    SOURCE.read(str(path), episode_id, embodiment)  # what is kept of the bag is in memory now
    tracemalloc.start()
    told = SOURCE.read(str(path), episode_id, embodiment).instruction
    peak = tracemalloc.get_traced_memory()[1]
    tracemalloc.stop()
    assert told.startswith(first) and peak < 0.4 * sum(len(one.value) for one in said)


def read_bytes() -> int:
    for line in Path("/proc/self/io").read_text().splitlines():
        if line.startswith("rchar"):
            return int(line.split()[1])
    raise AssertionError


needs_io = pytest.mark.skipif(not Path("/proc/self/io").exists(), reason="counts of bytes read need Linux")
LONG = tuple(range(10, 100, 10))
INDEXED = [kind for kind in KINDS if "index" not in kind]


def written(kind: str, folder: Path) -> tuple[Path, int]:
    path = KINDS[kind](folder, make_run(100, pause_after=LONG, side=160))
    files = [path] if path.is_file() else list(path.iterdir())
    return path, sum(file.stat().st_size for file in files)


@needs_io
@pytest.mark.parametrize("kind", INDEXED)
def test_an_episode_costs_about_its_own_bytes(kind: str, tmp_path: Path) -> None:
    path, size = written(kind, tmp_path)
    refs = SOURCE.index(str(path), parted(GAP))
    assert len(refs) == 10
    before = read_bytes()
    stream = SOURCE.read(str(path), refs[6].id, parted(GAP)).streams["cam"]
    stream.frames(range(10))
    assert read_bytes() - before < size / 2  # a tenth is read twice, and what is around it


@needs_io
@pytest.mark.parametrize("kind", INDEXED)
def test_a_bag_is_searched_for_its_episodes_once_on_a_machine(kind: str, tmp_path: Path, monkeypatch) -> None:
    path, size = written(kind, tmp_path)
    refs = SOURCE.index(str(path), parted(GAP))
    monkeypatch.setattr(segments, "_kept", {})  # as in another process
    before = read_bytes()
    assert SOURCE.index(str(path), parted(GAP)) == refs
    # The fingerprint reads up to three samples of 64 KiB.
    assert read_bytes() - before < size / 10 + 3 * 65536


def test_a_bag_that_changes_is_parted_anew(tmp_path: Path) -> None:
    path = ros1(tmp_path, make_run(40, pause_after=(20,)))
    assert lengths(path, parted(GAP)) == [20, 20]
    path.unlink()
    ros1(tmp_path, make_run(40, pause_after=(30,)))
    assert lengths(path, parted(GAP)) == [30, 10]
