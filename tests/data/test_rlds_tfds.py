"""RLDS folders written by TensorFlow Datasets itself: what we read equals what it reads.

Needs tensorflow and tensorflow-datasets, which are no dependencies; skips without.
"""

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

tfds = pytest.importorskip("tensorflow_datasets")
tf = pytest.importorskip("tensorflow")
ml_dtypes = pytest.importorskip("ml_dtypes")

from hma_data.embodiment import Embodiment  # noqa: E402
from hma_data.errors import EpisodeError  # noqa: E402
from hma_data.sources.base import open_source  # noqa: E402
from hma_data.sources.rlds_steps import Steps  # noqa: E402
from hma_data.sources.tfds_folder import open_folder  # noqa: E402

F = tfds.features
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
    if (dtype, encoding) not in UNREADABLE
}


def features() -> Any:
    numbers = {
        key: F.Tensor(shape=shape, dtype=getattr(tf, dtype), encoding=encoding)
        for key, (dtype, encoding, shape) in NUMBERS.items()
    }
    steps = {
        "numbers": numbers,
        "observation": {
            "png": F.Image(shape=(20, 30, 3), encoding_format="png"),
            "jpeg": F.Image(shape=(20, 30, 3), encoding_format="jpeg"),
            "grey": F.Image(shape=(20, 30, 1), encoding_format="png"),
            "depth": F.Image(shape=(20, 30, 1), dtype=np.uint16, encoding_format="png"),
            "raw": F.Tensor(shape=(4, 5, 3), dtype=np.uint8, encoding="zlib"),
            "any": F.Tensor(shape=(None, None, 3), dtype=np.uint8, encoding="bytes"),
            "label": F.ClassLabel(names=["push", "pick", "place"]),
            "box": F.BBoxFeature(),
            "scalar": F.Scalar(dtype=np.float32),
        },
        "words": F.Text(),
        "names": F.Tensor(shape=(2,), dtype=np.str_),
        "pair": F.Sequence(F.Tensor(shape=(2,), dtype=np.float32)),
        "ragged": F.Sequence(np.int32),
        "deep": F.Sequence(F.Sequence(np.int64)),
        "synonyms": F.Sequence(F.Text()),
        "is_first": np.bool_,
        "is_last": np.bool_,
    }
    metadata = {
        "file": F.Text(), "success": F.Scalar(np.bool_), "number": F.Scalar(np.uint64), "weight": np.float64,
    }  # fmt: skip
    return F.FeaturesDict({"steps": F.Dataset(steps), "episode_metadata": metadata})


def number(dtype: str, shape: tuple[int, ...], rng: np.random.Generator) -> Any:
    if dtype == "bool":
        values = rng.integers(0, 2, shape).astype(bool)
    elif dtype == "bfloat16":
        values = np.asarray(rng.standard_normal(shape)).astype(ml_dtypes.bfloat16)
    elif np.dtype(dtype).kind == "f":
        values = np.asarray(rng.standard_normal(shape)).astype(dtype)
    else:
        info = np.iinfo(dtype)
        values = np.asarray(rng.integers(info.min, info.max, shape, dtype=dtype, endpoint=True))
    return values if shape else values[()]


def step(index: int, last: bool, rng: np.random.Generator) -> dict[str, Any]:
    def picture(*shape: int, dtype: str = "uint8") -> np.ndarray:
        return rng.integers(0, np.iinfo(dtype).max, shape, dtype)

    smooth = np.linspace(0, 255, 30)[None, :, None] * np.linspace(0.2, 1, 20)[:, None, None]
    return {
        "numbers": {key: number(dtype, shape, rng) for key, (dtype, _, shape) in NUMBERS.items()},
        "observation": {
            "png": picture(20, 30, 3),
            "jpeg": (smooth * rng.uniform(0.3, 1, 3)).astype(np.uint8),
            "grey": picture(20, 30, 1),
            "depth": picture(20, 30, 1, dtype="uint16"),
            "raw": picture(4, 5, 3),
            "any": picture(6, 7, 3),
            "label": int(rng.integers(3)),
            "box": F.BBox(0.1, 0.2, 0.5, 0.75),
            "scalar": np.float32(rng.standard_normal()),
        },
        "words": f"hebe Größe {index} 手",
        "names": ["arm", f"n{index}"],
        "pair": rng.standard_normal((3, 2)).astype(np.float32),
        "ragged": list(range(index % 3)),
        "deep": rng.integers(-9, 9, (2, 2)),
        "synonyms": ["push it", "shove it"][: 1 + index % 2],
        "is_first": index == 0,
        "is_last": last,
    }


