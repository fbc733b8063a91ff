"""Read HDF5 recordings: robomimic, LIBERO, raw robosuite, ALOHA/ACT, and layouts that a YAML describes.

An episode is a group (`data/demo_0`) or a whole file. The file itself shows which of the two, or
`source.layout` states it:

    source:
      format: hdf5
      layout: {episodes: "data/*", timestamps: obs/time}   # "/" means one file an episode

A uri is a file or a folder of files. Keys are paths inside the episode's group. HDF5 stores no rate: the rate
is the embodiment's `frequency_hz`, unless `layout.timestamps` names a key of times. Where images and
states have one row more than the actions (ManiSkill), `last_observation: drop` leaves out the row after the
last action.

Images are raw arrays of several shapes and number types, or one JPEG or PNG a row. Colour images of 8
bits are read as they are, with their axes found from the shape. Other arrays are read as images only where
`source.layout` says what their numbers mean: `layout: {axes: TCHW, pixels: 0-1}`. Images may also be the
frames of a video file beside the HDF5 file; see `videos`.

T frames of an episode, n of them asked for, H×W pixels, C channels.
"""

from functools import partial

import h5py
import numpy as np

from hma_data.arrays import Float32s, Floats
from hma_data.episodes.align import is_off_rate, measured_hz
from hma_data.episodes.episode import Episode, Signal, Stream, rate_times
from hma_data.errors import EpisodeError, HMAError, SourceError
from hma_data.registry.components import Hdf5Layout
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.base import SAMPLE, EpisodeRef, Inspection, read_vector
from hma_data.sources.common.checks import seconds_a_unit, seconds_of
from hma_data.sources.common.places import file_fingerprint
from hma_data.sources.common.video_file import FilmRows, VideoFile
from hma_data.sources.hdf5.file import (
    MAX_NUMBERS,
    TEXT_KEYS,
    WHOLE_FILE,
    EpisodeFinder,
    EpisodeGroup,
    RecordedRows,
    dataset,
    explained,
    inside,
    is_elsewhere,
    is_single,
    json_of,
    masks_of,
    member,
    numbers,
    text,
    walk,
)
from hma_data.sources.hdf5.images import ImageRows, image_kind
from hma_data.sources.hdf5.inspect import inspect
from hma_data.sources.hdf5.videos import SUFFIXES as VIDEO_SUFFIXES
from hma_data.sources.hdf5.videos import is_video, video_fingerprints, video_path
from hma_data.storage.files import short_sha256
from hma_data.storage.paths import StrPath, as_text

TEXTS_IN_JSON = (("problem_info", "language_instruction"), ("ep_meta", "lang"))  # of LIBERO, of RoboCasa
_SPLITS = {"train": "train"} | dict.fromkeys(("valid", "val", "validation"), "val")


def layout_of(embodiment: Embodiment | None) -> Hdf5Layout:
    """Return the layout that the YAML states; all defaults without an embodiment.

    Its `episodes` is a pattern, WHOLE_FILE where every file is one episode, or None: found from the file.
    """
    layout = Hdf5Layout.model_validate((embodiment.source.layout or {}) if embodiment else {})
    pattern = layout.episodes
    return layout.model_copy(update={"episodes": pattern and (pattern.strip("/") or WHOLE_FILE)})


