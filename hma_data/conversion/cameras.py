"""Choose the cameras that a conversion stores, read episodes with them, and say what becomes of the pictures.

Without a choice, only the primary camera is stored. All cameras of the YAML are read even then: a stream that
is not stored still limits the time at which every stream runs.
"""

from collections.abc import Sequence

from hma_data.episodes.align import to_clip
from hma_data.episodes.episode import Clip
from hma_data.errors import EpisodeError, HMAError, SourceError, StorageAwayError
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import Source

ALL = "all"


def chosen(embodiment: Embodiment, cameras: Sequence[str]) -> list[str]:
    """Return the names of the cameras to store; the first one is that of the first token column.

    Args:
        cameras: names; ("all",) takes all of the YAML, the primary one first; none takes the primary one.

    Raises:
        RegistryError: the embodiment lacks a camera.
    """
    primary = embodiment.primary_camera.name
    if tuple(cameras) == (ALL,):
        return [primary, *(camera.name for camera in embodiment.cameras if camera.name != primary)]
    return list(dict.fromkeys(embodiment.camera(name).name for name in cameras)) or [primary]


def read_clip(
    source: Source, uri: str, episode_id: str, embodiment: Embodiment, cameras: Sequence[str]
) -> Clip:
    """Return an episode with the cameras that are stored.

    A fault of a camera that is not stored does not refuse the episode: it is then read without those.

    Raises:
        EpisodeError: the episode cannot be used. If it could be without one of several cameras, the error
            names that camera.
    """

    def read(names: Sequence[str]) -> Clip:
        robot = embodiment.with_cameras(names)
        return to_clip(source.read(uri, episode_id, robot), robot)

    def is_readable(names: Sequence[str]) -> bool:
        try:
            return bool(len(read(names)))
        except (EpisodeError, SourceError):
            return False

    every = [camera.name for camera in embodiment.cameras]
    try:
        return read(every)
    except StorageAwayError:
        raise
    except (EpisodeError, SourceError) as fault:
        if len(cameras) < len(every) and is_readable(cameras):
            return read(cameras)
        for name in cameras if len(cameras) > 1 else ():
            if is_readable([other for other in cameras if other != name]):
                raise camera_fault(episode_id, name, cameras, fault) from fault
        raise


def camera_fault(episode_id: str, camera: str, cameras: Sequence[str], fault: Exception) -> EpisodeError:
    """Return the error of an episode in which one of several cameras cannot be read."""
    said = fault.fault if isinstance(fault, HMAError) else f"{type(fault).__name__}: {fault}"
    others = ",".join(name for name in cameras if name != camera)
    remedy = f"--cameras {others} leaves {camera} out"
    return EpisodeError(episode_id, f"camera {camera} cannot be read: {said}", remedy)
