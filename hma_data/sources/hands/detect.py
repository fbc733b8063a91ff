"""Find hands in images with MediaPipe's two models, run by LiteRT on one thread.

The palm model searches the whole image (192×192) and gives 2016 × 18 values and 2016 scores. Each palm
gives a rotated square for the landmark model (224×224), which gives 21 points, the presence of a hand and its
handedness. The points give the square of the next frame, so the palm model runs only while fewer than two
hands are tracked. The constants are those of MediaPipe's published graphs: palm_detection_cpu,
palm_detection_detection_to_roi, hand_landmark_cpu, hand_landmark_landmarks_to_roi and
hand_landmark_tracking_cpu.

Left and right are the person's own hands. The model's handedness is the probability of a right hand in a
image that is not mirrored; MediaPipe's graph assumes mirrored frames, and calls such a hand "Left".

Geometry is in pixels, angles in radians, x to the right and y down.
"""

import hashlib
import math
import os
import zipfile
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from importlib import import_module
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.arrays import Array, Float32s, Floats, Images
from hma_data.episodes.images import opencv
from hma_data.errors import MissingDependencyError, SourceError, install_command
from hma_data.storage.files import short_sha256
from hma_data.storage.kinds import unreadable
from hma_data.storage.paths import StrPath, as_text

ENVIRONMENT = "HMA_HAND_MODELS"
PALM_SIDE, HAND_SIDE = 192, 224  # pixels of each model's input
ANCHORS = 2016
HANDS = 2  # tracked at most
PALM_SCORE = 0.5  # least probability of a palm
SUPPRESSION = 0.3  # overlap above which two palms are merged
PRESENCE = 0.5  # least probability that a tracked square still holds a hand
SAME_SQUARE = 0.5  # overlap above which a palm is of a hand that is already tracked
VERSION = 1  # part of the key of cached detections: raise it when the same image may give other points
_KNUCKLES = [0, 1, 2, 3, 5, 6, 9, 10, 13, 14, 17, 18]  # the points that give the next frame's square
_SURE = 0.8  # probability of a side; a second hand of that side with less becomes the other hand
_PALM = ("palm_detection_full.tflite", "palm_detection_lite.tflite", "hand_detector.tflite")
_HAND = ("hand_landmark_full.tflite", "hand_landmark_lite.tflite", "hand_landmarks_detector.tflite")
_REMEDY = (
    "give source.layout.models (or the environment variable HMA_HAND_MODELS) a folder with MediaPipe's "
    "palm_detection_full.tflite and hand_landmark_full.tflite, or the path of hand_landmarker.task; "
    "docs/adding-a-robot.md, Videos of human hands, says where to get them"
)

# -- the models


@dataclass(frozen=True)
class HandModels:
    """The bytes of both models."""

    palm: bytes  # content of the .tflite file, as of `hand`
    hand: bytes
    where: str  # what they were read from

    @property
    def digest(self) -> str:
        """Return 16 hex digits hashed from both."""
        return short_sha256(hashlib.sha256(self.palm).digest() + self.hand)


def load_models(place: StrPath | None = None) -> HandModels:
    """Return the models in a folder or a bundle (a zip file of both); full ones are preferred to lite ones.

    Args:
        place: str or path of a folder or .task file; None takes $HMA_HAND_MODELS.

    Raises:
        SourceError: none are given, or none are there.
    """
    place = place or os.environ.get(ENVIRONMENT)
    if not place:
        raise SourceError("hand models", "are not given", _REMEDY)
    path = Path(as_text(place).removeprefix("file://")).expanduser()
    try:
        entries = path.iterdir() if path.is_dir() else zipfile.Path(path).iterdir()
        files: dict[str, Any] = {item.name: item for item in entries}
        bundle = next((name for name in sorted(files) if name.endswith(".task")), None)
        if bundle and not files.keys() & {*_PALM, *_HAND}:
            return load_models(path / bundle)
        models = []
        for names in (_PALM, _HAND):
            name = next((name for name in names if name in files), None)
            if name is None:
                raise SourceError(path, f"has none of {', '.join(names)}", _REMEDY)
            models.append(files[name].read_bytes())
    except (OSError, zipfile.BadZipFile) as fault:
        raise SourceError(path, *unreadable(path, f"holds no hand models: {fault}", _REMEDY)) from fault
    palm, hand = models
    return HandModels(palm, hand, str(path))


