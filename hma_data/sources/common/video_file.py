"""Read frames of a video file by index, decoding only the frames that are needed.

A first pass over the packets, without decoding, gives the exact time of every frame and the keyframes.
Reading then keeps one decoder in position. It decodes on while the next frame asked for lies ahead within the
same keyframe group; it seeks when that frame lies behind or after another keyframe. A file whose keyframes or
times differ from what the container says is decoded from its beginning.

PyAV's wheel contains its codecs, AV1 among them. OpenCV is not used here, because for AV1 it returns no
frames and no error.
"""

import os
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from hma_data.arrays import Floats, Images, Indices, Ints
from hma_data.episodes.episode import OneByOne, of_one_size
from hma_data.episodes.images import MAX_PIXELS, FrameToRGB, refuse_hdr
from hma_data.errors import EpisodeError
from hma_data.storage.kinds import unreadable

THREADS = 1  # of FFmpeg, for each decoder: the work is parallel over episodes, not within one
# Allow plain files only: a playlist or list of files must not pass for a video and open other files.
_OPTIONS = {
    "protocol_whitelist": "file",
    "format_whitelist": "mov,mp4,m4a,3gp,3g2,mj2,matroska,webm,avi,gif,mpeg,mpegts,flv,ogg,asf",
}

_REFRESHED = ("h264", "hevc")  # codecs whose "keyframe" may only begin a gradual refresh
_INTRA = 1  # FFmpeg's AV_PICTURE_TYPE_I


@dataclass(frozen=True)
class FrameTable:
    """The frames of a video, as its packets describe them; N frames in the order they are shown.

    Attributes:
        times: (N,) seconds, rising.
        stamps: (N,) the same in ticks of the stream.
        keys: (N,) for each frame the index of the keyframe its decoding starts from.
        seek_stamps: (N,) ticks to seek to for that keyframe; may differ from when it is shown.
        width, height: pixels of the decoded frames.
        codec: h264, av1, hevc, vp9, …
        hz: stated rate; None where the file states none.
        state: size of the file in bytes, and its time of change in ns.
        counted: whether the container's times are those of packets, not of frames (B-frames in AVI);
            frames are then identified only by the order in which they are decoded.
    """

    times: Floats
    stamps: Ints
    keys: Ints
    seek_stamps: Ints
    width: int
    height: int
    codec: str
    hz: float | None
    state: tuple[int, int]
    counted: bool = False

    def __len__(self) -> int:
        return len(self.times)


def frame_table(path: Path) -> FrameTable:
    """Return the frames of a video file; only the first is decoded, for its size.

    Raises:
        EpisodeError: there is no such file, no video in it, or it is damaged or HDR.
    """
    try:
        state = path.stat()
    except OSError as fault:
        raise EpisodeError(
            path, *unreadable(path, "no such video file", "copy the recording again, whole")
        ) from fault
    return _cached_table(str(path), state.st_size, state.st_mtime_ns)


@lru_cache(maxsize=64)  # LeRobotDataset v3 keeps hundreds of episodes in one file
def _cached_table(path: str, size: int, changed: int) -> FrameTable:
    with opened(path) as (container, stream):
        width, height = decoded_size(container, stream)
        refuse_hdr(stream.codec_context, path)
    with opened(path) as (container, stream):
        shown: list[int] = []
        keyframes: list[tuple[int, int]] = []
        delays: set[int | None] = set()
        for packet in container.demux(stream):
            if packet.size == 0:
                continue
            stamp = packet.dts if packet.pts is None else packet.pts
            if stamp is None:
                raise EpisodeError(path, "its frames carry no times", "rewrite it as MP4")
            if packet.is_corrupt:
                raise EpisodeError(path, f"is damaged or cut off at frame {len(shown)}", "copy it again")
            delays.add(None if packet.pts is None or packet.dts is None else packet.pts - packet.dts)
            if packet.is_keyframe:
                keyframes.append((stamp, stamp if packet.dts is None else packet.dts))
            if not packet.is_discard:  # an edit list may hide frames, which are decoded but not shown
                shown.append(stamp)
        timeless = "avi" in container.format.name or delays <= {0, None}
        stamps = np.sort(np.array(shown, np.int64))
        if not len(stamps) or not keyframes:
            raise EpisodeError(path, "has no frames")
        if (np.diff(stamps) == 0).any():
            raise EpisodeError(path, f"has two frames at {stamps[np.diff(stamps, append=-1) == 0][0]} ticks")
        starts = np.array(sorted(keyframes), np.int64)  # (K, 2): shown at, seek to
        order = np.maximum(np.searchsorted(starts[:, 0], stamps, side="right") - 1, 0)
        return FrameTable(
            times=stamps.astype(np.float64) * np.float64(stream.time_base),
            stamps=stamps,
            keys=np.searchsorted(stamps, starts[order, 0]),
            seek_stamps=starts[order, 1],
            width=width,
            height=height,
            codec=stream.codec.canonical_name,
            hz=float(stream.average_rate) if stream.average_rate else None,
            state=(size, changed),
            counted=bool(stream.codec_context.has_b_frames) and timeless and len(delays) == 1,
        )


