"""Turn messages into images: raw, compressed, and video stored one frame a message.

The types are Image and CompressedImage of sensor_msgs; CompressedImage, RawImage and CompressedVideo of
foxglove, in any encoding of messages; and FFMPEGPacket. T messages; H×W pixels, uint8 RGB.
"""

import base64
import re
import threading
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.arrays import Bools, Floats, Images, Indices, Ints
from hma_data.episodes.episode import OneByOne, of_one_size
from hma_data.episodes.images import MAX_PIXELS, FrameToRGB, decode_image, image_codec, opencv, refuse_hdr
from hma_data.errors import EpisodeError
from hma_data.sources.bags.bag import Bag
from hma_data.sources.bags.container import Channel
from hma_data.sources.bags.messages import child, decode, field_names
from hma_data.sources.common.checks import one_channel
from hma_data.sources.common.video_file import is_spoilt

RAW, STILL_IMAGE, VIDEO = "raw", "still", "video"
KINDS = {
    "sensor_msgs/Image": RAW,
    "sensor_msgs/CompressedImage": STILL_IMAGE,
    "foxglove/RawImage": RAW,
    "foxglove/CompressedImage": STILL_IMAGE,
    "foxglove/CompressedVideo": VIDEO,
    "ffmpeg_image_transport_msgs/FFMPEGPacket": VIDEO,
}
DEPTH = ("compresseddepth", "16uc1", "32fc1")
MONO16 = "mono16"  # grey of 16 bits; `levels` of the camera say what becomes black and white
Levels = tuple[float, float]
ENCODINGS = {  # of raw images: bytes of a pixel, OpenCV's conversion to RGB
    "rgb8": (3, ""), "bgr8": (3, "BGR2RGB"), "8uc3": (3, "BGR2RGB"),
    "rgba8": (4, "RGBA2RGB"), "bgra8": (4, "BGRA2RGB"), "8uc4": (4, "BGRA2RGB"),
    "mono8": (1, "GRAY2RGB"), "8uc1": (1, "GRAY2RGB"),
    "bayer_rggb8": (1, "BayerRGGB2RGB"), "bayer_bggr8": (1, "BayerBGGR2RGB"),
    "bayer_gbrg8": (1, "BayerGBRG2RGB"), "bayer_grbg8": (1, "BayerGRBG2RGB"),
    "yuv422": (2, "YUV2RGB_UYVY"), "uyvy": (2, "YUV2RGB_UYVY"),
    "yuv422_yuy2": (2, "YUV2RGB_YUY2"), "yuyv": (2, "YUV2RGB_YUY2"),
    "nv12": (1, "YUV2RGB_NV12"), "nv21": (1, "YUV2RGB_NV21"),
}  # fmt: skip
CODECS = {"h264": "h264", "h265": "hevc", "vp9": "vp9", "av1": "libdav1d"}  # Foxglove's and FFmpeg's names
ENCODERS = (("264", "h264"), ("265", "h265"), ("hevc", "h265"), ("vp9", "vp9"), ("av1", "av1"))
BLOCK = 64  # video messages fetched at a time
NAL_UNIT = re.compile(b"\x00\x00\x01(.)", re.DOTALL)
START_CODES = (b"\x00\x00\x01", b"\x00\x00\x00\x01")  # of H.264 and H.265 as a byte stream
# The first two bytes of H.265's parameter sets, of its delimiter and of messages before them.
H265_HEADS = (b"\x40\x01", b"\x42\x01", b"\x44\x01", b"\x46\x01", b"\x4e\x01")
AV1_SEQUENCE = 1  # type of the unit that holds a sequence header
AV1_DELIMITER = b"\x12\x00"  # the unit before it, where it is stored
# What FFmpeg logs where a reference image is missing, and the level of that message.
MISSING = {"h264": ("DEBUG", "Frame num gap"), "h265": ("ERROR", "Could not find ref")}


def image_kind(message_type: str) -> str | None:
    """Return raw, still or video; None for a type without images."""
    short = re.sub(r"^foxglove(_msgs)?[./](msg[./])?", "foxglove/", message_type).replace("/msg/", "/")
    return KINDS.get(short)


def content_kind(message: Any, kind: str | None) -> str | None:
    """Return the kind of a message's content: a CompressedImage may hold a frame of H.264 or H.265."""
    if kind != STILL_IMAGE or message is None:
        return kind
    try:
        return VIDEO if payload(message).startswith(START_CODES) else STILL_IMAGE
    except (KeyError, TypeError, ValueError):  # `picture` raises it again
        return STILL_IMAGE