class HandNetwork:
    """One model, ready to run.

    Args:
        content: of the .tflite file.
        side: pixels of its square input.
        widths: of the wanted outputs, each the product of its shape; equal ones in the order of names.

    Raises:
        SourceError: it is another model.
        MissingDependencyError: LiteRT is not installed.
    """

    def __init__(self, content: bytes, side: int, widths: Sequence[int], where: str) -> None:
        try:
            interpreter = import_module("ai_edge_litert.interpreter").Interpreter
        except ImportError as fault:
            said = f"is not installed ({fault})"
            raise MissingDependencyError("ai-edge-litert", said, install_command("hands")) from fault
        try:
            self._interpreter = interpreter(model_content=content, num_threads=1)
            self._interpreter.allocate_tensors()
        except (ValueError, RuntimeError) as fault:
            raise SourceError(where, f"cannot be run: {fault}", _REMEDY) from fault
        (given, *_) = self._interpreter.get_input_details()
        outputs: dict[int, list[int]] = defaultdict(list)
        for item in sorted(self._interpreter.get_output_details(), key=lambda item: str(item["name"])):
            outputs[math.prod(item["shape"].tolist())].append(item["index"])
        if given["shape"].tolist() != [1, side, side, 3] or not set(widths) <= set(outputs):
            fault_text = f"is another model: takes {given['shape'].tolist()}, gives {sorted(outputs)} values"
            raise SourceError(where, fault_text, _REMEDY)
        self._input, self._outputs = given["index"], [outputs[width].pop(0) for width in widths]

    def __call__(self, image: Float32s) -> list[Float32s]:
        """Return the flat outputs for an image (side, side, 3) of values 0..1."""
        self._interpreter.set_tensor(self._input, image[None])
        self._interpreter.invoke()
        return [self._interpreter.get_tensor(index).reshape(-1) for index in self._outputs]


# -- tracking


@dataclass(frozen=True)
class Hand:
    """One hand in one image.

    Of the points, 0 is the wrist; four of each finger follow, thumb first, tips at 4, 8, 12, 16, 20.
    """

    side: str  # left or right, the person's own
    score: float  # probability that there is a hand, 0..1
    points: Floats  # (21, 2) x and y as fractions of the image's width and height; may lie outside it


@dataclass(frozen=True)
class Square:
    """A rotated square of an image: centre, side and clockwise angle."""

    x: float
    y: float
    side: float
    angle: float

    def to_image(self, size: int) -> Floats:
        """Return the (2, 3) affine map from an image of the square, `size` pixels wide, to the image."""
        scale = self.side / size
        cos, sin = math.cos(self.angle) * scale, math.sin(self.angle) * scale
        half = size / 2
        return np.array([[cos, -sin, self.x - half * (cos - sin)], [sin, cos, self.y - half * (sin + cos)]])


@dataclass(frozen=True)
class Track:
    """A tracked hand."""

    square: Square  # where the next frame is searched for it
    right: float = 0.0  # sum of P(right) over the frames it was seen in
    seen: int = 0  # number of them