class VideoFile(OneByOne):
    """A video file as an array of frames; it opens on first use, and again after a fork."""

    def __init__(self, path: Path) -> None:
        self.path = path
        self.table = frame_table(path)
        self._process = 0
        self._container: Any = None
        self._decoder: Iterator[Any] = iter(())
        self._next = 0  # index of the frame the decoder gives next
        self._entry = -1  # index of the keyframe of the last seek
        self._counts, self._seeks = False, True  # whether frames are counted; whether seeking is used
        self._spoilt = False  # whether the last frame, or a frame it may depend on, is damaged
        self._converter: Any = None

    def __len__(self) -> int:
        return len(self.table)

    @property
    def timestamps(self) -> Floats:
        """Return (N,) seconds by the file's own clock."""
        return self.table.times

    def each(self, indices: Indices, least: int = 0) -> Iterator[Images]:
        """Yield the image (H, W, 3) RGB uint8 of each of those frames; rising indices are fastest.

        Raises:
            EpisodeError: a frame cannot be decoded, or the frames change size.
        """
        with _explained(str(self.path)):
            yield from of_one_size(map(self._image, map(int, indices)), str(self.path))

    def close(self) -> None:
        """Close the file; the next `frames` opens it again."""
        if self._container is not None:
            self._container.close()
        self._container, self._decoder = None, iter(())

    def __del__(self) -> None:
        if getattr(self, "_process", 0) == os.getpid():
            self.close()

    def _image(self, index: int) -> Images:
        try:
            frame = self._frame(index)
        except EpisodeError:
            if self._counts:
                raise
            self._count()
            frame = self._frame(index)
        if self._spoilt:
            raise EpisodeError(self.path, f"frame {index} is damaged, or depends on a damaged one")
        return _upright(self._converter(frame), frame)

    def _count(self) -> None:
        """Identify frames only by their decoding order from here on.

        Raises:
            EpisodeError: the file gives another number of frames than its packets state.
        """
        self._reopen()
        given = sum(1 for _ in self._decoder)
        if given != len(self):
            raise EpisodeError(self.path, f"gives {given} frames, its packets state {len(self)}")
        self._counts, self._seeks = True, False
        self._reopen()

    def _frame(self, index: int) -> Any:
        if self.table.counted and not self._counts:
            self._count()
        self._position(index)
        frame = self._decode_up_to(index)
        if frame is None:  # the seek went past the frame: try again from the beginning
            self._reopen()
            frame = self._decode_up_to(index)
        if frame is None:
            raise EpisodeError(self.path, f"frame {index} of {len(self)} cannot be decoded")
        return frame

    def _decode_up_to(self, index: int) -> Any:
        for frame in self._decoder:
            self._spoilt = is_spoilt(frame, self._spoilt)
            found = self._next if self._counts else self._index_of(frame)
            if found == self._entry and self.table.codec in _REFRESHED and frame.pict_type != _INTRA:
                self._seeks = False  # a refresh spread over many frames: the next frames are incomplete
                return None
            self._next = found + 1
            if found >= index:
                return frame if found == index else None
        return None

    def _position(self, index: int) -> None:
        """Move the decoder to a position before that frame."""
        if self._container is None or self._process != os.getpid():
            self._reopen()
        if not self._seeks:
            if index < self._next:
                self._reopen()
        elif index < self._next or self.table.keys[index] > self._next:
            stream = self._container.streams.best("video")
            self._container.seek(int(self.table.seek_stamps[index]), stream=stream, backward=True)
            self._decoder, self._spoilt = self._container.decode(stream), False
            self._next = self._entry = int(self.table.keys[index])

    def _reopen(self) -> None:
        # A parent's decoder is dropped without closing it: after a fork, both share the file's position.
        self._container, self._process = _open(str(self.path)), os.getpid()
        stream = _video_stream(self._container, str(self.path))
        stream.codec_context.thread_count = THREADS
        stream.codec_context.options = {"max_pixels": str(MAX_PIXELS)}
        self._decoder, self._next, self._entry = self._container.decode(stream), 0, -1
        self._spoilt = False
        self._converter = FrameToRGB(str(self.path))  # one for all frames: making one takes long

    def _index_of(self, frame: Any) -> int:
        """Return the frame's index; -1 for a frame that comes before the first shown."""
        if frame.pts is None:
            raise EpisodeError(self.path, f"frame {self._next} has no time")
        index = int(np.searchsorted(self.table.stamps, frame.pts))
        if index < len(self) and self.table.stamps[index] == frame.pts:
            return index
        if index == 0:
            return -1
        raise EpisodeError(self.path, f"gives a frame at {frame.pts} ticks, which no packet states")


