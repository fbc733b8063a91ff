"""Video stored one frame a message (foxglove CompressedVideo), decoded in order.

T messages; H×W pixels, uint8 RGB.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.errors import EpisodeError
from hma_data.sources.bags.av1 import SEQUENCE, units
from hma_data.sources.bags.nal import order
from hma_data.sources.video_file import is_spoilt
from hma_data.video import MAX_PIXELS, Images

CODECS = {"h264": "h264", "h265": "hevc", "vp9": "vp9", "av1": "libdav1d"}  # Foxglove's and FFmpeg's names
NAL_UNIT = re.compile(b"\x00\x00\x01(.)", re.DOTALL)


def is_keyframe(data: bytes, codec: str) -> bool | None:
    """Whether decoding can begin at this message; None for a codec that is not looked into."""
    kinds = {unit[1][0] for unit in NAL_UNIT.finditer(data)}
    if codec == "h264":
        return any(kind & 0x1F == 5 for kind in kinds)
    if codec == "h265":
        return any(16 <= (kind >> 1) & 0x3F <= 21 for kind in kinds)
    return {"vp9": _vp9_begins, "av1": _av1_begins}.get(codec, lambda data: None)(data)


def _vp9_begins(data: bytes) -> bool:
    """Whether the first frame is a key frame: VP9 bitstream specification, uncompressed_header."""
    if not data or data[0] >> 6 != 2:
        raise ValueError("no VP9 frame")
    at = 5 if data[0] >> 4 & 3 == 3 else 4  # bits: marker 2, profile 2, of profile 3 one more
    shows_existing, inter = data[0] >> (7 - at) & 1, data[0] >> (6 - at) & 1
    return not shows_existing and not inter


def _av1_begins(data: bytes) -> bool:
    """Whether a sequence header is in it, as with every key frame: AV1 specification, section 5.3."""
    return any(kind == SEQUENCE for kind, _ in units(data))


class VideoDecoder:
    """Pictures of a video; goes on where it stopped when asked in order, else begins at a key frame.

    Args:
        codec: h264, h265, vp9 or av1.
        keyframes: (T,) bool, where decoding can begin; True at 0.
        fetch: the stored bytes of the messages from a position to the last.
        where: the episode and topic, for the error.

    Raises:
        EpisodeError: the codec is another.
    """

    def __init__(
        self, codec: str, keyframes: NDArray[np.bool_], fetch: Callable[[int], Iterator[bytes]], where: str
    ) -> None:
        if codec not in CODECS:
            raise EpisodeError(where, f"video in {codec!r} cannot be read", f"these can: {', '.join(CODECS)}")
        self._codec, self._keyframes, self._fetch, self._where = codec, keyframes, fetch, where
        self._context: Any = None
        self._next = 0  # message the decoder takes next
        self._taken = -1  # last picture given out
        self._ready: dict[int, Any] = {}  # decoded, not given out; None for a damaged one
        self._spoilt = False  # whether the last one decoded, or one it may be made from, is damaged
        self._order = order(codec)
        self._lost = -1  # the first message since the last key frame that misses one before it
        self._made_without: dict[int, int] = {}  # message -> the one from which on a picture is missing

    def frames(self, indices: Sequence[int]) -> dict[int, Images]:
        """Picture (H, W, 3) of each of those indices.

        Raises:
            EpisodeError: one of them, or one it builds on, cannot be decoded.
        """
        found: dict[int, Images] = {}
        packets: Iterator[bytes] | None = None
        for index in sorted(set(indices)):
            if index not in self._ready and self._must_begin(index):
                self._begin(index)
                packets = None
            while index not in self._ready:
                packets = packets or self._fetch(self._next)
                self._decode(next(packets, None), index)
            frame = self._ready[index]
            self._ready = {i: frame for i, frame in self._ready.items() if i >= index}
            self._taken = index
            if index in self._made_without:
                fault = f"a picture before frame {self._made_without[index]} of the video is missing"
                raise EpisodeError(self._where, f"{fault}, and frame {index} is made from it")
            if frame is None:
                raise EpisodeError(
                    self._where,
                    f"frame {index} of the video is damaged, or one before it that it is made from",
                )
            found[index] = frame.to_ndarray(format="rgb24")
        return found

    def _must_begin(self, index: int) -> bool:
        skips = bool(self._keyframes[self._next + 1 : index + 1].any())
        return self._context is None or index <= self._taken or skips

    def _begin(self, index: int) -> None:
        import av

        self._context = av.CodecContext.create(CODECS[self._codec], "r")
        self._context.thread_count = 1
        self._ready, self._spoilt = {}, False
        self._order, self._lost, self._made_without = order(self._codec), -1, {}
        self._next = int(np.flatnonzero(self._keyframes[: index + 1])[-1])
        self._taken = self._next - 1

    def _follow(self, data: bytes) -> None:
        """Notes whether messages are missing before the next one."""
        whole = self._order.complete(data)
        if self._keyframes[self._next]:
            self._lost = -1
        elif not whole and self._lost < 0:
            self._lost = self._next
        if self._lost >= 0:
            self._made_without[self._next] = self._lost

    def _decode(self, data: bytes | None, wanted: int) -> None:
        """Gives the decoder its next message, or with None lets it finish."""
        import av

        if self._context is None:
            raise EpisodeError(self._where, f"frame {wanted} of the video cannot be decoded")
        packet = None
        if data is not None:
            packet = av.Packet(data)
            packet.pts = packet.dts = self._next
            self._follow(data)
            self._next += 1
        try:
            frames = self._context.decode(packet)
        except (av.FFmpegError, ValueError) as fault:
            self._context = None
            raise EpisodeError(self._where, f"frame {wanted} of the video: {fault}") from fault
        if data is None:
            self._context = None
        for frame in frames:
            if frame.width * frame.height > MAX_PIXELS:
                raise EpisodeError(self._where, f"the video claims {frame.width}×{frame.height} pixels")
            self._spoilt = is_spoilt(frame, self._spoilt)
            if frame.pts is not None:
                self._ready[frame.pts] = None if self._spoilt else frame
