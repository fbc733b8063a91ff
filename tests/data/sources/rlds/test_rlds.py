"""RLDS: what is read equals what an independent writer wrote, and damage is contained."""

import json
import logging
import shutil
import struct
import zlib
from pathlib import Path

import cv2
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from hma_data.episodes.align import to_clip
from hma_data.errors import EpisodeError, HMAError, SourceError
from hma_data.registry.embodiment import Embodiment, find
from hma_data.sources.base import open_source
from hma_data.sources.detect import detect
from hma_data.sources.rlds.example import Example
from tests.data import rlds_files
from tests.data.rlds_files import (
    PROTO,
    SHARD,
    TEXT,
    encode,
    features_dict,
    frame,
    image,
    png,
    sequence,
    tensor,
)

STEPS = {
    "observation": features_dict({"image": image((8, 10, 3)), "state": tensor((3,), "float64")}),
    "action": features_dict({"move": tensor((2,)), "grip": tensor((), "bool")}),
    "language_instruction": TEXT,
    "reward": tensor(),
    "is_terminal": tensor((), "bool"),
}


def pictures(episode: int, steps: int) -> np.ndarray:
    return np.random.default_rng(episode).integers(0, 256, (steps, 8, 10, 3), np.uint8)


def record(episode: int, steps: int) -> dict:
    return {
        "steps/observation/image": [png(picture) for picture in pictures(episode, steps)],
        "steps/observation/state": np.arange(steps * 3, dtype=np.float64) + episode,
        "steps/action/move": np.arange(steps * 2, dtype=np.float32) / 7 - episode,
        "steps/action/grip": [step % 2 for step in range(steps)],
        "steps/language_instruction": [f"lift é {episode}".encode()] * steps,
        "steps/reward": [0.0] * (steps - 1) + [1.0],
        "steps/is_terminal": [0] * (steps - 1) + [1],
        "episode_metadata/file_path": [f"/robot/{episode}".encode()],
    }


def write(folder: Path, shards: dict, steps=None, metadata=None) -> Path:
    return rlds_files.write(folder, shards, steps or STEPS, metadata)


def toy(folder: Path, lengths=(4, 3, 5)) -> Path:
    return write(folder, {SHARD: [record(i, steps) for i, steps in enumerate(lengths)]})


def embodiment(**changes) -> Embodiment:
    values = {
        "id": "toy", "kind": "real", "frequency_hz": 5,
        "action": {"space": "mixed", "components": [
            {"key": "action/move", "dims": 2}, {"key": "action/grip", "dims": 1, "sign": -1, "offset": 1}]},
        "state": {"components": [{"key": "observation/state", "dims": 2, "slice": [1, 3]}]},
        "cameras": [{"name": "primary", "key": "observation/image"}],
        "source": {"format": "rlds"},
    }  # fmt: skip
    return Embodiment.from_values(values | changes, "toy.yaml")


def numbers_only(**components) -> Embodiment:
    return embodiment(action={"space": "mixed", "components": [components]}, state=None)


RLDS = open_source("rlds")


def read(folder, name, robot=None):
    return RLDS.read(str(folder), name, robot or embodiment())


# -- what is read


def test_an_episode_is_read_as_it_was_written(tmp_path):
    folder = toy(tmp_path / "toy" / "1.0.0")
    episode = read(folder, "train/000002")
    grip = 1 - np.arange(5) % 2
    expected = np.column_stack([(np.arange(10, dtype=np.float32) / 7 - 2).reshape(5, 2), grip])
    np.testing.assert_array_equal(episode.actions[0].values, expected.astype(np.float32))
    np.testing.assert_array_equal(episode.states[0].values, (np.arange(15) + 2).reshape(5, 3)[:, 1:])
    np.testing.assert_allclose(episode.actions[0].timestamps, np.arange(5) / 5)
    np.testing.assert_array_equal(episode.streams["primary"].frames([3, 0]), pictures(2, 5)[[3, 0]])
    assert (episode.instruction, episode.success) == ("lift é 2", True)
    assert len(to_clip(episode, embodiment())) == 5


