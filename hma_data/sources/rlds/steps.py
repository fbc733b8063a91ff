"""Read one RLDS episode: its columns, pictures, instruction and outcome.

Keys are paths inside a step. T steps, H×W pixels.
"""

import logging
from collections.abc import Iterable
from difflib import get_close_matches
from functools import cached_property
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.episode import Decode
from hma_data.episodes.images import decode_image
from hma_data.errors import SourceError
from hma_data.sources.rlds.features import Feature, column, column_blobs, scalar, step_count, tensor
from hma_data.sources.rlds.folder import Folder
from hma_data.sources.rlds.tf_example import Example

INSTRUCTIONS = ("language_instruction", "natural_language_instruction")
MAX_VECTOR = 4096  # most values of an action or a state

log = logging.getLogger(__name__)


class Steps:
    """One record and its columns over the steps.

    Args:
        folder: of the record.
        example: the record.
        name: the episode's id, for errors.
    """

    def __init__(self, folder: Folder, example: Example, name: str) -> None:
        self.example, self.name = example, name
        self.features = folder.step_features
        self.count = step_count(example, self.features, name)

    def numbers(self, key: str) -> NDArray[Any]:
        """Return the values (T, …) of a key."""
        return column(self.example, self.features[key], self.count, self.name)

    def blobs(self, key: str) -> list[memoryview]:
        """Return the T byte strings of a key."""
        return column_blobs(self.example, self.features[key], self.count, self.name)

    def text(self, key: str) -> str:
        """Return the first text of a key; empty where the steps have none."""
        feature = self.features[key]
        name = f"{feature.name}/ragged_flat_values"
        blobs = self.example.blobs(name) if name in self.example else self.blobs(key)
        return bytes(blobs[0]).decode(errors="replace") if blobs else ""

    def decoder(self, key: str) -> Decode:
        """Return a function that maps a step to the picture (H, W, 3) of a key."""
        feature = self.features[key]
        return _Encoded(self, key) if feature.kind == "picture" else _Raw(self, key)


class _Encoded:
    """Pictures stored as JPEG or PNG."""

    def __init__(self, steps: Steps, key: str) -> None:
        self._blobs = steps.blobs(key)
        self._where = f"{steps.name}: {key}"

    def __call__(self, index: int, /) -> NDArray[np.uint8]:
        return decode_image(np.frombuffer(self._blobs[index], np.uint8), f"{self._where}, step {index}")


class _Raw:
    """Pictures stored as tensors of uint8."""

    def __init__(self, steps: Steps, key: str) -> None:
        self._steps, self._key, self._feature = steps, key, steps.features[key]
        whole = self._feature.encoding == "none" or self._feature.shape.count(None) > 1
        self._blobs = [] if whole else steps.blobs(key)

    @cached_property
    def _all(self) -> NDArray[np.uint8]:
        return self._steps.numbers(self._key)

    def __call__(self, index: int, /) -> NDArray[np.uint8]:
        if not self._blobs:
            return self._all[index]
        feature = self._feature
        return tensor(self._blobs[index], feature, feature.shape, self._steps.name)


def is_camera(feature: Feature) -> bool:
    """Check whether a feature holds a colour picture a step, encoded or as a tensor."""
    if feature.dtype != "uint8" or len(feature.nesting) != 1:
        return False
    return feature.kind == "picture" or (
        feature.kind == "number" and len(feature.shape) == 3 and feature.shape[2] == 3
    )


def described(feature: Feature) -> str:
    """Return what a feature is, in words for an error."""
    if feature.kind == "picture":
        return "a sequence of pictures a step" if len(feature.nesting) > 1 else "a picture"
    return {"number": "a tensor", "text": "text"}.get(feature.kind, "a feature")


def step_feature(folder: Folder, key: str) -> Feature:
    """Return the feature at a path inside a step.

    Raises:
        SourceError: there is none; the error names the nearest keys.
    """
    found = folder.step_features
    if key in found:
        return found[key]
    near = get_close_matches(key, found, n=3) or [name for name in found if name.endswith("/" + key)]
    raise SourceError(
        folder.uri,
        f"has no key {key!r} in its steps",
        f"did you mean {', '.join(near)}?" if near else f"its keys: {listed(found)}",
    )


def listed(keys: Iterable[str]) -> str:
    """Return at most forty keys, for an error."""
    return ", ".join(list(keys)[:40]) or "none"


# -- instruction, success, metadata


def text_feature(folder: Folder, key: str) -> Feature:
    """Return the feature of the instruction, from inside the steps or from the whole episode.

    Raises:
        SourceError: there is none, or it is not text.
    """
    inside = key in folder.step_features or key not in folder.features
    feature = step_feature(folder, key) if inside else folder.features[key]
    if feature.kind == "text":
        return feature
    if inside and feature.kind == "number" and feature.dtype.startswith(("int", "uint")):  # codes of letters
        return feature
    raise SourceError(folder.uri, f"source.instruction: {key} is {described(feature)}, not text")


def instruction(folder: Folder, steps: Steps, key: str | None) -> str:
    """Return the instruction of the first step."""
    if key is None:
        places = [f"{place}{name}" for place in ("", "observation/") for name in INSTRUCTIONS]
        outside = [f"episode_metadata/{name}" for name in INSTRUCTIONS]
        key = next((place for place in places if place in folder.step_features), None)
        key = key or next((place for place in outside + places if place in folder.features), None)
    if key is None:
        return ""
    feature = text_feature(folder, key)
    if key not in folder.step_features:
        return str(scalar(steps.example, feature) or "")
    if feature.kind == "text":
        return steps.text(key)
    codes = steps.numbers(key)[0].ravel()  # language_table: bytes of UTF-8, padded with zeros
    return bytes(int(code) & 0xFF for code in codes if code).decode(errors="replace")


def success(folder: Folder, steps: Steps) -> bool | None:
    """Return whether the episode succeeded, as it states itself; None where it is unknown.

    Without a statement, an episode succeeds where its last step is terminal and has a positive reward.
    """
    stated = folder.features.get("episode_metadata/success")
    if stated:
        value = scalar(steps.example, stated)
        return bool(value) if isinstance(value, bool | int) else None
    if any(key not in steps.features for key in ("reward", "is_terminal")):
        return None
    ends = [steps.numbers(key)[-1] for key in ("reward", "is_terminal")]
    return True if all(end.size == 1 and end > 0 for end in ends) else None


def metadata(folder: Folder, example: Example) -> dict[str, Any]:
    """Return the single values outside the steps."""
    found = {
        name.removeprefix("episode_metadata/"): scalar(example, feature)
        for name, feature in folder.features.items()
        if not name.startswith("steps/")
    }
    return {name: value for name, value in found.items() if value is not None}
