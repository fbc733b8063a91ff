"""Draw the labelled hands of a video into an MP4.

The left hand is orange with filled dots, the right hand blue with rings. A grey bar at the top marks a frame
that is in no run, or that is masked because a needed hand is missing. A cross without fingers is a held
position.
"""

from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.images import Images, opencv
from hma_data.episodes.sheets import write_mp4
from hma_data.errors import EpisodeError
from hma_data.registry.embodiment import Embodiment, find
from hma_data.sources.hands.runs import SIDES, Runs
from hma_data.sources.hands.source import HandsSource
from hma_data.storage.paths import StrPath, as_path

WIDEST = 640  # pixels; larger pictures are shown smaller
COLOURS = {"left": (230, 159, 0), "right": (86, 180, 233)}  # safe without colour vision
LEFT_OUT = (128, 128, 128)
_FINGERS = [[0, 1, 2, 3, 4], *([0, *range(start, start + 4)] for start in (5, 9, 13, 17))]
_PALM = [5, 9, 13, 17]


def preview(
    uri: StrPath,
    out: StrPath,
    embodiment: Embodiment | None = None,
    video: str | None = None,
    first: int = 0,
    limit: int = 300,
) -> Path:
    """Draw the hands of a video into an MP4.

    Args:
        uri: str or path of a video or a folder of videos.
        out: str or path of the file to write.
        embodiment: states the origin of the labels; None takes `hand_video`, the detector.
        video: its name in the folder; the first video by default.
        first, limit: index of the first frame shown, and most frames shown.

    Returns:
        out.

    Raises:
        SourceError: no such video, no models or labels.
        EpisodeError: the video or its labels are damaged.
    """
    source = HandsSource()
    name = video or source.episode_ids(uri)[0]
    file, runs = source.runs(uri, name, embodiment or find("hand_video"))
    chosen = np.arange(len(file))[first : first + limit]
    if not len(chosen):
        raise EpisodeError(file.path, f"has {len(file)} frames, none from {first} on")
    pictures = (annotated(file.frames([index])[0], runs, int(index)) for index in chosen)
    final = as_path(out)
    write_mp4(final, pictures, file.table.hz or 30.0)
    return final


def annotated(picture: Images, runs: Runs, frame: int) -> Images:
    """Return one picture (H, W, 3), at most 640 wide, with the hands of that video frame drawn in."""
    cv2: Any = opencv()
    scale = min(1.0, WIDEST / picture.shape[1])
    size = (round(picture.shape[1] * scale), round(picture.shape[0] * scale))
    shown: Images = cv2.resize(picture, size, interpolation=cv2.INTER_AREA).copy()
    row = int(np.searchsorted(runs.labels.frames, frame))
    if row == len(runs.labels) or runs.labels.frames[row] != frame:
        return shown
    if runs.missing[row] or not any(start <= row < stop for start, stop in runs.spans):
        cv2.rectangle(shown, (0, 0), (size[0], max(4, size[1] // 40)), LEFT_OUT, -1)
    for side in SIDES:
        points = {
            part: runs.labels.points[f"{side}/{part}"][row] for part in ("landmarks", "wrist", "center")
        }
        _draw(shown, {part: at for part, at in points.items() if np.isfinite(at).all()}, side)
    return shown


def _draw(picture: Images, points: dict[str, NDArray[np.float64]], side: str) -> None:
    cv2: Any = opencv()
    size, colour = (picture.shape[1], picture.shape[0]), COLOURS[side]
    dot = max(2, size[0] // 200)
    thick = -1 if side == "left" else max(1, dot // 2)
    placed = {part: np.rint(at.reshape(-1, 2) * size).astype(np.int32) for part, at in points.items()}
    if "landmarks" in placed:
        joints = placed["landmarks"]
        lines = [joints[finger] for finger in [*_FINGERS, _PALM]]
        cv2.polylines(picture, lines, False, colour, max(1, dot // 2), cv2.LINE_AA)
        for x, y in joints.tolist():
            cv2.circle(picture, (x, y), dot, colour, thick, cv2.LINE_AA)
    elif "wrist" in placed:
        cv2.circle(picture, placed["wrist"][0].tolist(), 2 * dot, colour, thick, cv2.LINE_AA)
    if "center" in placed:
        x, y = placed["center"][0].tolist()
        cv2.drawMarker(picture, (x, y), colour, cv2.MARKER_CROSS, 8 * dot, dot, cv2.LINE_AA)
        where = (x + 3 * dot, y - 3 * dot)
        cv2.putText(picture, side[0].upper(), where, cv2.FONT_HERSHEY_SIMPLEX, 0.7, colour, 2, cv2.LINE_AA)
