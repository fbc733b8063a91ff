"""RLDS folders written by TensorFlow Datasets itself: what we read equals what it reads."""

import json
import sys
from functools import cache
from pathlib import Path
from types import ModuleType
from typing import Any

import numpy as np
import pytest

from hma_data.errors import EpisodeError
from hma_data.registry.embodiment import Embodiment, find
from hma_data.sources.base import open_source
from hma_data.sources.rlds.features import Steps
from hma_data.sources.rlds.folder import open_folder
from hma_data.storage.paths import shipped

sys.path.insert(0, str(shipped("recipes") / "lab"))
from recorder import Recorded, as_rlds  # type: ignore[import-not-found]

pytestmark = pytest.mark.slow
RLDS = open_source("rlds")
EPISODES = {"train": 7, "val": 3, "test-hard": 3}
DTYPES = (
    "int8", "int16", "int32", "int64", "uint8", "uint16", "uint32", "uint64",
    "float16", "float32", "float64", "bool", "bfloat16",
)  # fmt: skip
ENCODINGS = ("none", "bytes", "zlib")
UNREADABLE = {("bfloat16", "none"), ("uint32", "bytes"), ("uint32", "zlib")}  # TFDS itself fails on them
SHAPES = ((), (3,), (2, 2))
NUMBERS = {
    f"{dtype}_{encoding}_{len(shape)}": (dtype, encoding, shape)
    for dtype in DTYPES
    for encoding in ENCODINGS
    for shape in SHAPES
    if (dtype, encoding) not in UNREADABLE and (shape == (2, 2) or dtype in ("bool", "float64"))
}


@pytest.fixture(scope="module")
def toy() -> ModuleType:
    pytest.importorskip("tensorflow_datasets", reason="needs the dependency group tfds")
    from tests.data import tfds_toy

    return tfds_toy


@pytest.fixture(scope="module")
def written(toy: ModuleType, tmp_path_factory: pytest.TempPathFactory) -> Path:
    made: Path = toy.build(tmp_path_factory.mktemp("tfds"))
    return made


@pytest.fixture(scope="module")
def truth(toy: ModuleType, written: Path) -> dict[str, list[dict[str, Any]]]:
    return {split: toy.episodes(written, split) for split in EPISODES}


@cache
def ours(folder: Path, name: str) -> Steps:
    found = open_folder(str(folder))
    return Steps(found.example(name)[0], found.step_features, name)


def each(truth: dict[str, list[dict[str, Any]]]) -> list[tuple[str, dict[str, Any]]]:
    return [
        (f"{split}/{index:06d}", episode)
        for split, episodes in truth.items()
        for index, episode in enumerate(episodes)
    ]


def test_every_split_and_episode_is_found_in_order(written, truth):
    assert RLDS.episode_ids(str(written)) and sorted(RLDS.episode_ids(str(written))) == sorted(
        name for name, _ in each(truth)
    )
    for name, episode in each(truth):
        found = open_folder(str(written))
        metadata = found.example(name)[0].blobs("episode_metadata/file")
        assert bytes(metadata[0]) == episode["episode_metadata"]["file"].numpy()
        assert ours(written, name).count == len(episode["steps"])


@pytest.mark.parametrize("dtype", DTYPES)
def test_numbers_of_every_dtype_equal_bit_for_bit(written, truth, dtype):
    for key in (key for key, about in NUMBERS.items() if about[0] == dtype):
        for name, episode in each(truth):
            expected = np.array([step["numbers"][key].numpy() for step in episode["steps"]])
            found = ours(written, name).numbers(f"numbers/{key}")
            if dtype == "bfloat16":  # NumPy has none; float32 holds each value
                expected = expected.astype(np.float32)
            assert found.dtype == expected.dtype
            assert found.tobytes() == expected.tobytes()


@pytest.mark.parametrize(
    "key",
    ["observation/label", "observation/box", "observation/scalar", "pair", "deep", "is_first", "is_last"],
)
def test_other_numbers_equal_bit_for_bit(toy, written, truth, key):
    for name, episode in each(truth):
        steps = episode["steps"]
        for part in key.split("/"):
            steps = [step[part] for step in steps]
        dense = [value.to_tensor() if isinstance(value, toy.tf.RaggedTensor) else value for value in steps]
        expected = np.array([value.numpy() for value in dense])
        found = ours(written, name).numbers(key)
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected)


def test_a_sequence_of_varying_length_is_refused_or_equal(written, truth):
    for name, episode in each(truth):
        rows = [step["ragged"].numpy() for step in episode["steps"]]
        if len({len(row) for row in rows}) > 1:
            with pytest.raises(EpisodeError, match="varies from 0 to 2 entries per step"):
                ours(written, name).numbers("ragged")
        else:
            np.testing.assert_array_equal(ours(written, name).numbers("ragged"), rows)


def test_pictures_without_loss_equal_bit_for_bit(written, truth):
    for name, episode in each(truth):
        steps = ours(written, name)
        for key in ("png", "grey", "raw", "any"):
            decode = steps.decoder(f"observation/{key}")
            for index, step in enumerate(episode["steps"]):
                expected = step["observation"][key].numpy()
                np.testing.assert_array_equal(
                    decode(index), np.broadcast_to(expected, (*expected.shape[:2], 3))
                )


