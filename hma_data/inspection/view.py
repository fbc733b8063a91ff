"""Show an episode in Rerun: cameras, decoded tokens, actions, states and skew on one clock.

The timelines are `time`, seconds since the episode's first frame, and `frame`. The entities are
`cameras/NAME` and `decoded/NAME` (frames), `actions`, `states`, `skew_ms/STREAM` (curves), `about` (text).

T frames, H×W pixels, A values a frame.
"""

import re
from collections.abc import Iterable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.arrays import Array, Images, Ints
from hma_data.episodes.align import to_clip
from hma_data.episodes.episode import Clip
from hma_data.episodes.images import opencv, prepared
from hma_data.errors import MissingDependencyError, UsageError, install_command
from hma_data.registry.embodiment import Embodiment, find
from hma_data.shards.preview import tokenizer_of
from hma_data.shards.reader import EpisodeReader, ShardSet
from hma_data.shards.schema import token_column
from hma_data.sources.base import open_source
from hma_data.sources.common.choice import ids_for_robot
from hma_data.storage.files import atomic_path
from hma_data.storage.paths import StrPath, as_path, as_text
from hma_data.tables import Table
from hma_data.tokenizers.base import Tokenizer, get_tokenizer

JPEG_QUALITY = 92  # percent
FRAMES_AT_ONCE = 16  # in memory
CURVE_GROUPS = re.compile(r"^(skew_ms|training/loss|held_out/loss)/.*")  # curves of one scale share a view


def rerun() -> Any:
    """Import and return the rerun module.

    Raises:
        MissingDependencyError: the extra `view` is not installed.
    """
    try:
        import rerun as rr
        import rerun.blueprint
    except ImportError as fault:
        remedy = install_command("view")
        raise MissingDependencyError("hma view", "rerun-sdk is not installed", remedy) from fault
    return rr


class View:
    """A recording for Rerun, with its blueprint: the frames above, the curves below.

    Args:
        name: of the recording.
        times: (T,) seconds of the frames; more curves may have times of their own.

    Raises:
        MissingDependencyError: rerun-sdk is not installed.
    """

    def __init__(self, name: str, times: NDArray[np.floating]) -> None:
        self._rr, self.times = rerun(), np.asarray(times, np.float64)
        self._stream = self._rr.RecordingStream("hma_view")
        self._stream.send_recording_name(name)
        self._shown: list[str] = []  # entities of images
        self._drawn: list[str] = []  # entities of curves, or of groups of them

    def pictures(self, entity: str, batches: Iterable[Images]) -> None:
        """Add the images (n, H, W, 3) RGB of all frames, in batches."""
        cv2, rr, start = opencv(), self._rr, 0
        self._shown.append(entity)
        for frames in batches:
            jpegs = [
                cv2.imencode(".jpg", frame[..., ::-1], [cv2.IMWRITE_JPEG_QUALITY, JPEG_QUALITY])[1].tobytes()
                for frame in frames
            ]
            rows = np.arange(start, start + len(jpegs))
            columns = rr.EncodedImage.columns(blob=jpegs, media_type=["image/jpeg"] * len(jpegs))
            self._stream.send_columns(entity, self._clock(rows), columns)
            start += len(jpegs)

    def curves(self, entity: str, values: Array, names: Sequence[str]) -> None:
        """Add values (T, A), one curve a column; NaN leaves a gap."""
        self._draw(entity, self._clock(np.arange(len(values))), values, names)

    def steps(self, entity: str, steps: Sequence[int], values: Sequence[float]) -> None:
        """Add a figure of a training run, on the timeline `step`."""
        index = [self._rr.TimeColumn("step", sequence=steps)]
        self._draw(entity, index, np.asarray(values, np.float64)[:, None], [entity.split("/")[-1]])

    def text(self, markdown: str) -> None:
        """Add what is known about the episode."""
        document = self._rr.TextDocument(markdown, media_type="text/markdown")
        self._stream.log("about", document, static=True)

    def save(self, out: StrPath) -> None:
        """Write an .rrd file; it is whole or absent.

        Raises:
            OutputError: it cannot be written.
        """
        with atomic_path(as_path(out)) as part:
            part.touch()  # of a place that cannot be written, Rerun's own error would tell nothing
            self._stream.save(part, default_blueprint=self._blueprint())
            self._stream.flush()
            self._stream.disconnect()

    def open(self) -> None:
        """Open the viewer on this machine's display."""
        self._stream.spawn(default_blueprint=self._blueprint())

    def _clock(self, rows: Ints) -> list[Any]:
        rr = self._rr
        return [rr.TimeColumn("time", duration=self.times[rows]), rr.TimeColumn("frame", sequence=rows)]

    def _draw(self, entity: str, index: list[Any], values: Array, names: Sequence[str]) -> None:
        rr = self._rr
        self._drawn.append(entity)
        self._stream.log(entity, rr.SeriesLines(names=list(names)), static=True)
        scalars = rr.Scalars.columns(scalars=np.asarray(values, np.float64).ravel())
        self._stream.send_columns(entity, index, scalars.partition([values.shape[1]] * len(values)))

    def _blueprint(self) -> Any:
        rrb = self._rr.blueprint
        seen = [rrb.Spatial2DView(origin=entity, name=entity) for entity in self._shown]
        groups = dict.fromkeys(CURVE_GROUPS.sub(r"\1", entity) for entity in self._drawn)
        drawn = [rrb.TimeSeriesView(origin=group, name=group) for group in groups]
        below = rrb.Horizontal(
            rrb.Vertical(*drawn), rrb.TextDocumentView(origin="about"), column_shares=[3, 1]
        )
        page = rrb.Vertical(rrb.Grid(*seen), below) if seen else below
        panel = rrb.TimePanel(timeline="time" if len(self.times) else "step")
        return rrb.Blueprint(page, panel, collapse_panels=True)