class Hdf5Source:
    """A reader of HDF5 recordings; see the module."""

    def __init__(self) -> None:
        self._finder = EpisodeFinder()

    def inspect(self, uri: StrPath, episodes: int = SAMPLE) -> Inspection:
        """See Source."""
        return inspect(as_text(uri), self._finder, episodes)

    def inspect_as(self, uri: StrPath, embodiment: Embodiment, episodes: int = SAMPLE) -> Inspection:
        """See LaidOut."""
        return inspect(as_text(uri), self._finder, episodes, layout_of(embodiment).episodes)

    def episode_ids(self, uri: StrPath) -> list[str]:
        """Return the episode ids, with files by name and `demo_2` before `demo_10`."""
        return list(self._finder.all(as_text(uri)))

    def index(self, uri: StrPath, embodiment: Embodiment | None = None) -> list[EpisodeRef]:
        """Return the episodes. A damaged file among others becomes one episode, which `read` refuses.

        Raises:
            SourceError: nothing is there, the only file is damaged, or no mask has the name `source.split`.
        """
        layout = layout_of(embodiment)
        uri, chosen = as_text(uri), embodiment.source.split if embodiment else None
        refs: list[EpisodeRef] = []
        known: set[str] = set()
        for file, places in self._finder.by_file(uri, layout.episodes):
            fingerprint = file_fingerprint(file)
            films = video_fingerprints(file, embodiment.cameras, layout) if embodiment else ""
            whole = any(place.group == WHOLE_FILE for place in places.values())
            with explained(file, SourceError):
                masks = {} if whole else masks_of(self._finder.files.get(file))
            known |= set(masks)
            for episode_id, place in places.items():
                name = place.group.rsplit("/", 1)[-1]
                if chosen and name not in masks.get(chosen, ()):
                    continue
                split = None if chosen else _split_of(name, masks)
                digest = short_sha256(f"{fingerprint}{films} {place.group}")
                refs.append(EpisodeRef(episode_id, self._length(place, embodiment), split, digest))
        if chosen and chosen not in known:
            said = ", ".join(sorted(known)) or "none"
            raise SourceError(uri, f"has no mask {chosen!r}", f"its masks: {said}")
        return refs

    def read(self, uri: StrPath, episode_id: str, embodiment: Embodiment) -> Episode:
        """Return one episode; its frames are read on demand.

        Raises:
            EpisodeError: a damaged file, a missing key, a wrong width, an empty episode.
            SourceError: no such episode, or no rate and no times.
        """
        layout = layout_of(embodiment)
        place = self._finder.find(as_text(uri), episode_id, layout.episodes)
        where = str(place)
        with explained(where):
            group = self._finder.group(place)
            read = partial(numbers, group, where=where)
            actions = read_vector(embodiment.action, read, where)
            recorded = RecordedRows(group, len(actions))
            check = partial(_check_length, layout, where, recorded)
            times = _times(group, embodiment, layout, recorded, where)
            check(layout.timestamps or "", len(times))
            observed: Float32s | None = None
            if embodiment.state:
                observed = read_vector(embodiment.state, read, where)
                check(embodiment.state.components[0].key, len(observed))
            cameras: dict[str, ImageRows | FilmRows] = {}
            for camera in embodiment.cameras:
                if is_video(camera.key):
                    video = VideoFile(video_path(place.file, camera, layout))
                    cameras[camera.name] = FilmRows(video, times)
                else:
                    cameras[camera.name] = self._images(place, group, camera.key, layout)
                check(camera.key, cameras[camera.name].rows, layout.frames_missing * is_video(camera.key))
            # Rows beyond the stated number are empty buffers; a video beside the file has none.
            length = min(recorded.rows, *(images.rows for images in cameras.values()))
            longest = max(len(actions), *(images.rows for images in cameras.values()))
            unused = longest - recorded.of(longest)
            times = times[:length]
            for images in cameras.values():
                images.timestamps = times
            streams: dict[str, Stream] = dict(cameras)
            return Episode(
                id=episode_id,
                streams=streams,
                actions=(Signal(times, actions[:length]),),
                states=() if observed is None else (Signal(times, observed[:length]),),
                instruction=_instruction(group, embodiment.source.instruction, where),
                success=_success(group),
                source=where,
                metadata={"flags": {"rows_without_record": unused}},
            )

    def _images(self, place: EpisodeGroup, group: h5py.Group, key: str, layout: Hdf5Layout) -> ImageRows:
        try:
            return ImageRows(self._finder, place, key, layout)
        except EpisodeError as fault:
            if "states" in group and not any(image_kind(item) for _, item in walk(group)):
                said = "holds a simulator's states and no images"
                remedy = "render them first, as robomimic's dataset_states_to_obs.py does"
                raise EpisodeError(place, said, remedy) from fault
            raise

    def _length(self, place: EpisodeGroup, embodiment: Embodiment | None) -> int:
        """Return T, the rows of the action or else the most rows of any dataset; 0 when it cannot be read."""
        keys = [part.key for part in embodiment.action.components] if embodiment else ["actions", "action"]
        try:
            with explained(place):
                group = self._finder.group(place)
                key = next((key for key in keys if key.strip("/") in group), None)
                if key:
                    return RecordedRows(group, len(dataset(group, key, str(place)))).rows
                return max((item.shape[0] for _, item in walk(group) if item.shape), default=0)
        except HMAError:
            return 0


open = Hdf5Source