def codec(message: Any, kind: str) -> str:
    """Return how the image, which is no video, is stored: jpeg, png, raw …"""
    if kind == RAW:
        return "raw"
    stated = _stated(message)
    return next(
        (name for name in ("jpeg", "png", "webp", "avif") if name in stated.replace("jpg", "jpeg")), stated
    )


def _stated(message: Any) -> str:
    """Return in lower case how a message says that its image is stored, in `format` or `encoding`."""
    names = [name for name in ("format", "encoding") if name in field_names(message)]
    return str(child(message, names[0])).lower() if names else ""


def video_codec(message: Any) -> str:
    """Return h264, h265, vp9, av1, or another codec that the message states; its content goes first.

    FFMPEGPacket names the encoder (libx264, hevc_nvenc), or the codec first: "h264;yuv420p;bgr8;bgr8".
    CompressedImage names the encoding of the pixels first: "bgr8; h264 compressed".
    """
    data = payload(message)
    unit = NAL_UNIT.search(data, 0, 8) if data.startswith(START_CODES) else None
    if unit and (head := data[unit.end() - 1 : unit.end() + 1]):
        if head in H265_HEADS:
            return "h265"
        if head[0] & 0x1F in (7, 9):  # a parameter set, or the delimiter before it
            return "h264"
    stated = _stated(message)
    known = next((codec for word, codec in ENCODERS if word in stated), "")
    return known or stated.partition(";")[0]


def encoding(message: Any, kind: str) -> str:
    """Return the encoding of the pixels in lower case, such as mono8; empty where the message states none.

    image_transport begins the format of compressed images with it: "mono8; jpeg compressed".
    """
    before, separator, _ = _stated(message).partition(";")
    return before if kind == RAW or (separator and kind == STILL_IMAGE) else ""


def picture(message: Any, kind: str, where: str, levels: Levels | None = None, least: int = 0) -> Images:
    """Return a raw or still image as (H, W, 3) RGB.

    Args:
        levels: the values of 16-bit grey that become 0 and 255.
        least: as in `decode_image`.

    Raises:
        EpisodeError: it is not colour or grey of 8 bits, its sizes do not fit, or its bytes are no image;
            or it is grey of 16 bits and there are no levels.
    """
    try:
        stated = _stated(message)
        if kind == STILL_IMAGE and any(name in stated for name in DEPTH):
            raise EpisodeError(where, f"{stated!r} is depth, not colour", "name a colour topic as camera")
        if encoding(message, kind) == MONO16 and (kind == RAW or image_codec(payload(message)) == "png"):
            if levels is None:
                remedy = "state the values of black and white in the YAML, such as levels: [0, 4095]"
                raise EpisodeError(where, "images in mono16 have 16 bits of grey", remedy)
            low, high = levels
            values = wide_grey(message, kind, where).astype(np.float32)
            scaled = (values - np.float32(low)) * np.float32(255 / (high - low))
            return np.repeat(np.clip(np.rint(scaled), 0, 255).astype(np.uint8)[..., None], 3, axis=2)
        if kind == RAW:
            return _raw(message, where)
        if pattern := _mosaic(message):
            return _demosaiced(payload(message), pattern, where)
        return decode_image(payload(message), where, least)
    except (KeyError, TypeError, ValueError) as fault:
        raise EpisodeError(where, f"a message is not an image: {fault!r}") from fault


def _mosaic(message: Any) -> str:
    """Return the Bayer encoding that a compressed image states, such as bayer_rggb8; empty without one."""
    found = re.search(r"bayer_\w+", _stated(message))
    return found[0] if found else ""


def _demosaiced(data: bytes, pattern: str, where: str) -> Images:
    """Return the colours (H, W, 3) of a compressed image whose format names a Bayer encoding.

    Some publishers make colours before they compress, others compress the mosaic: that has one channel.
    """
    if not one_channel(data):
        return decode_image(data, where)
    cv2 = opencv()
    mosaic = cv2.imdecode(np.frombuffer(data, np.uint8), cv2.IMREAD_UNCHANGED)
    if mosaic is None or mosaic.ndim != 2 or mosaic.dtype != np.uint8 or pattern not in ENCODINGS:
        fault = f"images in {pattern!r} are not a mosaic of 8 bits"
        raise EpisodeError(where, fault, "publish them in colour")
    return cv2.cvtColor(mosaic, getattr(cv2, f"COLOR_{ENCODINGS[pattern][1]}"))


