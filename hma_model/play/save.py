"""Save what was driven: as a film, or as a LeRobotDataset of one episode that converts like any recording."""

import shutil
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any

import numpy as np

from hma_data.arrays import Images
from hma_data.episodes.images import decode_image, opencv
from hma_data.episodes.sheets import gif_bytes, write_mp4, write_text
from hma_data.registry.embodiment import Embodiment
from hma_data.registry.export import packed_components
from hma_data.sources.lerobot.writer import LeRobotEpisode, write_lerobot
from hma_model.play.session import Frame, Session
from hma_model.worlds.scenes import Drivable

FILE_KINDS = {  # name -> media type and ending
    "mp4": ("video/mp4", ".mp4"),
    "gif": ("image/gif", ".gif"),
    "lerobot": ("application/zip", ".zip"),
}
DRIVEN = "driven in a world model by hma play; the images are the model's"
SIDE, HEAD, GAP = 320, 26, 8  # pixels of a panel, of its title, between panels
TELL_S = 0.2  # between two messages on how far a file is
GIF_SIDE, GIF_FRAMES = 192, 600  # smaller and shorter: a GIF is large


Told = Callable[[str, int, int], None]  # is told what is done, and how many frames of how many are


def film(
    kind: str, robot: Drivable, frames: Sequence[Frame], on_progress: Told = lambda words, done, total: None
) -> bytes:
    """Return a file of frames.

    Args:
        kind: a key of FILE_KINDS.
        robot: that was driven.
        frames: in their order.
        on_progress: called with what is done, and how many frames of how many are.
    """
    hz = robot.embodiment.effective_hz
    if all(frame.true is None for frame in frames[1:]):
        frames = [replace(frames[0], true=None), *frames[1:]]
    truth = "truth, decoded" if robot.source == "recordings" else "truth"
    if kind == "gif":
        return gif_bytes(_counted(frames[-GIF_FRAMES:], GIF_SIDE, truth, on_progress), hz)
    with TemporaryDirectory(prefix="hma-play-") as folder:
        if kind == "mp4":
            path = Path(folder) / "film.mp4"
            write_mp4(path, _counted(frames, SIDE, truth, on_progress), hz)
            return path.read_bytes()
        home = Path(folder) / robot.embodiment.id
        episode, embodiment = lerobot_episode(robot, frames)
        total = len(episode.action)
        made_by = {"by": "hma play", "synthetic": True}
        write_lerobot(
            home, embodiment, [episode], lambda done, words: on_progress(words, done, total), made_by
        )
        on_progress("packing the files", total, total)
        return Path(shutil.make_archive(str(home), "zip", home.parent, home.name)).read_bytes()


def told_by(session: Session, kind: str) -> Told:
    """Return what tells a session's viewer how far a file is: new words at once, frames now and then."""
    before = 0.0
    words_before = ""

    def tell(words: str, done: int, total: int) -> None:
        nonlocal before, words_before
        now = time.monotonic()
        if words == words_before and now - before < TELL_S:
            return
        before = now
        words_before = words
        if viewer := session.viewer:
            viewer.tell({"kind": "saving", "file": kind, "text": words, "done": done, "total": total})

    return tell


def _counted(frames: Sequence[Frame], side: int, truth: str, on_progress: Told) -> Iterator[Images]:
    for done, panel in enumerate(panels(frames, side, truth), 1):
        yield panel
        on_progress("writing frames" if done < len(frames) else "encoding the film", done, len(frames))


def panels(frames: Sequence[Frame], side: int, truth: str) -> Iterator[Images]:
    """Return the model's images, and the true ones beside them, with titles; an unknown one is white."""
    wide = any(frame.true is not None for frame in frames)
    for frame in frames:
        score = "" if frame.psnr is None else f", PSNR {frame.psnr:.1f} dB"
        shown = [_panel(f"world model{score}", frame.model, side)]
        if wide:
            true = np.full_like(shown[0], 255) if frame.true is None else _panel(truth, frame.true, side)
            shown += [np.full((side + HEAD, GAP, 3), 255, np.uint8), true]
        yield np.concatenate(shown, axis=1)