def test_pictures_are_decoded_only_when_asked_for(tmp_path):
    broken = record(0, 3) | {"steps/observation/image": [b"junk", png(pictures(0, 3)[1]), b""]}
    stream = read(write(tmp_path / "d", {SHARD: [broken]}), "train/000000").streams["primary"]
    np.testing.assert_array_equal(stream.frames([1])[0], pictures(0, 3)[1])
    for index in (0, 2):
        with pytest.raises(EpisodeError, match=f"step {index}.*cannot be decoded"):
            stream.frames([index])


@pytest.mark.parametrize(
    "dtype", ["float16", "float32", "float64", "int8", "int64", "uint8", "uint64", "bool"]
)
@pytest.mark.parametrize("encoding", ["none", "bytes", "zlib"])
def test_tensors_of_every_dtype_and_encoding(tmp_path, dtype, encoding):
    values = np.array([[0, 1, 100], [3, 127, 2]]).astype(dtype)
    stored = values.astype(np.float32 if np.dtype(dtype).kind == "f" else np.int64)
    if encoding != "none":
        blobs = [row.tobytes() for row in values]
        stored = blobs if encoding == "bytes" else [zlib.compress(blob) for blob in blobs]
    steps = {"observation": STEPS["observation"], "a": tensor((3,), dtype, encoding)}
    folder = write(tmp_path / "d", {SHARD: [record(0, 2) | {"steps/a": stored}]}, steps)
    actions = read(folder, "train/000000", numbers_only(key="a", dims=3)).actions[0].values
    np.testing.assert_array_equal(actions, values.astype(np.float32))


def test_raw_pictures_kept_as_tensors(tmp_path):
    raw = pictures(5, 2)
    steps = STEPS | {"plain": tensor((8, 10, 3), "uint8"), "packed": tensor((8, 10, 3), "uint8", "zlib")}
    stored = {"steps/plain": raw.astype(np.int64), "steps/packed": [zlib.compress(p.tobytes()) for p in raw]}
    folder = write(tmp_path / "d", {SHARD: [record(0, 2) | stored]}, steps)
    cameras = [{"name": "a", "key": "plain"}, {"name": "b", "key": "packed"}]
    episode = read(folder, "train/000000", embodiment(cameras=cameras))
    for stream in episode.streams.values():
        np.testing.assert_array_equal(stream.frames([1, 0]), raw[::-1])


def test_a_nested_sequence_of_one_length_is_a_vector_and_a_varying_one_is_refused(tmp_path):
    steps = STEPS | {"goal": sequence(tensor((2,))), "found": sequence(tensor((), "int32"))}
    stored = {
        "steps/goal/ragged_flat_values": np.arange(12, dtype=np.float32),
        "steps/goal/ragged_row_lengths_0": [3, 3],
        "steps/found/ragged_flat_values": [1, 2, 3],
        "steps/found/ragged_row_lengths_0": [1, 2],
    }
    folder = write(tmp_path / "d", {SHARD: [record(0, 2) | stored]}, steps)
    episode = read(folder, "train/000000", numbers_only(key="goal", dims=6))
    np.testing.assert_array_equal(episode.actions[0].values, np.arange(12).reshape(2, 6))
    with pytest.raises(EpisodeError, match="varies from 1 to 2"):
        read(folder, "train/000000", numbers_only(key="found", dims=2))


