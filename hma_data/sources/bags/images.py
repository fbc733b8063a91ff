"""Turn messages into pictures: raw, compressed, and video stored one frame a message.

The types are Image and CompressedImage of sensor_msgs; CompressedImage, RawImage and CompressedVideo of
foxglove, in any encoding of messages; and FFMPEGPacket. T messages; H×W pixels, uint8 RGB.
"""

import base64
import binascii
import re
import threading
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.episodes.images import MAX_PIXELS, Images, decode_image, opencv
from hma_data.errors import EpisodeError
from hma_data.sources.bags.messages import child, field_names
from hma_data.sources.common.dtype_hints import one_channel
from hma_data.sources.common.video_file import is_spoilt

RAW, STILL, VIDEO = "raw", "still", "video"
KINDS = {
    "sensor_msgs/Image": RAW,
    "sensor_msgs/CompressedImage": STILL,
    "foxglove/RawImage": RAW,
    "foxglove/CompressedImage": STILL,
    "foxglove/CompressedVideo": VIDEO,
    "ffmpeg_image_transport_msgs/FFMPEGPacket": VIDEO,
}
DEPTH = ("compresseddepth", "16uc1", "32fc1", "mono16")
BYTES = {  # bytes of a pixel
    "rgb8": 3, "bgr8": 3, "8uc3": 3, "rgba8": 4, "bgra8": 4, "8uc4": 4, "mono8": 1, "8uc1": 1,
    "bayer_rggb8": 1, "bayer_bggr8": 1, "bayer_gbrg8": 1, "bayer_grbg8": 1,
    "yuv422": 2, "uyvy": 2, "yuv422_yuy2": 2, "yuyv": 2, "nv12": 1, "nv21": 1,
}  # fmt: skip
TO_RGB = {
    "bgr8": "BGR2RGB", "8uc3": "BGR2RGB", "rgba8": "RGBA2RGB", "bgra8": "BGRA2RGB", "8uc4": "BGRA2RGB",
    "mono8": "GRAY2RGB", "8uc1": "GRAY2RGB",
}  # fmt: skip

CODECS = {"h264": "h264", "h265": "hevc", "vp9": "vp9", "av1": "libdav1d"}  # Foxglove's and FFmpeg's names
NAL_UNIT = re.compile(b"\x00\x00\x01(.)", re.DOTALL)
AV1_SEQUENCE = 1  # type of the unit that holds a sequence header
HIGH_PROFILES = {
    100,
    110,
    122,
    244,
    44,
    83,
    86,
    118,
    128,
    138,
    139,
    134,
    135,
}  # of H.264, with a chroma format
ENCODERS = (("264", "h264"), ("265", "h265"), ("hevc", "h265"), ("vp9", "vp9"), ("av1", "av1"))


def picture_kind(message_type: str) -> str | None:
    """Return raw, still or video; None for a type without pictures."""
    short = re.sub(r"^foxglove(_msgs)?[./](msg[./])?", "foxglove/", message_type).replace("/msg/", "/")
    return KINDS.get(short)


def codec(message: Any, kind: str) -> str:
    """Return how the picture is stored: jpeg, png, raw, h264 …"""
    if kind == RAW:
        return "raw"
    if kind == VIDEO:
        return video_codec(message)
    stated = str(child(message, "format")).lower() if "format" in field_names(message) else ""
    for name in ("jpeg", "png", "webp", "avif"):
        if name in stated.replace("jpg", "jpeg"):
            return name
    return stated


def video_codec(message: Any) -> str:
    """Return h264, h265, vp9, av1, or another codec that the message states.

    FFMPEGPacket names the encoder (libx264, hevc_nvenc), or the codec first: "h264;yuv420p;bgr8;bgr8".
    """
    if "format" in field_names(message):
        return str(child(message, "format")).lower()
    stated = str(child(message, "encoding")).lower().partition(";")[0]
    return next((codec for name, codec in ENCODERS if name in stated), stated)


def picture(message: Any, kind: str, where: str) -> Images:
    """Return a raw or still picture as (H, W, 3) RGB.

    Raises:
        EpisodeError: it is not colour or grey of 8 bits, its sizes do not fit, or its bytes are no picture.
    """
    try:
        if kind == RAW:
            return _raw(message, where)
        stated = str(child(message, "format"))
        if any(name in stated.lower() for name in DEPTH):
            raise EpisodeError(where, f"{stated!r} is depth, not colour", "name a colour topic as camera")
        return decode_image(payload(message), where)
    except (KeyError, TypeError, ValueError) as fault:
        raise EpisodeError(where, f"a message is not a picture: {fault!r}") from fault