def test_jpeg_equals_the_accurate_inverse_dct_of_libjpeg(toy, written, truth):
    worst = 0
    for name, episode in each(truth):
        steps = ours(written, name)
        blobs, decode = steps.blobs("observation/jpeg"), steps.decoder("observation/jpeg")
        for index, step in enumerate(episode["steps"]):
            accurate = toy.tf.image.decode_jpeg(
                bytes(blobs[index]), channels=3, dct_method="INTEGER_ACCURATE"
            )
            np.testing.assert_array_equal(decode(index), accurate.numpy())
            off = decode(index).astype(int) - step["observation"]["jpeg"].numpy()  # TFDS: its default, fast
            worst = max(worst, int(np.abs(off).max()))
    assert worst <= 8


def test_texts_are_equal(written, truth):
    for name, episode in each(truth):
        steps = ours(written, name)
        assert list(map(bytes, steps.blobs("words"))) == [step["words"].numpy() for step in episode["steps"]]
        found = steps.example.blobs("steps/names")
        assert [bytes(blob) for blob in found] == [
            word for step in episode["steps"] for word in step["names"].numpy()
        ]


ROBOT = {
    "id": "toy", "kind": "real", "frequency_hz": 5,
    "action": {"space": "mixed", "components": [
        {"key": "numbers/float64_zlib_1", "dims": 3}, {"key": "pair", "dims": 6},
        {"key": "is_last", "dims": 1}]},
    "cameras": [{"name": "primary", "key": "observation/png"}],
    "source": {"format": "rlds"},
}  # fmt: skip


def robot(instruction: str | None = None) -> Embodiment:
    source = {"format": "rlds", "instruction": instruction}
    return Embodiment.from_values(ROBOT | {"source": source}, "toy.yaml")


def test_an_episode_has_their_instruction_and_success(written, truth):
    for name, episode in each(truth):
        found = RLDS.read(str(written), name, robot("words"))
        assert found.success is bool(episode["episode_metadata"]["success"].numpy())
        assert found.instruction.encode() == episode["steps"][0]["words"].numpy()
        assert RLDS.read(str(written), name, robot("synonyms")).instruction == "push it"
        columns = [step["numbers"]["float64_zlib_1"].numpy() for step in episode["steps"]]
        np.testing.assert_array_equal(found.actions[0].values[:, :3], np.float32(columns))


def test_shards_have_the_names_of_a_template(toy, written, truth, tmp_path):
    folder = tmp_path / "toy" / "1.2.3"
    folder.mkdir(parents=True)
    info = json.loads((written / "dataset_info.json").read_text())
    for split in info["splits"]:
        split["filepathTemplate"] = "shards/{SPLIT}_{SHARD_X_OF_Y}.{FILEFORMAT}-{SHARD_INDEX}-of-{NUM_SHARDS}"
        total = len(split["shardLengths"])
        for number in range(total):
            place = f"{number:05d}-of-{total:05d}"
            new = folder / "shards" / f"{split['name']}_{place}.tfrecord-{place}"
            new.parent.mkdir(exist_ok=True)
            new.write_bytes((written / f"toy-{split['name']}.tfrecord-{place}").read_bytes())
    (folder / "dataset_info.json").write_text(json.dumps(info))
    (folder / "features.json").write_text((written / "features.json").read_text())
    assert len(toy.episodes(folder, "val")) == EPISODES["val"]  # TFDS itself finds them so
    for name, episode in each(truth):
        np.testing.assert_array_equal(
            ours(folder, name).numbers("is_last"), [step["is_last"].numpy() for step in episode["steps"]]
        )


def test_what_the_laboratory_records_is_read_by_tfds(toy, tmp_path):
    from hma_data import lab

    folder = lab.record("pendulum", tmp_path, 2, seed=3)
    _is_what_tfds_reads(toy, folder, find("pendulum"))


def test_a_simulator_recorded_as_rlds_is_read_by_tfds(toy, tmp_path):
    draw, robot = np.random.default_rng(0), find("pendulum")
    pictures = draw.integers(0, 256, (4, *robot.cameras[0].size, 3), np.uint8)
    made = Recorded(
        number=5, copy=1, seed=2, style="noised", task="swing up", pictures=pictures,
        states=draw.normal(size=(4, 3)), objects=draw.normal(size=(4, 3)),
        commands=draw.normal(size=(4, 1)).astype(np.float32), done=np.array([False, False, True, False]),
    )  # fmt: skip
    as_rlds(tmp_path / "made", robot, [made])
    (episode,) = _is_what_tfds_reads(toy, tmp_path / "made", robot)
    facts = {key: value.numpy() for key, value in episode["episode_metadata"].items()}
    assert facts == {
        "success": True,
        **{k: v.encode() if isinstance(v, str) else v for k, v in made.facts.items()},
    }
    assert {step["language_instruction"].numpy() for step in episode["steps"]} == {b"swing up"}
    np.testing.assert_array_equal(
        [step["observation"]["image"].numpy() for step in episode["steps"]], pictures
    )


def _is_what_tfds_reads(toy: ModuleType, folder: Path, robot: Embodiment) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = toy.episodes(folder, "train")
    names = RLDS.episode_ids(str(folder))
    assert len(found) == len(names)
    for name, theirs in zip(names, found, strict=True):
        episode = RLDS.read(str(folder), name, robot)
        (camera,) = episode.streams.values()
        expected = [step["observation"]["image"].numpy() for step in theirs["steps"]]
        np.testing.assert_array_equal(camera.frames(range(len(expected))), expected)
        commands = [step["action"].numpy() for step in theirs["steps"]]
        np.testing.assert_array_equal(episode.actions[0].values, commands)
    return found