def test_inspect_tells_of_a_key_of_varying_length_as_a_finding(tmp_path, caplog, capsys):
    steps = STEPS | {"found": sequence(tensor((), "int32"))}
    stored = {"steps/found/ragged_flat_values": [1, 2, 3], "steps/found/ragged_row_lengths_0": [0, 3]}
    folder = write(tmp_path / "d", {SHARD: [record(0, 2) | stored]}, steps)
    told = [one for one in RLDS.inspect(str(folder)).findings if one.key == "found"]
    assert [(one.check, one.severity) for one in told] == [("rows", "info")]
    assert "found varies from 0 to 3 entries per step" in told[0].message
    assert not caplog.records and capsys.readouterr().err == ""


@pytest.mark.parametrize(
    "texts", [["lift", "raise", "pick up"] * 2, ["", "lift"]], ids=["three a step", "late"]
)
def test_of_several_instructions_the_first_counts(tmp_path, texts):
    steps = STEPS | ({"language_instruction": tensor((3,), "string")} if len(texts) > 2 else {})
    item = record(0, 2) | {"steps/language_instruction": [text.encode() for text in texts]}
    folder = write(tmp_path / "d", {SHARD: [item]}, steps)
    assert read(folder, "train/000000").instruction == "lift"


@pytest.mark.parametrize("key", [None, "observation/instruction"])
def test_an_instruction_kept_as_letter_codes(tmp_path, key):
    steps = STEPS | {
        "observation": features_dict({"image": image((8, 10, 3)), "instruction": tensor((12,), "int32")})
    }
    del steps["language_instruction"]
    codes = np.array([*"push é".encode(), 0, 0, 0, 0, 0])
    stored = record(0, 2) | {"steps/observation/instruction": np.tile(codes, 2)}
    folder = write(tmp_path / "d", {SHARD: [stored]}, steps)
    robot = embodiment(source={"format": "rlds", "instruction": key}, state=None)
    assert read(folder, "train/000000", robot).instruction == ("push é" if key else "")


@pytest.mark.parametrize(("stated", "expected"), [(1, True), (0, False)])
def test_success_as_the_episode_states_it(tmp_path, stated, expected):
    item = record(0, 2) | {"episode_metadata/success": [stated]}
    metadata = {"success": tensor((), "bool")}
    folder = write(tmp_path / "d", {SHARD: [item]}, metadata=metadata)
    assert read(folder, "train/000000").success is expected


@pytest.mark.parametrize("ends", [{"steps/is_terminal": [0, 0]}, {"steps/reward": [0.2, 0.7]}])
def test_success_is_unknown_without_a_rewarded_terminal_step_or_with_dense_rewards(tmp_path, ends):
    folder = write(tmp_path / "d", {SHARD: [record(0, 2) | ends]})
    assert read(folder, "train/000000").success is None


# -- folders, shards, splits


def test_ids_run_over_the_shards_of_a_split_whatever_the_template(tmp_path):
    names = ["toy-train.tfrecord-00000-of-00002", "toy-train.tfrecord-00001-of-00002"]
    records = [record(i, 2) for i in range(5)]
    folder = write(tmp_path / "d", {names[0]: records[:3], names[1]: records[3:]})
    assert RLDS.episode_ids(str(folder)) == [f"train/{i:06d}" for i in range(5)]
    assert read(folder, "train/000004").instruction == "lift é 4"

    moved = tmp_path / "e"
    shutil.copytree(folder, moved)
    (moved / "train").mkdir()
    for i, name in enumerate(names):
        (moved / name).rename(moved / "train" / f"part.tfrecord-{i:05d}")
    info = json.loads((moved / "dataset_info.json").read_text())
    info["splits"][0]["filepathTemplate"] = "{SPLIT}/part.{FILEFORMAT}-{SHARD_INDEX}"
    (moved / "dataset_info.json").write_text(json.dumps(info))
    assert read(moved, "train/000004").instruction == "lift é 4"