def is_grey(message: Any, kind: str) -> bool:
    """Check whether a raw or still picture has one channel."""
    if kind == RAW:
        return str(child(message, "encoding")).lower() in ("mono8", "8uc1")
    return kind == STILL and one_channel(payload(message))


def payload(message: Any) -> bytes:
    """Return the stored bytes of a picture; JSON stores them in base64."""
    data = child(message, "data")
    if isinstance(data, str):
        try:
            return base64.b64decode(data, validate=True)
        except binascii.Error as fault:
            raise ValueError(f"data is not base64: {fault}") from fault
    return data.tobytes() if isinstance(data, np.ndarray) else bytes(data)


def _raw(message: Any, where: str) -> Images:
    encoding = str(child(message, "encoding"))
    height, width, step = (int(child(message, name)) for name in ("height", "width", "step"))
    pixel = BYTES.get(encoding.lower())
    if pixel is None:
        raise EpisodeError(
            where, f"pictures in {encoding!r} are not 8-bit colour", f"these can be read: {', '.join(BYTES)}"
        )
    if not 0 < height * width <= MAX_PIXELS or min(height, width) < 1:
        raise EpisodeError(where, f"a picture claims {width}×{height} pixels")
    step = step or width * pixel
    data = child(message, "data")
    flat = data if isinstance(data, np.ndarray) else np.frombuffer(payload(message), np.uint8)
    if step < width * pixel or len(flat) < step * (height - 1) + width * pixel:
        raise EpisodeError(
            where, f"a picture of {width}×{height} in {encoding} has {len(flat):,} bytes, rows of {step}"
        )
    if len(flat) < step * height:  # the last row may end with its last pixel
        flat = np.concatenate([flat, np.zeros(step * height - len(flat), np.uint8)])
    if encoding.lower() in ("nv12", "nv21"):
        return _semi_planar(flat, height, width, step, encoding.lower(), where)
    rows = flat[: step * height].reshape(height, step)[:, : width * pixel]
    return _to_rgb(np.ascontiguousarray(rows).reshape(height, width, pixel), encoding.lower())


def _semi_planar(
    flat: NDArray[np.uint8], height: int, width: int, step: int, encoding: str, where: str
) -> Images:
    """Convert NV12 or NV21: rows of luma, then half as many rows with both colour channels interleaved."""
    rows = height * 3 // 2
    if height % 2 or width % 2 or len(flat) < step * (rows - 1) + width:
        raise EpisodeError(where, f"a picture of {width}×{height} in {encoding} has {len(flat):,} bytes")
    flat = np.concatenate([flat, np.zeros(max(0, step * rows - len(flat)), np.uint8)])
    planes = np.ascontiguousarray(flat[: step * rows].reshape(rows, step)[:, :width])
    cv2 = opencv()
    return cv2.cvtColor(planes, cv2.COLOR_YUV2RGB_NV12 if encoding == "nv12" else cv2.COLOR_YUV2RGB_NV21)


def _to_rgb(pixels: NDArray[np.uint8], encoding: str) -> Images:
    cv2 = opencv()
    if encoding.startswith("bayer_"):
        pattern = encoding.removeprefix("bayer_").removesuffix("8").upper()
        return cv2.cvtColor(np.ascontiguousarray(pixels[..., 0]), getattr(cv2, f"COLOR_Bayer{pattern}2RGB"))
    if encoding in ("yuv422", "uyvy"):
        return cv2.cvtColor(np.ascontiguousarray(pixels), cv2.COLOR_YUV2RGB_UYVY)
    if encoding in ("yuv422_yuy2", "yuyv"):
        return cv2.cvtColor(np.ascontiguousarray(pixels), cv2.COLOR_YUV2RGB_YUY2)
    if encoding in TO_RGB:
        return cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{TO_RGB[encoding]}"))
    return pixels


# -- video


def is_keyframe(data: bytes, codec: str) -> bool | None:
    """Check whether decoding can begin at a message; None for a codec that is not parsed."""
    kinds = {unit[1][0] for unit in NAL_UNIT.finditer(data)}
    if codec == "h264":
        return any(kind & 0x1F == 5 for kind in kinds)
    if codec == "h265":
        return any(16 <= (kind >> 1) & 0x3F <= 21 for kind in kinds)
    return {"vp9": _vp9_begins, "av1": _av1_begins}.get(codec, lambda data: None)(data)