def view_recording(
    uri: StrPath, embodiment: StrPath, episode: int = 0, tokenizer: StrPath | None = None
) -> View:
    """Show an episode of a recording, as a conversion reads it.

    Args:
        uri: str or path of the recording, or its URI.
        embodiment: id, or str or path of a YAML.
        episode: number of the episode, in the order of the recording.
        tokenizer: name of one whose decoded tokens are shown beside each camera; None shows none.

    Raises:
        UsageError: the recording has no such episode.
        EpisodeError: the episode cannot be used.
    """
    uri, robot = as_text(uri), find(embodiment)
    source = open_source(robot.source.format)
    ids = ids_for_robot([ref.id for ref in source.index(uri, robot)], robot)
    clip = to_clip(source.read(uri, _number(ids, episode, uri), robot), robot)
    coder = get_tokenizer(as_text(tokenizer)) if tokenizer else None
    view = View(f"{robot.id} {clip.episode.id}", clip.timestamps)
    for camera in robot.cameras:
        rows = _parts(np.arange(len(clip)))
        view.pictures(f"cameras/{camera.name}", (clip.frames_at(camera.name, some) for some in rows))
        if coder:
            view.pictures(f"decoded/{camera.name}", _coded(clip, robot, camera.name, coder))
    _vectors(view, robot, clip.actions, clip.states, clip.action_known, clip.state_known)
    for stream, skew in clip.skew_ms.items():
        view.curves(f"skew_ms/{stream}", skew[:, None], [stream])
    facts = {"robot": robot.id, "episode": clip.episode.id, "recording": uri, "frames": len(clip)}
    told = {"instruction": clip.episode.instruction, "success": clip.episode.success}
    view.text(_table(facts | told | clip.flags))
    return view


def view_shards(folder: StrPath, episode: int = 0) -> View:
    """Show an episode of a shard set; its frames are decoded from the tokens.

    Args:
        folder: str or path of the set, or its URI.
        episode: number of the episode, in the order of episodes.parquet.

    Raises:
        UsageError: the set has no such episode.
        TokenizerError: the set's tokenizer is not available here.
    """
    shards = ShardSet(folder)
    ids = shards.episodes["id"].to_pylist()
    _number(ids, episode, str(shards.folder))
    coder = tokenizer_of(shards)
    row = shards.episodes.slice(episode, 1).to_pylist()[0]
    robot, cameras = shards.embodiment, shards.manifest.cameras
    reader = EpisodeReader(shards, shards.columns(cameras))
    columns = {camera: reader.episode(row, camera) for camera in cameras}
    first = columns[cameras[0]]
    view = View(f"{robot.id} {row['id']}", first["timestamp"])
    for camera in cameras:
        tokens = shards.tokens(columns[camera][token_column(shards.spec)[0]])
        view.pictures(f"decoded/{camera}", (coder.decode(part) for part in _parts(tokens)))
    actions = first["action"][:, : robot.action_dim]  # the first command of a strided chunk
    _vectors(view, robot, actions, *(first.get(name) for name in ("state", "action_known", "state_known")))
    facts = {"robot": robot.id, "tokenizer": shards.spec.name, "shards": str(shards.folder)}
    told = ("id", "split", "length", "instruction", "success", "skew_p50_ms", "skew_max_ms", "flags")
    view.text(_table(facts | {name: row[name] for name in told}))
    return view


def _vectors(view: View, robot: Embodiment, actions: Array, *others: Array | None) -> None:
    """Add the curves of the actions, and of the others: states, then which actions and states are known."""
    states, *known = others
    drawn = (("actions", actions, robot.action), ("states", states, robot.state))
    for (name, values, vector), mask in zip(drawn, known, strict=True):
        if values is not None and vector:
            shown = values if mask is None else np.where(mask[:, None], values, np.nan)
            view.curves(name, shown, vector.names())


def _coded(clip: Clip, robot: Embodiment, camera: str, tokenizer: Tokenizer) -> Iterator[Images]:
    """Yield the images of the frames after the tokenizer has encoded and decoded them."""
    spec, stream = tokenizer.spec, clip.episode.streams[camera]
    for rows in _parts(clip.frame_indices[camera]):
        frames = prepared(stream, rows, robot.camera(camera), spec.image_size, spec.resize_filter)
        yield tokenizer.decode(tokenizer.encode(frames))


def _parts(values: Array) -> Iterator[Array]:
    return (values[start : start + FRAMES_AT_ONCE] for start in range(0, len(values), FRAMES_AT_ONCE))


def _number(ids: Sequence[str], episode: int, where: str) -> str:
    if episode >= len(ids):
        raise UsageError("--episode", f"{where} has {len(ids)} episodes, the first is 0")
    return ids[episode]


def _table(facts: dict[str, Any]) -> str:
    return Table(["", ""], [pair for pair in facts.items() if pair[1] not in ("", None)]).markdown()