def test_the_sources_own_splits(tmp_path):
    names = [f"toy-{split}.tfrecord-00000-of-00001" for split in ("train", "test")]
    folder = write(tmp_path / "d", {name: [record(0, 2)] for name in names})
    assert [(ref.id, ref.split) for ref in RLDS.index(str(folder))] == [
        ("train/000000", "train"), ("test/000000", "val"),
    ]  # fmt: skip
    assert {ref.split for ref in RLDS.index(str(toy(tmp_path / "of one split")))} == {None}
    chosen = embodiment(source={"format": "rlds", "split": "test"})
    assert [(ref.id, ref.split) for ref in RLDS.index(str(folder), chosen)] == [("test/000000", None)]
    with pytest.raises(SourceError, match=r"no split 'dev'.*train, test"):
        RLDS.index(str(folder), embodiment(source={"format": "rlds", "split": "dev"}))


@pytest.mark.parametrize("long_text", [1, 2])
def test_the_plan_of_a_small_dataset_has_as_many_frames_as_its_inspection(tmp_path, long_text):
    records = [record(0, 10), record(1, 20), record(2, 5)]
    records[long_text]["episode_metadata/file_path"] = [b"x" * 50_000]
    folder = str(write(tmp_path / "d", {SHARD: records}))
    assert [ref.frames for ref in RLDS.index(folder)] == [10, 20, 5]
    assert RLDS.inspect(folder).frames == 35


def test_frames_of_a_large_dataset_are_estimated_from_bytes(tmp_path, monkeypatch):
    monkeypatch.setattr("hma_data.sources.rlds.source.COUNTED_EPISODES", 2)
    refs = RLDS.index(str(toy(tmp_path / "d", (10, 20, 5))))
    assert refs[0].frames == 10
    assert all(abs(ref.frames - true) <= 1 for ref, true in zip(refs, (10, 20, 5), strict=True))


def test_fingerprints_follow_the_content(tmp_path):
    first = RLDS.index(str(toy(tmp_path / "a", (2, 3))))
    second = RLDS.index(str(toy(tmp_path / "b", (2, 4))))
    assert first[0].fingerprint == second[0].fingerprint
    assert first[1].fingerprint != second[1].fingerprint


def test_the_uri_may_name_the_dataset_the_version_or_one_shard(tmp_path):
    version = toy(tmp_path / "toy" / "1.0.0")
    shard = version / SHARD
    for uri in (version.parent, version, shard, f"file://{version}"):
        assert len(RLDS.episode_ids(str(uri))) == 3
    toy(tmp_path / "toy" / "2.0.0")
    with pytest.raises(SourceError, match=r"several datasets or versions: 1\.0\.0, 2\.0\.0"):
        RLDS.episode_ids(str(version.parent))


def test_the_version_folder_is_looked_for_again_by_an_index(tmp_path):
    folder = toy(tmp_path / "data" / "toy" / "1.0.0")
    assert read(tmp_path / "data", "train/000002").id == "train/000002"
    for again in (folder.parent / "2.0.0", tmp_path / "data" / "other"):
        shutil.copytree(folder, again)
        with pytest.raises(SourceError, match=f"several datasets or versions: .*{again.name}"):
            RLDS.index(tmp_path / "data")
        shutil.rmtree(again)
        assert len(RLDS.index(tmp_path / "data")) == 3
    newer = toy(tmp_path / "made", (7,)).rename(folder.parent / "2.0.0")
    shutil.rmtree(folder)
    assert len(RLDS.index(tmp_path / "data")) == 1
    assert len(read(tmp_path / "data", "train/000000").actions[0].values) == 7
    assert read(newer, "train/000000").source == read(tmp_path / "data", "train/000000").source


def test_missing_shards_keep_the_ids_of_the_others(tmp_path, caplog):
    names = [f"toy-train.tfrecord-{i:05d}-of-00003" for i in range(3)]
    folder = write(tmp_path / "d", {name: [record(i, 2), record(i, 3)] for i, name in enumerate(names)})
    (folder / names[1]).unlink()
    with caplog.at_level(logging.WARNING):
        assert RLDS.episode_ids(str(folder)) == [f"train/{i:06d}" for i in (0, 1, 4, 5)]
    assert "1 of 3 shards of split train" in caplog.text
    assert read(folder, "train/000005").instruction == "lift é 2"
    with pytest.raises(EpisodeError, match="is in no shard"):
        read(folder, "train/000002")


