"""Read the frames to measure a tokenizer on, from pictures, videos, recordings or a shard set's source.

S side of the square that the tokenizer takes. All frames are uint8 RGB (S, S, 3).
"""

from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.episode import Episode
from hma_data.episodes.images import Filter, prepare, resize
from hma_data.errors import EpisodeError, SourceError, TokenizerError
from hma_data.storage.paths import StrPath, as_path, as_text
from hma_data.tokenizers.base import TokenizerSpec

if TYPE_CHECKING:
    from hma_data.registry.embodiment import Embodiment

Frame = NDArray[np.uint8]
VIDEOS = {".mp4", ".avi", ".mkv", ".webm", ".gif"}
PICTURES = {".png", ".jpg", ".jpeg", ".webp", ".bmp"}
EPISODES = 16  # number of episodes taken from a recording, evenly spaced


def _ignore(text: str) -> None:
    """Do nothing; the default for callers that do not ask what was skipped."""


def read_frames(
    path: StrPath,
    size: int,
    *,
    frames: int = 64,
    resize_filter: Filter = "area",
    on_skip: Callable[[str], None] = _ignore,
) -> Iterator[Frame]:
    """Yield frames of a picture, a video, or every picture and video below a folder.

    Args:
        path: str or path of the file or folder.
        frames: number of frames taken from each video, evenly spaced.
        on_skip: called with the reason for each file in a folder that cannot be decoded.

    Raises:
        TokenizerError: the path does not exist, holds no picture and no video, or none can be decoded.
    """
    path = as_path(path)
    if not path.exists():
        raise TokenizerError(path, "no such file or folder")
    files = sorted(p for p in path.rglob("*") if p.is_file()) if path.is_dir() else [path]
    found, skipped = False, ""
    for file in files:
        if file.suffix.lower() not in VIDEOS | PICTURES:
            continue
        try:
            for picture in _pictures(file, frames):
                found = True
                yield resize(picture[None], size, "short_side_crop", resize_filter)[0]
        except TokenizerError as fault:
            if file == path:
                raise
            skipped = str(fault)
            on_skip(skipped)
    if not found:
        raise TokenizerError(
            path,
            "holds no picture and no video" + (f" that can be decoded: {skipped}" if skipped else ""),
            "name a file or folder of png, jpg, mp4; a recording needs --embodiment",
        )


def read_pictures(path: Path, frames: int) -> Iterator[Frame]:
    """Yield the picture in a file, or `frames` evenly spaced frames of a video.

    Yield nothing if the file is neither.
    """
    import cv2

    if path.suffix.lower() in VIDEOS:
        yield from _read_video(path, frames)
        return
    picture = cv2.imread(str(path), cv2.IMREAD_COLOR)
    if picture is not None:
        yield np.ascontiguousarray(picture[:, :, ::-1])


def _read_video(path: Path, frames: int) -> Iterator[Frame]:
    import av

    with av.open(str(path)) as container:
        count = sum(1 for _ in container.decode(video=0))
    wanted = set(np.linspace(0, count - 1, min(frames, count)).astype(int).tolist())
    with av.open(str(path)) as container:
        for index, frame in enumerate(container.decode(video=0)):
            if index in wanted:
                yield frame.to_ndarray(format="rgb24")


def _pictures(file: Path, frames: int) -> Iterator[Frame]:
    from av.error import FFmpegError

    count = 0
    try:
        for picture in read_pictures(file, frames):
            count += 1
            yield picture
    except (FFmpegError, IndexError) as fault:  # a container without video has no stream 0
        reason = getattr(fault, "strerror", None) or "it holds no video stream"
        raise TokenizerError(file, f"is no video that can be decoded: {reason}") from fault
    if not count:
        raise TokenizerError(file, "is no picture that can be decoded")


def recording_frames(
    embodiment: "Embodiment",
    uri: StrPath,
    spec: TokenizerSpec,
    *,
    frames: int = 64,
    on_skip: Callable[[str], None] = _ignore,
) -> Iterator[Frame]:
    """Yield frames of a recording as a conversion would tokenize them: every camera, by the robot's YAML.

    Args:
        uri: str or path of the recording, or its URI.
        frames: number of frames taken from each of up to 16 episodes, evenly spaced.
        on_skip: called with the reason for each episode that cannot be read; another episode replaces it.

    Raises:
        SourceError: the recording cannot be read, or none of its episodes can be read.
    """
    from hma_data.sources.base import open_source

    source = open_source(embodiment.source.format)
    ids = [ref.id for ref in source.index(uri, embodiment)]
    spread = np.unique(np.linspace(0, len(ids) - 1, min(EPISODES, len(ids))).astype(int)).tolist()
    others = [index for index in range(len(ids)) if index not in set(spread)]
    read, fault = 0, "it holds no episode"
    for index in spread + others:
        if read == EPISODES:
            return
        try:
            yield from _episode_frames(source.read(uri, ids[index], embodiment), embodiment, spec, frames)
            read += 1
        except (EpisodeError, SourceError) as problem:
            fault = str(problem)
            on_skip(fault)
    if not read:
        raise SourceError(as_text(uri), f"gave no frame: {fault}")


def _episode_frames(
    episode: Episode, embodiment: "Embodiment", spec: TokenizerSpec, frames: int
) -> Iterator[Frame]:
    for camera in embodiment.cameras:
        stream = episode.streams[camera.name]
        count = len(stream.timestamps)
        for at in np.unique(np.linspace(0, count - 1, min(frames, count)).astype(int)):
            yield prepare(stream.frames([at]), camera, spec.image_size, spec.resize_filter)[0]


def frames_of(
    data: StrPath,
    spec: TokenizerSpec,
    *,
    embodiment: "Embodiment | None" = None,
    frames: int = 64,
    on_skip: Callable[[str], None] = _ignore,
) -> Iterator[Frame]:
    """Return an iterator over the frames of a recording, a shard set's source, pictures or videos.

    With an embodiment, the data is a recording (a path or URI). Without one, it is a shard set, whose
    source is read, or a picture, a video or a folder of them.

    Args:
        data: str or path of the data, or the URI of a recording.

    Raises:
        TokenizerError: nothing there can be measured.
        SourceError: the recording cannot be read.
    """
    from hma_data.shards.manifest import MANIFEST, Manifest

    path, uri = as_path(data), as_text(data)
    if embodiment is None and (path / MANIFEST).is_file():
        manifest = Manifest.load(path)
        embodiment, uri = manifest.embodiment, manifest.source
    if embodiment is not None:
        return recording_frames(embodiment, uri, spec, frames=frames, on_skip=on_skip)
    size, resize_filter = spec.image_size, spec.resize_filter
    return read_frames(path, size, frames=frames, resize_filter=resize_filter, on_skip=on_skip)