def _vp9_begins(data: bytes) -> bool:
    """Check whether the first frame is a key frame: VP9 bitstream specification, uncompressed_header."""
    if not data or data[0] >> 6 != 2:
        raise ValueError("no VP9 frame")
    at = 5 if data[0] >> 4 & 3 == 3 else 4  # bits: marker 2, profile 2, of profile 3 one more
    shows_existing, inter = data[0] >> (7 - at) & 1, data[0] >> (6 - at) & 1
    return not shows_existing and not inter


def _av1_begins(data: bytes) -> bool:
    """Check for a sequence header, which comes with every key frame: AV1 specification, section 5.3."""
    at = 0
    while at < len(data):
        kind, extended, sized = data[at] >> 3 & 15, data[at] & 4, data[at] & 2
        at += 2 if extended else 1
        size, shift = (0, 0) if sized else (len(data), 0)
        while sized and at < len(data):
            size |= (data[at] & 0x7F) << shift
            at, shift = at + 1, shift + 7
            if not data[at - 1] & 0x80:
                break
        if kind == AV1_SEQUENCE:
            return True
        at += size
    return False


class VideoDecoder:
    """Decode a video; continue from the last frame when asked in order, else begin at a key frame.

    Args:
        codec: h264, h265, vp9 or av1.
        keyframes: (T,) bool, where decoding can begin; True at 0.
        fetch: yields the stored bytes of the messages from a position to the last.
        where: the episode and topic, for the error.

    Raises:
        EpisodeError: the codec is not one of these.
    """

    def __init__(
        self, codec: str, keyframes: NDArray[np.bool_], fetch: Callable[[int], Iterator[bytes]], where: str
    ) -> None:
        if codec not in CODECS:
            raise EpisodeError(where, f"video in {codec!r} cannot be read", f"these can: {', '.join(CODECS)}")
        self._codec, self._keyframes, self._fetch, self._where = codec, keyframes, fetch, where
        self._context: Any = None
        self._next = 0  # the message that the decoder takes next
        self._taken = -1  # the last picture returned
        self._ready: dict[int, Any] = {}  # pictures decoded but not returned yet; None for a damaged one
        self._spoilt = False  # whether the last decoded picture, or one it may depend on, is damaged
        self._count = H264Count()
        self._lost = -1  # the first message since the last key frame that lacks an earlier picture
        self._made_without: dict[int, int] = {}  # message -> the first one that lacks an earlier picture

    def frames(self, indices: Sequence[int]) -> dict[int, Images]:
        """Return the picture (H, W, 3) of each of those indices.

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
                if any(i > index and self._keyframes[i] for i in self._ready):
                    raise EpisodeError(self._where, f"frame {index} of the video cannot be decoded")
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
        self._count, self._lost, self._made_without = H264Count(), -1, {}
        self._next = int(np.flatnonzero(self._keyframes[: index + 1])[-1])
        self._taken = self._next - 1

    def _follow(self, index: int, misses: bool) -> None:
        """Note whether message `index`, or one it may depend on, lacks an earlier picture."""
        if self._keyframes[index]:
            self._lost = -1
        elif misses and self._lost < 0:
            self._lost = index
        if self._lost >= 0:
            self._made_without[index] = self._lost

    def _decode(self, data: bytes | None, wanted: int) -> None:
        """Give the decoder its next message; with None, let it finish."""
        import av

        if self._context is None:
            raise EpisodeError(self._where, f"frame {wanted} of the video cannot be decoded")
        packet = None
        if data is not None:
            packet = av.Packet(data)
            packet.pts = packet.dts = self._next
        try:
            with _missing_references(self._codec) as missing:
                frames = self._context.decode(packet)
        except (av.FFmpegError, ValueError) as fault:
            self._context = None
            raise EpisodeError(self._where, f"frame {wanted} of the video: {fault}") from fault
        if data is None:
            self._context = None
        else:
            lost = not self._count.complete(data) if self._codec == "h264" else bool(missing)
            self._follow(self._next, lost)
            self._next += 1
        for frame in frames:
            if frame.width * frame.height > MAX_PIXELS:
                raise EpisodeError(self._where, f"the video claims {frame.width}×{frame.height} pixels")
            self._spoilt = is_spoilt(frame, self._spoilt)
            if frame.pts is not None:
                self._ready[frame.pts] = None if self._spoilt else frame


_LOGGING = threading.Lock()  # PyAV's log settings hold for the whole process


@contextmanager
def _missing_references(codec: str) -> Iterator[list[str]]:
    """Gather FFmpeg's log messages on missing reference pictures; it writes them for H.265 only.

    A decoder goes on without a lost picture, and marks no frame as damaged. So a loss is found in other ways:
    in H.264 by the numbers of the pictures (H264Count), in H.265 by the log. In AV1, dav1d returns no picture
    that depends on a lost one.
    """
    import av.logging as log

    missing: list[str] = []
    if codec != "h265":
        yield missing
        return
    with _LOGGING, log.Capture() as said:
        level, skip = log.get_level(), log.get_skip_repeated()
        log.set_level(log.ERROR)
        log.set_skip_repeated(False)
        try:
            yield missing
        finally:
            log.set_level(level)
            log.set_skip_repeated(skip)
            missing += [text for _, _, text in said if "Could not find ref" in text]


class H264Count:
    """Check the numbers of H.264's reference pictures: each has the number after the last, or the same.

    The number is frame_num in ITU-T H.264, 7.3.2.1, 7.3.3 and 7.4.3. FFmpeg does not report missing ones.
    """

    def __init__(self) -> None:
        self._bits: dict[int, int] = {}  # sequence parameter set -> bits of frame_num, where it is checked
        self._of: dict[int, int] = {}  # picture parameter set -> sequence parameter set
        self._last: int | None = None  # frame_num of the reference picture before

    def complete(self, data: bytes) -> bool:
        """Check whether all pictures that a message depends on came before; True where it is unknown."""
        starts = [found.end() - 1 for found in NAL_UNIT.finditer(data)]
        whole = True
        for start, end in zip(starts, [*starts[1:], len(data) + 3]):
            with suppress(ValueError):  # the decoder reports what is wrong with the unit
                whole &= self._unit(data[start : end - 3])
        return whole

    def _unit(self, unit: bytes) -> bool:
        kind, reference, bits = unit[0] & 31, bool(unit[0] >> 5 & 3), _Bits(unit[1:97])
        if kind == 7:
            self._sequence(bits)
        elif kind == 8:
            number = bits.ue()
            self._of[number] = bits.ue()
        if kind not in (1, 2, 5) or bits.ue():  # not the first slice of a picture
            return True
        bits.ue()  # its type
        size = self._bits.get(self._of.get(bits.ue(), 0))
        if size is None:
            return True
        number, before = bits.u(size), self._last
        if reference or kind == 5:
            self._last = number
        return kind == 5 or before is None or number in (before, (before + 1) % (1 << size))

    def _sequence(self, bits: "_Bits") -> None:
        """Learn a sequence parameter set; forms that are rare in live video are not checked."""
        profile = bits.u(8)
        bits.u(16)
        number = bits.ue()
        self._bits.pop(number, None)
        if profile in HIGH_PROFILES:
            if bits.ue() == 3 and bits.u(1):  # colour planes are coded separately
                return
            bits.ue(), bits.ue(), bits.u(1)  # depths, transform bypass
            if bits.u(1):  # scaling lists
                return
        size, order = bits.ue() + 4, bits.ue()
        if order == 1:
            return
        if order == 0:
            bits.ue()
        bits.ue()  # reference frames
        if not bits.u(1):  # gaps in frame_num are not allowed
            self._bits[number] = size


class _Bits:
    """Read the syntax elements of a unit; raise ValueError where it ends before."""

    def __init__(self, unit: bytes) -> None:
        plain = unit.replace(b"\x00\x00\x03", b"\x00\x00")  # drop the emulation prevention bytes
        self._text = "".join(f"{byte:08b}" for byte in plain)
        self._at = 0

    def u(self, bits: int) -> int:
        """Read an unsigned number of `bits` bits."""
        self._at += bits
        if self._at > len(self._text):
            raise ValueError("the unit ends in its header")
        return int(self._text[self._at - bits : self._at] or "0", 2)

    def ue(self) -> int:
        """Read an unsigned Exp-Golomb number."""
        zeros = self._text.index("1", self._at) - self._at
        self._at += zeros
        return self.u(zeros + 1) - 1
