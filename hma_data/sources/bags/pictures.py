"""From messages to pictures: raw, compressed, and video.

sensor_msgs Image and CompressedImage, foxglove CompressedImage, RawImage and CompressedVideo, the
latter in any encoding of messages. H×W pixels, uint8 RGB.
"""

import base64
import binascii
import re
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.errors import EpisodeError
from hma_data.sources.bags.messages import child, field_names
from hma_data.sources.dtype_hints import one_channel
from hma_data.video import MAX_PIXELS, Images, decode_image, opencv

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
BYTES = {  # a pixel
    "rgb8": 3, "bgr8": 3, "8uc3": 3, "rgba8": 4, "bgra8": 4, "8uc4": 4, "mono8": 1, "8uc1": 1,
    "bayer_rggb8": 1, "bayer_bggr8": 1, "bayer_gbrg8": 1, "bayer_grbg8": 1,
    "yuv422": 2, "uyvy": 2, "yuv422_yuy2": 2, "yuyv": 2, "nv12": 1, "nv21": 1,
}  # fmt: skip

TO_RGB = {
    "bgr8": "BGR2RGB", "8uc3": "BGR2RGB", "rgba8": "RGBA2RGB", "bgra8": "BGRA2RGB", "8uc4": "BGRA2RGB",
    "mono8": "GRAY2RGB", "8uc1": "GRAY2RGB",
}  # fmt: skip

ENCODERS = (("264", "h264"), ("265", "h265"), ("hevc", "h265"), ("vp9", "vp9"), ("av1", "av1"))


def picture_kind(message_type: str) -> str | None:
    """raw, still or video; None for a type that holds no pictures."""
    short = re.sub(r"^foxglove(_msgs)?[./](msg[./])?", "foxglove/", message_type).replace("/msg/", "/")
    return KINDS.get(short)


def codec(message: Any, kind: str) -> str:
    """How the picture is stored: jpeg, png, raw, h264 …"""
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
    """h264, h265, vp9, av1, or what else the message says.

    FFMPEGPacket names the encoder (libx264, hevc_nvenc), or the codec first: "h264;yuv420p;bgr8;bgr8".
    """
    if "format" in field_names(message):
        return str(child(message, "format")).lower()
    stated = str(child(message, "encoding")).lower().partition(";")[0]
    return next((codec for name, codec in ENCODERS if name in stated), stated)


def picture(message: Any, kind: str, where: str) -> Images:
    """(H, W, 3) RGB of a raw or still picture.

    Raises:
        EpisodeError: not colour or grey of 8 bits, sizes that do not fit, bytes that are no picture.
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
    """Whether a raw or still picture that can be read has one channel."""
    if kind == RAW:
        return str(child(message, "encoding")).lower() in ("mono8", "8uc1")
    return kind == STILL and one_channel(payload(message))


def payload(message: Any) -> bytes:
    """The stored bytes of a picture; JSON holds them in base64."""
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
    """Rows of luma, then half as many of the two colours in turn."""
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
