"""Load and run MediaPipe's two hand models, from .tflite files or a `hand_landmarker.task` bundle.

The palm model takes the whole picture (192×192) and gives 2016 × 18 values and 2016 scores. The landmark
model takes one hand (224×224) and gives 21 points, the presence of a hand and its handedness. A bundle is a
zip file of both. They run in LiteRT, on one thread.
"""

import hashlib
import os
import zipfile
from collections.abc import Iterable
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.errors import MissingDependencyError, SourceError
from hma_data.storage.paths import StrPath, as_text

ENVIRONMENT = "HMA_HAND_MODELS"
PALM_SIDE, HAND_SIDE = 192, 224  # pixels of each model's input
ANCHORS = 2016
LARGEST_MODEL = 256 << 20  # bytes; the real ones have 2 to 8 MB
_PALM = ("palm_detection_full.tflite", "palm_detection_lite.tflite", "hand_detector.tflite")
_HAND = ("hand_landmark_full.tflite", "hand_landmark_lite.tflite", "hand_landmarks_detector.tflite")
_REMEDY = (
    "give source.layout.models (or the environment variable HMA_HAND_MODELS) a folder with MediaPipe's "
    "palm_detection_full.tflite and hand_landmark_full.tflite, or the path of hand_landmarker.task"
)


@dataclass(frozen=True)
class HandModels:
    """The bytes of both models.

    Attributes:
        palm, hand: content of the .tflite files.
        where: what they were read from.
    """

    palm: bytes
    hand: bytes
    where: str

    @property
    def digest(self) -> str:
        """Return 16 hex digits hashed from both."""
        return hashlib.sha256(hashlib.sha256(self.palm).digest() + self.hand).hexdigest()[:16]


def load_models(place: StrPath | None = None) -> HandModels:
    """Return the models in a folder or a bundle; full ones are preferred to lite ones.

    Args:
        place: str or path of a folder or .task file; None takes $HMA_HAND_MODELS.

    Raises:
        SourceError: none are given, none are there, or the files are not such models.
    """
    place = place or os.environ.get(ENVIRONMENT)
    if not place:
        raise SourceError("hand models", "are not given", _REMEDY)
    path = Path(as_text(place).removeprefix("file://")).expanduser()
    if path.is_dir():
        bundles = sorted(path.glob("*.task"))
        here = {item.name for item in path.iterdir()}
        if bundles and not here & {*_PALM, *_HAND}:
            return _from_bundle(bundles[0])
        palm, hand = (_read(path / _first(path, names, here)) for names in (_PALM, _HAND))
        return HandModels(palm, hand, str(path))
    if not path.is_file():
        raise SourceError(path, "does not exist", _REMEDY)
    return _from_bundle(path)


def _from_bundle(path: Path) -> HandModels:
    try:
        with zipfile.ZipFile(path) as bundle:
            names = {Path(name).name: name for name in bundle.namelist()}
            found = [names[_first(path, known, names)] for known in (_PALM, _HAND)]
            for name in found:
                if bundle.getinfo(name).file_size > LARGEST_MODEL:
                    raise SourceError(path, f"{name} claims {bundle.getinfo(name).file_size:,} bytes")
            palm, hand = (_checked(bundle.read(name), f"{path}:{name}") for name in found)
            return HandModels(palm, hand, str(path))
    except (zipfile.BadZipFile, OSError, EOFError, RuntimeError, NotImplementedError) as fault:
        raise SourceError(path, f"is not a bundle of models: {fault}", _REMEDY) from fault


def _first(place: Path, names: Iterable[str], here: Iterable[str]) -> str:
    for name in names:
        if name in here:
            return name
    raise SourceError(place, f"has none of {', '.join(names)}", _REMEDY)


def _read(path: Path) -> bytes:
    if path.stat().st_size > LARGEST_MODEL:
        raise SourceError(path, f"has {path.stat().st_size:,} bytes, too many for a hand model", _REMEDY)
    return _checked(path.read_bytes(), str(path))


def _checked(content: bytes, where: str) -> bytes:
    if content[4:8] != b"TFL3":  # the identifier of a TFLite flatbuffer
        raise SourceError(where, "is not a TFLite model", _REMEDY)
    return content


class Network:
    """One model, ready to run.

    Args:
        content: of the .tflite file.
        side: pixels of its square input.
        widths: of the wanted outputs, each the product of its shape; equal ones in the order of names.
        where: for errors.

    Raises:
        SourceError: it is another model.
    """

    def __init__(self, content: bytes, side: int, widths: tuple[int, ...], where: str) -> None:
        try:
            self._interpreter = _interpreter()(model_content=content, num_threads=1)
            self._interpreter.allocate_tensors()
            inputs = self._interpreter.get_input_details()
            outputs = sorted(self._interpreter.get_output_details(), key=lambda item: item["name"])
        except (ValueError, RuntimeError) as fault:
            raise SourceError(where, f"cannot be run: {fault}", _REMEDY) from fault
        shapes = [tuple(map(int, item["shape"])) for item in inputs]
        left = {i: int(np.prod(item["shape"])) for i, item in enumerate(outputs)}
        chosen = []
        for width in widths:
            match = next((i for i, size in left.items() if size == width), None)
            if match is None:
                break
            chosen.append(outputs[match]["index"])
            del left[match]
        if shapes != [(1, side, side, 3)] or len(chosen) != len(widths):
            sizes = [tuple(map(int, item["shape"])) for item in outputs]
            fault_text = f"is another model: takes {shapes}, gives {sizes}"
            raise SourceError(where, fault_text, _REMEDY)
        self._input, self._outputs = inputs[0]["index"], chosen

    def __call__(self, picture: NDArray[np.float32]) -> list[NDArray[np.float32]]:
        """Return the flat outputs for a picture (side, side, 3) of values 0..1."""
        self._interpreter.set_tensor(self._input, picture[None])
        self._interpreter.invoke()
        return [self._interpreter.get_tensor(index).reshape(-1) for index in self._outputs]


def palm_network(models: HandModels) -> Network:
    """Return the palm model, which gives 2016 × 18 box values and 2016 scores."""
    return Network(models.palm, PALM_SIDE, (ANCHORS * 18, ANCHORS), f"{models.where}: palm model")


def hand_network(models: HandModels) -> Network:
    """Return the landmark model: 21 × 3 points in pixels of its input, presence 0..1 and handedness 0..1."""
    return Network(models.hand, HAND_SIDE, (63, 1, 1), f"{models.where}: landmark model")


def _interpreter() -> Any:
    try:
        return import_module("ai_edge_litert.interpreter").Interpreter
    except ImportError as fault:
        raise MissingDependencyError(
            "ai-edge-litert", f"is not installed ({fault})", "pip install 'hma-toolkit[hands]'"
        ) from fault