def _panel(title: str, data: bytes, side: int) -> Images:
    cv2 = opencv()
    image = decode_image(data, "a frame")
    width = round(side * image.shape[1] / image.shape[0])
    large = cv2.resize(image, (width, side), interpolation=cv2.INTER_CUBIC)
    panel = np.full((side + HEAD, width, 3), 255, np.uint8)
    panel[HEAD:] = large
    write_text(panel, title, (4, HEAD - 9), 0.45)
    return panel


# -- LeRobot


def lerobot_episode(robot: Drivable, frames: Sequence[Frame]) -> tuple[LeRobotEpisode, Embodiment]:
    """Return what was driven at the control rate, and the embodiment that describes it.

    A row holds an action and the frame before it, which stands for `stride` rows; after the last frame the
    last action is held. For each camera another one, with `_true` at the end of its name, has the true
    images.
    """
    stride = robot.embodiment.stride
    views = len(robot.cameras)
    following = [*frames[1:], frames[-1]]
    actions = np.concatenate([frame.actions for frame in following])
    shown = {"": [frame.model for frame in frames]}
    if all(frame.true is not None for frame in frames):
        shown["_true"] = [frame.true or b"" for frame in frames]
    cameras = {
        name + end: _Views(images, view, views)
        for end, images in shown.items()
        for view, name in enumerate(robot.cameras)
    }
    states = [frame.state for frame in frames if frame.state is not None]
    stated = robot.embodiment.state is not None and len(states) == len(frames)
    size = cameras[robot.cameras[0]][0].shape[:2]
    own = embodiment_of(robot.embodiment, DRIVEN, size, list(cameras), stated)
    seen = {camera.key: views for camera, views in zip(own.cameras, cameras.values(), strict=True)}
    state = np.stack(states).repeat(stride, axis=0) if own.state else None
    return LeRobotEpisode(seen, actions, state, "driven by hand in a world model", hold=stride), own


class _Views(Sequence[Images]):
    """One of several views side by side in JPEG images; an image is decoded when it is asked for."""

    def __init__(self, images: Sequence[bytes], view: int, views: int) -> None:
        self._images = images
        self._view = view
        self._views = views

    def __len__(self) -> int:
        return len(self._images)

    def __getitem__(self, index: Any) -> Any:
        return np.split(decode_image(self._images[index], "a frame"), self._views, axis=1)[self._view]


def embodiment_of(
    robot: Embodiment, recording: str, size: tuple[int, ...], cameras: Sequence[str], with_state: bool = False
) -> Embodiment:
    """Return the embodiment of a dataset that is saved of a model; LeRobot's rates are whole numbers.

    Args:
        robot: the robot.
        recording: how it was made, for its provenance.
        size: height and width of the images.
        cameras: their names.
        with_state: whether there are states.
    """
    values = robot.to_dict()
    hz = max(1, round(robot.rate_hz))
    rate = "" if hz == robot.rate_hz else f"; the robot runs at {robot.rate_hz:g} Hz"
    kept = {key: values[key] for key in ("id", "description", "robot", "license") if key in values}
    own = kept | {
        "kind": "simulation",
        "frequency_hz": hz,
        "stride": robot.stride,
        "action": {"space": robot.action.space, "components": packed_components(values["action"], "action")},
        "cameras": [
            {"name": name, "key": f"observation.images.{name}", "size": list(size)} for name in cameras
        ],
        "source": {"format": "lerobot"},
        "provenance": {
            "recording": recording,
            "frequency_hz": f"the robot's control rate{rate}",
        },
    }
    if with_state:
        own["state"] = {"components": packed_components(values["state"], "observation.state")}
    return Embodiment.from_values(own, f"embodiment {robot.id}")