def is_grey(message: Any, kind: str) -> bool:
    """Check whether a raw or still image has one channel; a mosaic has three."""
    if kind == RAW:
        return encoding(message, kind) in ("mono8", "8uc1", MONO16)
    if kind != STILL_IMAGE or _mosaic(message):
        return False
    return encoding(message, kind) == MONO16 or one_channel(payload(message))


def wide_grey(message: Any, kind: str, where: str) -> NDArray[np.uint16]:
    """Return the values (H, W) of an image in mono16."""
    if kind == RAW:
        low_first = "is_bigendian" not in field_names(message) or not child(message, "is_bigendian")
        pixels = _pixels(message, where, pixel=2)
        return pixels.view("<u2" if low_first else ">u2")[..., 0].astype(np.uint16)
    cv2 = opencv()
    found = cv2.imdecode(np.frombuffer(payload(message), np.uint8), cv2.IMREAD_UNCHANGED)
    if found is None or found.ndim != 2:
        raise EpisodeError(where, "an image in mono16 cannot be decoded")
    return found.astype(np.uint16)


def payload(message: Any) -> bytes:
    """Return the stored bytes of an image; JSON stores them in base64."""
    data = child(message, "data")
    if isinstance(data, str):
        return base64.b64decode(data, validate=True)
    return data.tobytes() if isinstance(data, np.ndarray) else bytes(data)


def _raw(message: Any, where: str) -> Images:
    stated = _stated(message)
    if stated not in ENCODINGS:
        raise EpisodeError(
            where,
            f"images in {stated!r} are not 8-bit colour",
            f"these can be read: {', '.join([*ENCODINGS, MONO16])}",
        )
    pixel, conversion = ENCODINGS[stated]
    pixels = _pixels(message, where, pixel)
    cv2 = opencv()
    return cv2.cvtColor(pixels, getattr(cv2, f"COLOR_{conversion}")) if conversion else pixels


def _pixels(message: Any, where: str, pixel: int) -> Images:
    """Return the bytes (H, W, pixel) of a raw image without the padding of its rows."""
    stated = _stated(message)
    height, width, step = (int(child(message, name)) for name in ("height", "width", "step"))
    if min(height, width) < 1 or height * width > MAX_PIXELS:
        raise EpisodeError(where, f"an image claims {width}×{height} pixels, the maximum is {MAX_PIXELS:,}")
    planar = stated in ("nv12", "nv21")  # rows of colour, half as many, follow those of luma
    rows, row = height * 3 // 2 if planar else height, width * pixel
    step = step or row
    data = child(message, "data")
    flat = data if isinstance(data, np.ndarray) else np.frombuffer(payload(message), np.uint8)
    shared = planar or (pixel == 2 and stated != MONO16)  # two pixels of YUV share their colour
    fault = f"an image of {width}×{height} in {stated}"
    if (shared and width % 2) or (planar and height % 2):
        raise EpisodeError(where, f"{fault} does not have even sides")
    if step < row or len(flat) < step * rows:
        raise EpisodeError(where, f"{fault} has {len(flat):,} bytes, rows of {step}")
    pixels = np.ascontiguousarray(flat[: step * rows].reshape(rows, step)[:, :row])
    return pixels.reshape(rows, width, pixel)


# -- video


def is_keyframe(data: bytes, codec: str) -> bool:
    """Check whether decoding can begin at a message; the codec is one of CODECS."""
    if codec == "h264":
        return any(unit[1][0] & 0x1F == 5 for unit in NAL_UNIT.finditer(data))
    if codec == "h265":
        return any(16 <= (unit[1][0] >> 1) & 0x3F <= 21 for unit in NAL_UNIT.finditer(data))
    return _vp9_begins(data) if codec == "vp9" else _av1_begins(data)


def has_b_slices(data: bytes) -> bool:
    """Check whether a frame of H.264 has slices of type B, which are stored after frames shown later."""
    for unit in NAL_UNIT.finditer(data):
        if unit[1][0] & 0x1F != 1:  # a slice of a frame that is no key frame
            continue
        bits = "".join(f"{byte:08b}" for byte in data[unit.end() : unit.end() + 8])
        _, at = _exp_golomb(bits, 0)  # first_mb_in_slice
        slice_type, _ = _exp_golomb(bits, at)
        if slice_type % 5 == 1:
            return True
    return False