def _split_of(demo: str, masks: dict[str, set[str]]) -> str | None:
    """Return train or val by robomimic's masks; None where the masks do not tell both."""
    if not {_SPLITS.get(mask) for mask in masks} >= {"train", "val"}:
        return None
    return next((ours for mask, ours in _SPLITS.items() if demo in masks.get(mask, ())), None)


def _check_length(
    layout: Hdf5Layout, where: str, recorded: RecordedRows, key: str, rows: int, missing: int = 0
) -> None:
    """Raise an EpisodeError where a series is not as long as the actions, or one row longer to be dropped.

    Args:
        missing: rows by which the series may be shorter.
    """
    actions, length = recorded.rows, recorded.of(rows)
    one_more = length == actions + 1
    if one_more and layout.last_observation == "drop":
        return
    if not max(1, actions - missing) <= length <= actions:
        remedy = ""
        if one_more:
            remedy = (
                "if the last was observed after the last action, set source.layout.last_observation: drop"
            )
        elif key.lower().endswith(VIDEO_SUFFIXES) and length < actions:
            remedy = "if the video stopped early, set source.layout.frames_missing to the missing frames"
        raise EpisodeError(where, f"its series differ in length: actions {actions}, {key} {length}", remedy)


def _times(
    group: h5py.Group, embodiment: Embodiment, layout: Hdf5Layout, recorded: RecordedRows, where: str
) -> Floats:
    """Return the seconds of the frames: the episode's own where the YAML names their key."""
    key, hz = layout.timestamps, embodiment.frequency_hz
    if key is None:  # With an unknown rate a recording can be looked at; converting it is refused before.
        return rate_times(recorded.rows, 1.0 if hz == "unknown" else embodiment.rate_hz)
    values = numbers(group, key, where)
    values = values[: recorded.of(len(values))]
    if values.dtype.kind not in "fiu" or values.size != len(values):
        raise EpisodeError(where, f"{key!r} holds {values.shape} {values.dtype}, not one time per frame")
    times = values.reshape(-1)
    unit = seconds_a_unit(np.unique(times), key)
    found = measured_hz(np.diff(times)) if len(times) > 2 else None
    if unit is None and found and (not isinstance(hz, float) or is_off_rate(found, embodiment)):
        fault = f"{key!r} steps by {1 / found:g}, which is not known to be s, ms, µs or ns"
        raise EpisodeError(where, fault, "state frequency_hz and leave out source.layout.timestamps")
    seconds = seconds_of(times, key) if unit not in (None, 1.0) else None
    return times.astype(np.float64) if seconds is None else seconds


def _instruction(group: h5py.Group, key: str | None, where: str) -> str:
    """Return the instruction: at the YAML's key, else where robomimic, LIBERO and RoboCasa store it."""
    if key and key in group.attrs:
        return text(group.attrs[key])
    if key:
        found = member(group, key, where)
        if not isinstance(found, h5py.Dataset) or is_elsewhere(found, group):
            raise EpisodeError(where, f"{key!r} is not a text")
        return _first_text(found)
    for holder in (group, group.parent, group.file):
        for name in TEXT_KEYS:
            item = inside(holder, name)
            if said := text(holder.attrs.get(name)) or (_first_text(item) if is_single(item, group) else ""):
                return said
        for name, inner in TEXTS_IN_JSON:
            stated = json_of(holder, name).get(inner, "")
            if said := text("".join(map(str, stated)) if isinstance(stated, list) else stated):
                return said
    return ""


def _first_text(found: h5py.Dataset) -> str:
    """Return the first text of a dataset; empty where it holds none."""
    return text(found[(0,) * found.ndim]) if found.size and found.dtype.kind in "OS" else ""


def _success(group: h5py.Group) -> bool | None:
    """Return whether the episode succeeded, from its last `success` or reward; None where it is unknown.

    Rewards count where they are 0 or 1: others grow on the way. The last `done` counts only where both are
    missing, because a time-out is done too.
    """
    if "success" in group.attrs:
        stated = group.attrs["success"]
        if said := text(stated).lower():
            return {"true": True, "false": False}.get(said)
        return bool(np.all(stated))
    for key in ("success", "rewards", "dones"):
        found = inside(group, key)
        if not isinstance(found, h5py.Dataset) or is_elsewhere(found, group):
            continue
        if found.ndim == 1 and 0 < len(found) <= MAX_NUMBERS and found.dtype.kind in "fiub":
            values = found[()]
            return bool(values[-1]) if np.isin(values, (0, 1)).all() else None
    return None