def test_a_split_without_its_files_is_told(tmp_path):
    names = [f"toy-{split}.tfrecord-00000-of-00001" for split in ("train", "test")]
    folder = write(tmp_path / "d", {name: [record(0, 2)] for name in names})
    (folder / names[1]).unlink()
    assert "split test of 1 episodes is missing" in RLDS.inspect(str(folder)).problems
    assert not RLDS.inspect(str(folder / names[0])).problems  # named by itself, the rest is not missed


# -- inspection


def test_inspection_lists_every_key_of_a_step(tmp_path):
    found = RLDS.inspect(str(toy(tmp_path / "d")))
    assert (found.episodes, found.frames, found.lengths, found.problems) == (3, 12, (4, 3, 5), ())
    keys = {key.key: (key.kind, key.shape, key.dtype, key.codec) for key in found.keys}
    assert keys["observation/image"] == ("camera", (8, 10, 3), "uint8", "png")
    assert keys["observation/state"] == ("vector", (3,), "float64", None)
    assert keys["action/grip"] == ("vector", (), "bool", None)
    assert keys["language_instruction"][0] == "text"
    assert found.facts["splits"] == "train 3"


# -- what is refused


@pytest.mark.parametrize("name", ["train/000009", "train/-1", "test/000000", "train", "../x/000000", ""])
def test_an_unknown_episode(tmp_path, name):
    with pytest.raises(EpisodeError):
        read(toy(tmp_path / "d"), name)


# -- damage anywhere


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    folder = toy(tmp_path_factory.mktemp("whole") / "d", (3, 2, 3))
    actions = {name: read(folder, name).actions[0].values for name in RLDS.episode_ids(str(folder))}
    return folder, next(folder.glob("*.tfrecord*")).read_bytes(), actions


def _read_damaged(whole, data: bytes, tmp_path_factory) -> set[str]:
    """Ids that could be read, each checked to be as it was; the others raised EpisodeError."""
    folder, _, actions = whole
    copy = tmp_path_factory.mktemp("damaged")
    for name in ("features.json", "dataset_info.json"):
        shutil.copy(folder / name, copy)
    (copy / SHARD).write_bytes(data)
    try:
        ids = RLDS.episode_ids(str(copy))
    except SourceError as fault:
        assert "holds no readable episode" in str(fault) or "gzip" in str(fault)
        return set()
    assert ids == list(actions)
    good = set()
    for name in ids:
        try:
            episode = read(copy, name)
        except EpisodeError:
            continue
        np.testing.assert_array_equal(episode.actions[0].values, actions[name])
        good.add(name)
    return good


@given(st.data())
def test_truncated_at_any_byte_the_whole_episodes_before_it_are_read(whole, tmp_path_factory, data):
    _, content, actions = whole
    cut = data.draw(st.integers(0, len(content) - 1))
    good = _read_damaged(whole, content[:cut], tmp_path_factory)
    ends, position = [], 0
    while position < len(content):
        position += 16 + struct.unpack_from("<Q", content, position)[0]
        ends.append(position)
    assert good == {name for name, end in zip(actions, ends, strict=True) if end <= cut}


@given(st.data())
def test_a_flipped_byte_anywhere_is_noticed(whole, tmp_path_factory, data):
    _, content, actions = whole
    place, bits = data.draw(st.integers(0, len(content) - 1)), data.draw(st.integers(1, 255))
    damaged = content[:place] + bytes([content[place] ^ bits]) + content[place + 1 :]
    assert len(_read_damaged(whole, damaged, tmp_path_factory)) < len(actions)