class FilmRows(OneByOne):
    """A camera's Stream: `rows` frames of a video file, at times (T,) of the recording's own.

    Args:
        indices: of the frames in the file; all of them by default.
    """

    def __init__(self, file: VideoFile, times: Floats, indices: Ints | None = None) -> None:
        self.timestamps = times
        self._file, self._indices = file, np.arange(len(file)) if indices is None else indices
        self.rows = len(self._indices)

    def each(self, indices: Indices, least: int = 0) -> Iterator[Images]:
        """See episode.OneByOne."""
        return self._file.each(self._indices[np.asarray(indices, np.int64)])


def _quarters(frame: Any) -> int:
    """Return the quarter turns to the left that a frame asks for: phones state here how they were held."""
    return round(frame.rotation / 90) % 4


def _upright(image: Images, frame: Any) -> Images:
    """Return the image turned as the frame asks, and mirrored, as front cameras do."""
    quarters, matrix = _quarters(frame), frame.side_data.get("DISPLAYMATRIX")
    if matrix is not None:
        a, b, _, c, d, *_ = np.frombuffer(matrix, np.int32).tolist()
        if a * d < b * c:
            image, quarters = image[:, ::-1], quarters + 2
    return np.rot90(image, quarters)


def decoded_size(container: Any, stream: Any) -> tuple[int, int]:
    """Return width and height of the decoded frames, by the first; of the header where it is damaged.

    The container is read beyond that frame then.
    """
    from av.error import FFmpegError

    stream.codec_context.thread_count = THREADS
    try:
        frame = next(container.decode(stream), None)
    except FFmpegError:
        frame = None
    if frame is None:
        return stream.width, stream.height
    return (frame.height, frame.width) if _quarters(frame) % 2 else (frame.width, frame.height)


def is_spoilt(frame: Any, before: bool) -> bool:
    """Check whether a decoded frame is damaged, or may depend on a damaged one.

    Args:
        frame: PyAV's.
        before: whether the frame decoded before it is spoilt.
    """
    return bool(frame.is_corrupt or (before and not frame.key_frame))


@contextmanager
def opened(path: str | Path) -> Iterator[tuple[Any, Any]]:
    """Open a video file; yield its container and its video stream, and raise FFmpeg's errors as ours.

    Raises:
        EpisodeError: it is not a video, or it is damaged.
    """
    with _explained(str(path)), _open(str(path)) as container:
        yield container, _video_stream(container, str(path))


def _open(path: str) -> Any:
    import av

    return av.open(path, container_options=_OPTIONS)  # passing them to streams too crashes PyAV on FLV


def _video_stream(container: Any, path: str) -> Any:
    stream = container.streams.best("video")
    if stream is None:
        raise EpisodeError(path, "has no video in it")
    if stream.codec_context is None or not stream.width:
        raise EpisodeError(path, "holds video of an unknown codec", "the file may be damaged")
    if stream.width * stream.height > MAX_PIXELS:
        raise EpisodeError(path, f"claims {stream.width}×{stream.height} pixels, more than {MAX_PIXELS:,}")
    return stream


@contextmanager
def _explained(path: str) -> Iterator[None]:
    from av.error import FFmpegError

    try:
        yield
    except (FFmpegError, MemoryError, OverflowError, UnicodeDecodeError) as fault:
        said = getattr(fault, "strerror", None) or fault
        remedy = "it may be cut off or damaged: copy it again"
        fault_and_remedy = unreadable(Path(path), f"cannot be decoded as video: {said}", remedy)
        raise EpisodeError(path, *fault_and_remedy) from fault