def _exp_golomb(bits: str, at: int) -> tuple[int, int]:
    """Return the number in exponential Golomb code at a bit, and the bit after it."""
    zeros = bits.find("1", at) - at
    if zeros < 0:
        return 0, len(bits)
    end = at + 2 * zeros + 1
    return int(bits[at + zeros : end], 2) - 1, end


def is_reordered(data: bytes, codec: str) -> bool:
    """Check by a stream's first key frame whether its frames are stored in another order than shown."""
    import av

    context = av.CodecContext.create(CODECS[codec], "r")
    with suppress(av.FFmpegError):  # a damaged frame raises its error when it is read
        context.decode(av.Packet(data))
    return bool(context.has_b_frames)


def _vp9_begins(data: bytes) -> bool:
    """Check whether the first frame is a key frame: VP9 bitstream specification, uncompressed_header."""
    if not data or data[0] >> 6 != 2:
        raise ValueError("it is not a VP9 frame")
    at = 5 if data[0] >> 4 & 3 == 3 else 4  # bits: marker 2, profile 2, of profile 3 one more
    shows_existing, inter = data[0] >> (7 - at) & 1, data[0] >> (6 - at) & 1
    return not shows_existing and not inter


def _av1_begins(data: bytes) -> bool:
    """Check for a sequence header, with which every key frame begins: AV1 specification, section 7.5."""
    first = data.removeprefix(AV1_DELIMITER)[:1]
    return bool(first) and first[0] >> 3 & 15 == AV1_SEQUENCE


class VideoDecoder:
    """A decoder of video; it goes on from the last frame when asked in order, else begins at a key frame.

    Args:
        codec: h264, h265, vp9 or av1.
        keyframes: (T,) bool, where decoding can begin; True at 0.
        fetch: yields the stored bytes of the messages from a position to the last.
        where: the episode and topic, for the error.
        reorders: whether frames are shown in another order than their messages come. Then indices count
            frames as they are shown: nothing after a key frame is shown before what comes before it.
    """

    def __init__(
        self,
        codec: str,
        keyframes: Bools,
        fetch: Callable[[int], Iterator[bytes]],
        where: str,
        reorders: bool = False,
    ) -> None:
        self._codec, self._keyframes, self._fetch, self._where = codec, keyframes, fetch, where
        self._reorders = reorders
        self._group, self._shown = 0, 0  # the key frame of the frames last shown; how many were shown since
        self._context: Any = None
        self._to_rgb = FrameToRGB(where)
        self._next = 0  # the message that the decoder takes next
        self._taken = -1  # the last image returned
        self._ready: dict[int, Any] = {}  # images decoded but not returned yet; None for a damaged one
        self._spoilt = False  # whether the last decoded image, or one it may depend on, is damaged
        self._lost = False  # whether an image since the last key frame is missing
        self._incomplete: set[int] = set()  # messages that may depend on a missing image

    def each(self, indices: Iterable[int]) -> Iterator[Images]:
        """Yield the image (H, W, 3) of each of those rising indices.

        Raises:
            EpisodeError: one of them, or one it builds on, cannot be decoded.
        """
        packets: Iterator[bytes] | None = None
        for index in indices:
            skips = self._keyframes[self._next + 1 : index + 1].any()
            if index not in self._ready and (self._context is None or index <= self._taken or skips):
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
            if frame is None:
                fault = f"frame {index} of the video is damaged, or depends on one that is damaged or lost"
                raise EpisodeError(self._where, fault)
            yield self._to_rgb(frame)

    def _begin(self, index: int) -> None:
        import av

        self._context = av.CodecContext.create(CODECS[self._codec], "r")
        self._context.thread_count = 1
        self._context.options = {"max_pixels": str(MAX_PIXELS)}
        if self._reorders:  # without it, FFmpeg guesses how many frames it must hold back, and guesses low
            self._context.options |= {"strict": "strict"}
        self._ready, self._spoilt, self._lost, self._incomplete = {}, False, False, set()
        self._next = int(np.flatnonzero(self._keyframes[: index + 1])[-1])
        self._taken = self._next - 1
        self._group, self._shown = self._next, 0

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
            raise EpisodeError(
                self._where, f"frame {wanted} of the video cannot be decoded: {fault}"
            ) from fault
        refuse_hdr(self._context, self._where)
        if data is None:
            self._context = None
        else:
            self._lost = not self._keyframes[self._next] and (self._lost or bool(missing))
            self._incomplete |= {self._next} if self._lost else set()
            self._next += 1
        for frame in frames:
            self._spoilt = is_spoilt(frame, self._spoilt)
            if frame.pts is not None:
                usable = not self._spoilt and frame.pts not in self._incomplete
                self._ready[self._place(frame.pts)] = frame if usable else None
        if data is None and self._reorders:
            self._require_whole(len(self._keyframes))

    def _place(self, message: int) -> int:
        """Return the index of the frame shown next, which came with that message."""
        if not self._reorders:
            return message
        group = int(np.flatnonzero(self._keyframes[: message + 1])[-1])
        if group != self._group:
            self._require_whole(group)
            self._group, self._shown = group, 0
        self._shown += 1
        return group + self._shown - 1

    def _require_whole(self, end: int) -> None:
        """Raise EpisodeError if a frame is missing before that message: the others could not be counted."""
        if self._group + self._shown != end:
            fault = f"frames {self._group} to {end - 1} of the video lack one, and are stored out of order"
            raise EpisodeError(self._where, fault, "encode it without B-frames (bf=0)")


