"""The dataset of test_rlds_tfds, written and read by TensorFlow Datasets; imported in its slow tests only."""

from pathlib import Path
from typing import Any

import ml_dtypes
import numpy as np
import tensorflow as tf
import tensorflow_datasets as tfds

from tests.data.sources.rlds.test_rlds_tfds import EPISODES, NUMBERS

F = tfds.features


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
    __module__ = "tests"  # in a deeper one TFDS looks for importlib_resources, which it does not install

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
                {"steps": steps, "episode_metadata": weight | {"number": np.uint64(2**64 - 1 - episode)}},
            )


def build(folder: Path) -> Path:
    config = tfds.download.DownloadConfig(num_shards=3)
    builder = Toy(data_dir=folder, file_format="tfrecord")
    builder.download_and_prepare(download_config=config)
    return Path(builder.data_dir)


def episodes(folder: Path, split: str) -> list[dict[str, Any]]:
    config = tfds.ReadConfig(interleave_cycle_length=1)
    data = tfds.builder_from_directory(str(folder)).as_dataset(
        split=split, shuffle_files=False, read_config=config
    )
    return [{**episode, "steps": list(episode["steps"])} for episode in data]