class MediaPipeHands:
    """A detector of at most one left and one right hand in each frame of a video, in order.

    `mirrored` frames are as front cameras show them. Without models it takes those of $HMA_HAND_MODELS.

    Raises:
        SourceError: there are no models, or they are other models.
        MissingDependencyError: LiteRT is not installed.
    """

    def __init__(self, models: HandModels | None = None, mirrored: bool = False) -> None:
        models = models or load_models()
        widths = (ANCHORS * 18, ANCHORS)
        self._palm = HandNetwork(models.palm, PALM_SIDE, widths, f"{models.where}: palm model")
        self._hand = HandNetwork(models.hand, HAND_SIDE, (63, 1, 1), f"{models.where}: landmark model")
        self._mirrored = mirrored
        self._anchors = palm_anchors()
        self._tracks: list[Track] = []

    def reset(self) -> None:
        """Forget the frames before: the next one is of another video."""
        self._tracks = []

    def detect(self, image: Images) -> list[Hand]:
        """Return the hands in an image (H, W, 3) RGB."""
        height, width = image.shape[:2]
        tracks = self._tracks
        if len(tracks) < HANDS:
            # The palm model finds the tracked hands again; only other palms begin a track.
            known = [track.square for track in tracks]
            for palm in self._palms(image)[:HANDS]:
                square = square_of_palm(palm)
                if all(_overlap(square, other) <= SAME_SQUARE for other in known):
                    tracks = [*tracks, Track(square)]
        found: list[tuple[Track, float, Floats]] = []
        for track in tracks:
            score, points, p_right = self._look(image, track.square)
            if score < PRESENCE or any(_same(points, other) for _, _, other in found):
                continue
            square = square_of_points(points)
            found.append((Track(square, track.right + p_right, track.seen + 1), score, points))
        found = found[:HANDS]
        self._tracks = [track for track, _, _ in found]
        # A hand's side is the mean over all frames so far, because single values flicker.
        sides = choose_sides([track.right / track.seen for track in self._tracks])
        return [
            Hand(side, score, points / (width, height))
            for side, (_, score, points) in zip(sides, found, strict=True)
            if side
        ]

    def _palms(self, image: Images) -> list[Floats]:
        """Return the palms in an image, the surest first: (9, 2) two corners and seven points in pixels."""
        height, width = image.shape[:2]
        whole = Square(width / 2, height / 2, max(width, height), 0.0)
        values, scores = self._palm(cut(image, whole, PALM_SIDE))
        found = decode_palms(values.reshape(ANCHORS, 18), scores, self._anchors)
        matrix = whole.to_image(PALM_SIDE)
        return [palm * PALM_SIDE @ matrix[:, :2].T + matrix[:, 2] for palm in found]

    def _look(self, image: Images, square: Square) -> tuple[float, Floats, float]:
        """Return presence, points (21, 2) in pixels of the whole image, and P(right)."""
        values, presence, handedness = self._hand(cut(image, square, HAND_SIDE))
        matrix = square.to_image(HAND_SIDE)
        points = values.reshape(21, 3)[:, :2].astype(np.float64) @ matrix[:, :2].T + matrix[:, 2]
        plain = float(handedness[0])
        return float(presence[0]), points, 1 - plain if self._mirrored else plain


def choose_sides(p_right: Sequence[float]) -> list[str | None]:
    """Return a side for P(right) of each of at most two hands; None for the surplus hand of one side."""
    sides: list[str | None] = ["right" if p >= 0.5 else "left" for p in p_right]
    if len(sides) == 2 and sides[0] == sides[1]:
        doubtful = int(abs(p_right[1] - 0.5) <= abs(p_right[0] - 0.5))
        other = "left" if sides[0] == "right" else "right"
        sides[doubtful] = other if max(p_right[doubtful], 1 - p_right[doubtful]) < _SURE else None
    return sides


def cut(image: Images, square: Square, size: int) -> Float32s:
    """Cut a square out of an image as (size, size, 3) float32 in 0..1; black beyond the edge."""
    cv2: Any = opencv()
    matrix = square.to_image(size)
    # Here pixel i covers i to i+1; OpenCV counts from the centres of pixels.
    matrix[:, 2] += matrix[:, :2] @ (0.5, 0.5) - 0.5
    flags = cv2.INTER_LINEAR | cv2.WARP_INVERSE_MAP
    shown = cv2.warpAffine(image, matrix, (size, size), flags=flags, borderMode=cv2.BORDER_CONSTANT)
    return np.multiply(shown, np.float32(1 / 255), dtype=np.float32)


def palm_anchors() -> Floats:
    """Return the palm model's anchors, (2016, 2) x and y in 0..1: two a cell of 24×24, six of 12×12."""
    found = []
    for cells, copies in ((24, 2), (12, 6)):
        y, x = np.mgrid[:cells, :cells]
        centres = (np.stack([x, y], axis=-1).reshape(-1, 2) + 0.5) / cells
        found.append(np.repeat(centres, copies, axis=0))
    return np.concatenate(found)