class Toy(tfds.core.GeneratorBasedBuilder):
    """Ten episodes over three splits."""

    VERSION = tfds.core.Version("1.2.3")

    def _info(self) -> Any:
        return self.dataset_info_from_configs(features=features())

    def _split_generators(self, dl_manager: Any) -> Any:
        return {split: self._generate_examples(split) for split in EPISODES}

    def _generate_examples(self, split: str) -> Any:
        for episode in range(EPISODES[split]):
            rng = np.random.default_rng([len(split), episode])
            length = 1 + 2 * episode
            steps = [step(i, i == length - 1, rng) for i in range(length)]
            weight = {"file": f"/{split}/{episode}", "success": episode % 2 == 0, "weight": 1 / (episode + 1)}
            yield (
                f"{split}{episode}",
                {
                    "steps": steps,
                    "episode_metadata": weight | {"number": np.uint64(2**64 - 1 - episode)},
                },
            )


def build(folder: Path, shards: int = 3, file_format: str = "tfrecord") -> Path:
    """Write the dataset; the version's folder."""
    config = tfds.download.DownloadConfig(num_shards=shards)
    builder = Toy(data_dir=folder, file_format=file_format)
    builder.download_and_prepare(download_config=config)
    return Path(builder.data_dir)


@pytest.fixture(scope="module")
def written(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return build(tmp_path_factory.mktemp("tfds"))


def theirs(folder: Path, split: str) -> list[dict[str, Any]]:
    """Episodes as TFDS reads them, each with `steps` as a list."""
    config = tfds.ReadConfig(interleave_cycle_length=1)
    data = tfds.builder_from_directory(str(folder)).as_dataset(
        split=split, shuffle_files=False, read_config=config
    )
    return [{**episode, "steps": list(episode["steps"])} for episode in data]


@pytest.fixture(scope="module")
def truth(written: Path) -> dict[str, list[dict[str, Any]]]:
    return {split: theirs(written, split) for split in EPISODES}


def ours(folder: Path, name: str) -> Steps:
    found = open_folder(str(folder))
    return Steps(found, found.example(name)[0], name)


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


@pytest.mark.parametrize("key", NUMBERS)
def test_numbers_of_every_dtype_equal_bit_for_bit(written, truth, key):
    for name, episode in each(truth):
        expected = np.array([step["numbers"][key].numpy() for step in episode["steps"]])
        found = ours(written, name).numbers(f"numbers/{key}")
        if key.startswith("bfloat16"):  # NumPy has none; float32 holds each value
            expected = expected.astype(np.float32)
        assert found.dtype == expected.dtype
        assert found.tobytes() == expected.tobytes()


@pytest.mark.parametrize(
    "key",
    ["observation/label", "observation/box", "observation/scalar", "pair", "deep", "is_first", "is_last"],
)
def test_other_numbers_equal_bit_for_bit(written, truth, key):
    for name, episode in each(truth):
        steps = episode["steps"]
        for part in key.split("/"):
            steps = [step[part] for step in steps]
        dense = [value.to_tensor() if isinstance(value, tf.RaggedTensor) else value for value in steps]
        expected = np.array([value.numpy() for value in dense])
        found = ours(written, name).numbers(key)
        assert found.dtype == expected.dtype
        np.testing.assert_array_equal(found, expected)


def test_a_sequence_of_varying_length_is_refused_or_equal(written, truth):
    for name, episode in each(truth):
        rows = [step["ragged"].numpy() for step in episode["steps"]]
        if len({len(row) for row in rows}) > 1:
            with pytest.raises(EpisodeError, match="varies from 0 to 2 entries a step"):
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


def test_jpeg_equals_the_accurate_inverse_dct_of_libjpeg(written, truth):
    worst = 0
    for name, episode in each(truth):
        steps = ours(written, name)
        blobs, decode = steps.blobs("observation/jpeg"), steps.decoder("observation/jpeg")
        for index, step in enumerate(episode["steps"]):
            accurate = tf.image.decode_jpeg(bytes(blobs[index]), channels=3, dct_method="INTEGER_ACCURATE")
            np.testing.assert_array_equal(decode(index), accurate.numpy())
            off = decode(index).astype(int) - step["observation"]["jpeg"].numpy()  # TFDS: its default, fast
            worst = max(worst, int(np.abs(off).max()))
    assert worst <= 8


def test_texts_are_equal(written, truth):
    for name, episode in each(truth):
        steps = ours(written, name)
        assert [bytes(blob) for blob in steps.blobs("words")] == [
            step["words"].numpy() for step in episode["steps"]
        ]
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


def test_an_episode_has_their_metadata_instruction_and_success(written, truth):
    for name, episode in each(truth):
        found = RLDS.read(str(written), name, robot("words"))
        expected = {key: value.numpy() for key, value in episode["episode_metadata"].items()}
        assert found.metadata == expected | {"file": expected["file"].decode()}
        assert found.success is bool(expected["success"])
        assert found.instruction.encode() == episode["steps"][0]["words"].numpy()
        assert RLDS.read(str(written), name, robot("synonyms")).instruction == "push it"
        columns = [step["numbers"]["float64_zlib_1"].numpy() for step in episode["steps"]]
        np.testing.assert_array_equal(found.actions[0].values[:, :3], np.float32(columns))


@pytest.mark.parametrize(
    "template",
    [
        "{DATASET}-{SPLIT}.{FILEFORMAT}-{SHARD_X_OF_Y}",
        "{SPLIT}.{FILEFORMAT}-{SHARD_INDEX}-of-{NUM_SHARDS}",
        "{SPLIT}/data.{FILEFORMAT}-{SHARD_INDEX}",
        "shards/{SPLIT}_{SHARD_X_OF_Y}.{FILEFORMAT}",
        "{DATASET}-{SPLIT}-{SHARD_X_OF_Y}.{FILEFORMAT}",
    ],
)
def test_every_template_of_shard_names(written, truth, tmp_path, template):
    folder = tmp_path / "toy" / "1.2.3"
    folder.mkdir(parents=True)
    info = json.loads((written / "dataset_info.json").read_text())
    for split in info["splits"]:
        split["filepathTemplate"] = template
        total = len(split["shardLengths"])
        for number in range(total):
            old = written / f"toy-{split['name']}.tfrecord-{number:05d}-of-{total:05d}"
            values = {
                "DATASET": "toy", "SPLIT": split["name"], "FILEFORMAT": "tfrecord",
                "SHARD_INDEX": f"{number:05d}", "NUM_SHARDS": f"{total:05d}",
                "SHARD_X_OF_Y": f"{number:05d}-of-{total:05d}",
            }  # fmt: skip
            new = folder / template.format(**values)
            new.parent.mkdir(exist_ok=True)
            new.write_bytes(old.read_bytes())
    (folder / "dataset_info.json").write_text(json.dumps(info))
    (folder / "features.json").write_text((written / "features.json").read_text())
    for split, episodes in truth.items():
        again = theirs(folder, split)
        assert len(again) == len(episodes)  # TFDS itself finds them so
    for name, episode in each(truth):
        np.testing.assert_array_equal(
            ours(folder, name).numbers("is_last"), [step["is_last"].numpy() for step in episode["steps"]]
        )


def test_array_records_written_by_tfds_hold_the_same_bytes(written, tmp_path):
    pytest.importorskip("array_record.python.array_record_module")
    folder = open_folder(str(build(tmp_path, 2, "array_record")))
    same = open_folder(str(written))
    for split, count in EPISODES.items():
        mine = [folder.example(f"{split}/{index:06d}")[0] for index in range(count)]
        truth = [same.example(f"{split}/{index:06d}")[0] for index in range(count)]
        for one, other in zip(mine, truth):
            for name in ("episode_metadata/file", "steps/words", "steps/observation/png"):
                assert [bytes(blob) for blob in one.blobs(name)] == [
                    bytes(blob) for blob in other.blobs(name)
                ]