@given(st.data())
def test_a_wrong_record_with_a_right_checksum_gives_an_episode_error_or_an_episode(tmp_path_factory, data):
    raw = bytearray(encode(record(0, 3)))
    for _ in range(data.draw(st.integers(1, 4))):
        raw[data.draw(st.integers(0, len(raw) - 1))] = data.draw(st.integers(0, 255))
    folder = toy(tmp_path_factory.mktemp("wrong") / "d", (3,))
    (folder / SHARD).write_bytes(frame(bytes(raw)))
    try:
        episode = read(folder, "train/000000")
        episode.streams["primary"].frames(range(len(episode.actions[0].values)))
    except EpisodeError as fault:
        assert str(fault)


@given(st.binary(max_size=80))
def test_any_bytes_are_an_example_or_an_error(data):
    try:
        example = Example(data, "e")
        for name in example._features:
            example.numbers(name)
    except HMAError as fault:
        assert isinstance(fault, EpisodeError)


# -- the real recording


@pytest.mark.real
def test_the_real_bridge_recording_equals_an_independent_parse(real_data):
    folder = real_data / "rlds" / "bridge_dataset"
    robot = find("bridge_data_v2")
    refs = RLDS.index(str(folder), robot)
    assert [(ref.id, ref.split) for ref in (refs[0], refs[-1])] == [
        ("train/000000", "train"),
        ("val/000024", "val"),
    ]
    content = next((folder / "1.0.0").glob("*-train.tfrecord*")).read_bytes()
    position = 0
    for index in range(25):
        length = struct.unpack_from("<Q", content, position)[0]
        truth = PROTO.FromString(content[position + 12 : position + 12 + length]).features.feature
        position += 16 + length
        episode = read(folder, f"train/{index:06d}", robot)
        action = np.array(truth["steps/action"].float_list.value, np.float32).reshape(-1, 7)
        state = np.array(truth["steps/observation/state"].float_list.value, np.float32).reshape(-1, 7)
        np.testing.assert_array_equal(episode.actions[0].values, action)
        np.testing.assert_array_equal(episode.states[0].values, state)
        assert episode.instruction.encode() == truth["steps/language_instruction"].bytes_list.value[0]
        last = len(action) - 1
        jpeg = truth["steps/observation/image_0"].bytes_list.value[last]
        shown = cv2.imdecode(np.frombuffer(jpeg, np.uint8), cv2.IMREAD_COLOR)[..., ::-1]
        np.testing.assert_array_equal(episode.streams["primary"].frames([last])[0], shown)
    assert position == len(content)


@pytest.mark.real
def test_the_real_bridge_recording_inspects_without_problems(real_data):
    found = RLDS.inspect(str(real_data / "rlds" / "bridge_dataset"))
    assert (found.episodes, found.frames, found.problems) == (50, 500, ())
    assert sorted(key.key for key in found.keys if key.kind == "camera") == [
        f"observation/image_{i}" for i in range(4)
    ]


@pytest.mark.parametrize("name", ["a::b", "[x]*?", "100%20 #1 ü機", "file:x"])
def test_a_folder_of_any_name_is_read(name, tmp_path):
    toy(tmp_path / name / "toy" / "1.0.0")
    for inside in ("", "toy", "toy/1.0.0", "toy/1.0.0/toy-train.tfrecord-00000-of-00001"):
        uri = str(tmp_path / name / inside)
        assert len(RLDS.index(uri)) == 3 and detect(uri) == "rlds"
        assert len(read(uri, "train/000002").actions[0].values) == 5


def test_of_many_episodes_that_cannot_be_read_the_first_is_told(tmp_path):
    toy(tmp_path / "toy", (2,) * 7)
    (tmp_path / "toy" / "features.json").write_text('{"featuresDict": {}}')
    with pytest.raises(SourceError, match="7 of 7 sampled episodes, such as train/000000: holds none of the"):
        RLDS.inspect(str(tmp_path / "toy"))