def decode_palms(values: Array, scores: Array, anchors: Floats) -> list[Floats]:
    """Return the palms that the model found, the surest first, with overlapping ones merged.

    Args:
        values: (2016, 18) x, y, width, height and seven points, in pixels from the anchor.
        scores: (2016,) logits.
        anchors: (2016, 2).

    Returns:
        for each palm (9, 2): upper left, lower right and seven points, as fractions of the model's image.
    """
    chance = 1 / (1 + np.exp(-np.clip(scores.astype(np.float64), -100, 100)))
    order = np.flatnonzero(chance >= PALM_SCORE)
    order = order[np.argsort(-chance[order], kind="stable")]
    pairs = values[order].astype(np.float64).reshape(-1, 9, 2) / PALM_SIDE
    centre, half = pairs[:, 0] + anchors[order], pairs[:, 1] / 2
    points = pairs[:, 2:] + anchors[order][:, None]
    shapes = np.concatenate([(centre - half)[:, None], (centre + half)[:, None], points], axis=1)
    return merge_overlapping(shapes, chance[order])


def merge_overlapping(shapes: Floats, chances: Floats) -> list[Floats]:
    """Merge overlapping shapes (n, 9, 2) by non-maximum suppression, weighted by their probabilities (n,).

    The first two rows of a shape are corners of its box; the surest shape is first.
    """
    merged = []
    while len(shapes):
        together = box_overlap(shapes[0, :2], shapes[:, :2]) > SUPPRESSION
        together[0] = True
        merged.append(np.average(shapes[together], axis=0, weights=chances[together]))
        shapes, chances = shapes[~together], chances[~together]
    return merged


def box_overlap(box: Floats, others: Floats) -> Floats:
    """Return the intersection over union of a box (2, 2) of corners with others (n, 2, 2)."""
    low, high = np.maximum(box[0], others[:, 0]), np.minimum(box[1], others[:, 1])
    shared = np.prod(np.maximum(high - low, 0), axis=1)
    areas = np.prod(others[:, 1] - others[:, 0], axis=1) + np.prod(box[1] - box[0])
    return shared / np.maximum(areas - shared, 1e-12)


def square_of_palm(palm: Floats) -> Square:
    """Return the square of the whole hand of a palm (9, 2); up is from the wrist to the middle knuckle."""
    centre, (width, height) = (palm[0] + palm[1]) / 2, palm[1] - palm[0]
    angle = _upright(palm[2], palm[4])
    return _grown(centre, width, height, angle, scale=2.6, up=0.5)


def square_of_points(points: Floats) -> Square:
    """Return the square in which the hand of those points (21, 2) is expected in the next frame."""
    ahead = ((points[5] + points[13]) / 2 + points[9]) / 2
    angle = _upright(points[0], ahead)
    cos, sin = math.cos(angle), math.sin(angle)
    turn = np.array([[cos, -sin], [sin, cos]])  # from the hand's own axes to the image's
    own = points[_KNUCKLES] @ turn
    low, high = own.min(axis=0), own.max(axis=0)
    width, height = high - low
    return _grown(turn @ ((low + high) / 2), width, height, angle, scale=2.0, up=0.1)


def _upright(start: Floats, end: Floats) -> float:
    """Return the clockwise angle from upright of a hand that points from `start` to `end`."""
    dx, dy = end - start
    return math.remainder(math.pi / 2 - math.atan2(-dy, dx), 2 * math.pi)


def _grown(centre: Floats, width: float, height: float, angle: float, scale: float, up: float) -> Square:
    """Return the square round a rotated box, moved along the hand by `up` of its height and scaled."""
    x, y = centre + height * up * np.array([math.sin(angle), -math.cos(angle)])
    return Square(float(x), float(y), float(max(width, height, 1.0) * scale), angle)


def _overlap(one: Square, other: Square) -> float:
    mine, theirs = (np.array([s.x, s.y]) + np.array([[-0.5], [0.5]]) * s.side for s in (one, other))
    return float(box_overlap(mine, theirs[None])[0])


def _same(points: Floats, others: Floats) -> bool:
    """Check whether two sets of points are of one hand: no further apart than a third of its length."""
    apart = float(np.linalg.norm(points - others, axis=1).mean())
    return apart < float(np.linalg.norm(np.ptp(points, axis=0))) / 3