_LOGGING = threading.Lock()  # PyAV's log settings hold for the whole process


@contextmanager
def _missing_references(codec: str) -> Iterator[list[str]]:
    """Gather FFmpeg's log messages on missing reference images, of H.264 and H.265.

    FFmpeg goes on without a lost image, and marks no frame as damaged. In AV1, dav1d returns no image
    that depends on a lost one.
    """
    import av.logging as log

    missing: list[str] = []
    if codec not in MISSING:
        yield missing
        return
    wanted_level, text = MISSING[codec]
    with _LOGGING, log.Capture() as said:
        level, skip = log.get_level(), log.get_skip_repeated()
        log.set_level(getattr(log, wanted_level))
        log.set_skip_repeated(False)
        try:
            yield missing
        finally:
            log.set_level(level)
            log.set_skip_repeated(skip)
            missing += [message for _, _, message in said if text in message]


# -- streams


class Messages:
    """The messages of one topic, read again by index.

    Args:
        places: (T, 4) as TopicTrack keeps them, in order of receipt.
        channels: the channels that the last number of a place points into.
    """

    def __init__(self, bag: Bag, channels: list[Channel], places: Ints, where: str) -> None:
        self.where = where
        self._bag, self._channels, self._places = bag, channels, places

    def read(self, indices: Indices) -> Iterator[object]:
        """Yield the decoded messages of those indices, in that order."""
        rows = self._places[np.asarray(indices, np.int64)].tolist()
        places = [(file, first, second) for file, first, second, _ in rows]
        for row, data in zip(rows, self._bag.payloads(places), strict=True):
            yield decode(self._channels[row[3]], data, self.where)


class StillStream(OneByOne):
    """A camera of raw or still images; see episode.Stream."""

    def __init__(
        self, timestamps: Floats, messages: Messages, kind: str, levels: Levels | None = None
    ) -> None:
        self.timestamps = timestamps
        self._messages, self._kind, self._levels = messages, kind, levels

    def each(self, indices: Indices, least: int = 0) -> Iterator[Images]:
        """See episode.OneByOne."""
        where, read = self._messages.where, self._messages.read(indices)
        return of_one_size((picture(m, self._kind, where, self._levels, least) for m in read), where)


class VideoStream(OneByOne):
    """A camera of video; see episode.Stream.

    Args:
        timestamps: (T,) of the frames shown.
        keyframes: (M,) of all messages; those before and after the frames shown serve only for decoding.
        lead: the first frame shown.
        reorders: see VideoDecoder.
    """

    def __init__(
        self,
        timestamps: Floats,
        messages: Messages,
        keyframes: Bools,
        codec: str,
        lead: int = 0,
        reorders: bool = False,
    ) -> None:
        self.timestamps = timestamps
        self._messages, self._count, self._lead = messages, len(keyframes), lead
        self._decoder = VideoDecoder(codec, keyframes, self._from, messages.where, reorders)

    def each(self, indices: Indices, least: int = 0) -> Iterator[Images]:
        """See episode.OneByOne."""
        shown = (int(index) + self._lead for index in indices)
        return of_one_size(self._decoder.each(shown), self._messages.where)

    def _from(self, start: int) -> Iterator[bytes]:
        for block in range(start, self._count, BLOCK):
            for message in self._messages.read(range(block, min(block + BLOCK, self._count))):
                yield payload(message)
