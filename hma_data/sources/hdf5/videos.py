"""Read the images of an HDF5 file from video files beside it: frame i of a video is row i of the file.

A camera whose key ends as a video file does is such a path, relative to the HDF5 file's folder:
`videos/front.mp4`. A name in braces is replaced by its value in the JSON file that `layout.metadata` names, a
pattern in the same folder: `recordings/MP4/{wrist_cam_serial}.mp4`. `{file}` is the name of the HDF5 file
without its ending: `{file}_front.mp4`. `*` stands for any characters; one file must match.

T rows of an episode, N frames of a video.
"""

import fnmatch
import re
from collections.abc import Iterable, Iterator
from contextlib import suppress
from functools import lru_cache
from itertools import islice
from pathlib import Path
from typing import Any

from hma_data.errors import EpisodeError, HMAError
from hma_data.registry.components import Camera, Hdf5Layout
from hma_data.sources.common.inspection import KeyInfo
from hma_data.sources.common.places import file_fingerprint, require_inside
from hma_data.sources.common.video_file import VideoFile
from hma_data.storage.files import parse_json

SUFFIXES = (".mp4", ".mkv", ".avi", ".mov", ".webm")
MAX_JSON = 16 << 20  # most bytes of the file of `layout.metadata`
MAX_NAMES = 12  # names in an error
FILE = "{file}"  # in a key: the HDF5 file's name without its ending
MAX_LISTED = 1_000  # files beside an HDF5 file among which videos are looked for
MAX_VIDEOS = 8  # videos of one episode
_NAME = re.compile(r"\{(\w+)\}")
_WILD = re.compile(r"[*?\[]")


def is_video(key: str) -> bool:
    """Check whether a camera's key is of a video file beside the HDF5 file."""
    return key.lower().endswith(SUFFIXES)


def video_path(file: Path, camera: Camera, layout: Hdf5Layout) -> Path:
    """Return the video file of a camera.

    Args:
        file: the HDF5 file.
        camera: its key is the path; see the module.

    Raises:
        EpisodeError: there is no such file, or several; or the JSON file lacks a name of the key.
    """
    folder, key = file.parent, camera.key.replace(FILE, file.stem)
    if names := _NAME.findall(key):
        values = _metadata(file, layout)
        for name in names:
            if not isinstance(values.get(name), str | int):
                known = ", ".join(sorted(map(str, values))[:MAX_NAMES]) or "nothing"
                raise EpisodeError(file, f"{layout.metadata} has no {name!r} for {key}", f"it has {known}")
            key = key.replace(f"{{{name}}}", str(values[name]))
    return _one(file, folder, key, f"camera {camera.name}")


def videos_beside(file: Path) -> list[str]:
    """Return the video files below the folder of an HDF5 file, as a camera's key would name them."""
    inside = islice(file.parent.rglob("*"), MAX_LISTED)
    films = [item for item in inside if item.suffix.lower() in SUFFIXES]
    found = sorted(item.relative_to(file.parent) for item in films)
    if _is_alone(file):
        return [path.as_posix() for path in found]
    name = re.compile(rf"(?<![A-Za-z0-9]){re.escape(file.stem)}(?!\d)")  # run_1 is no part of run_10
    return [name.sub(FILE, path.as_posix()) for path in found]


def video_keys(file: Path) -> Iterator[KeyInfo]:
    """Yield the videos of an HDF5 file that is one episode, as cameras.

    Where other HDF5 files lie in the folder, a video must have the file's name in its own.
    """
    alone = _is_alone(file)
    for key in [key for key in videos_beside(file) if alone or FILE in key][:MAX_VIDEOS]:
        with suppress(HMAError, OSError):
            video = VideoFile(file.parent / key.replace(FILE, file.stem))
            size = (video.table.height, video.table.width, 3)
            yield KeyInfo(key, "camera", size, "uint8", codec=video.table.codec, count=len(video))


def _is_alone(file: Path) -> bool:
    return sum(item.suffix == file.suffix for item in file.parent.iterdir()) == 1


def video_fingerprints(file: Path, cameras: Iterable[Camera], layout: Hdf5Layout) -> str:
    """Return a text that changes when a video does; empty without videos, and where one cannot be found."""
    found = ""
    for camera in cameras:
        if not is_video(camera.key):
            continue
        with suppress(HMAError, OSError):
            found += f" {file_fingerprint(video_path(file, camera, layout))}"
    return found


def _metadata(file: Path, layout: Hdf5Layout) -> dict[str, Any]:
    if not layout.metadata:
        remedy = "set source.layout.metadata to the JSON file with its value, such as metadata_*.json"
        raise EpisodeError(file, "a camera's key has a name in braces", remedy)
    path = _one(file, file.parent, layout.metadata, "source.layout.metadata")
    try:
        if path.stat().st_size > MAX_JSON:
            raise ValueError(f"it has more than {MAX_JSON:,} bytes")
        values = parse_json(path.read_bytes())
    except (OSError, ValueError, RecursionError) as fault:
        raise EpisodeError(path, f"cannot be read as JSON: {fault}", "copy it again") from fault
    return values if isinstance(values, dict) else {}


def _one(file: Path, folder: Path, pattern: str, what: str) -> Path:
    """Return the one file below the folder that matches.

    Raises:
        EpisodeError: none does, several do, or it lies outside of the folder.
    """
    if Path(pattern).is_absolute() or ".." in Path(pattern).parts:
        raise EpisodeError(file, f"{what}: {pattern} leads out of its folder", "give a path below it")
    path = folder / pattern
    if not path.is_file():
        found = _matching(folder, pattern)
        if len(found) != 1:
            fault = f"{len(found)} files match" if found else "there is no"
            beside = sorted(
                item.relative_to(folder).as_posix()
                for item in islice(folder.rglob("*"), MAX_LISTED)
                if item.suffix.lower() in (*SUFFIXES, ".json")
            )
            remedy = f"next to it are {', '.join(beside[:MAX_NAMES]) or 'no videos'}"
            raise EpisodeError(file, f"{what}: {fault} {pattern}", remedy)
        [path] = found
    require_inside(path, folder)
    return path


def _matching(folder: Path, pattern: str) -> list[Path]:
    """Return the files below the folder that match; a folder of thousands is not listed for each episode."""
    *above, name = Path(pattern).parts
    place = folder.joinpath(*above)
    if _WILD.search("/".join(above)):
        found = list(folder.glob(pattern))
    elif place.is_dir():
        found = [place / one for one in fnmatch.filter(_names(place, place.stat().st_mtime_ns), name)]
    else:
        found = []
    return sorted(item for item in found if item.is_file())


@lru_cache(maxsize=8)
def _names(folder: Path, changed: int) -> list[str]:
    return [item.name for item in folder.iterdir()]
