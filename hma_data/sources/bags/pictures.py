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
from hma_data.sources.facts import one_channel
from hma_data.video import MAX_PIXELS, Images, decode_image, opencv

RAW, STILL, VIDEO = "raw", "still", "video"
KINDS = {
    "sensor_msgs/Image": RAW,
    "sensor_msgs/CompressedImage": STILL,
    "foxglove/RawImage": RAW,
    "foxglove/CompressedImage": STILL,
    "foxglove/CompressedVideo": VIDEO,
}
BYTES = {  # a pixel
    "rgb8": 3, "bgr8": 3, "8uc3": 3, "rgba8": 4, "bgra8": 4, "8uc4": 4, "mono8": 1, "8uc1": 1,
    "bayer_rggb8": 1, "bayer_bggr8": 1, "bayer_gbrg8": 1, "bayer_grbg8": 1,
    "yuv422": 2, "uyvy": 2, "yuv422_yuy2": 2, "yuyv": 2,
}  # fmt: skip


def picture_kind(message_type: str) -> str | None:
    """raw, still or video; None for a type that holds no pictures."""
    short = re.sub(r"^foxglove(_msgs)?[./](msg[./])?", "foxglove/", message_type).replace("/msg/", "/")
    return KINDS.get(short)


def codec(message: Any, kind: str) -> str:
    """How the picture is stored: jpeg, png, raw, h264 …"""
    if kind == RAW:
        return "raw"
    stated = str(child(message, "format")).lower() if "format" in field_names(message) else ""
    for name in ("jpeg", "png", "webp", "avif"):
        if name in stated.replace("jpg", "jpeg"):
            return name
    return stated


def picture(message: Any, kind: str, where: str) -> Images:
    """(H, W, 3) RGB of a raw or still picture.

    Raises:
        EpisodeError: not colour or grey of 8 bits, sizes that do not fit, bytes that are no picture.
    """
    try:
        if kind == RAW:
            return _raw(message, where)
        stated = str(child(message, "format"))
        if "compresseddepth" in stated.lower() or "16uc1" in stated.lower() or "32fc1" in stated.lower():
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
    padded = np.zeros(step * height, np.uint8)
    padded[: min(len(flat), len(padded))] = flat[: len(padded)]
    pixels = padded.reshape(height, step)[:, : width * pixel].reshape(height, width, pixel)
    return np.ascontiguousarray(_to_rgb(pixels, encoding.lower()))


def _to_rgb(pixels: NDArray[np.uint8], encoding: str) -> Images:
    cv2 = opencv()
    if encoding.startswith("bayer_"):
        pattern = encoding.removeprefix("bayer_").removesuffix("8").upper()
        return cv2.cvtColor(np.ascontiguousarray(pixels[..., 0]), getattr(cv2, f"COLOR_Bayer{pattern}2RGB"))
    if encoding in ("yuv422", "uyvy"):
        return cv2.cvtColor(np.ascontiguousarray(pixels), cv2.COLOR_YUV2RGB_UYVY)
    if encoding in ("yuv422_yuy2", "yuyv"):
        return cv2.cvtColor(np.ascontiguousarray(pixels), cv2.COLOR_YUV2RGB_YUY2)
    if encoding in ("bgr8", "bgra8"):
        return pixels[..., 2::-1]
    return pixels.repeat(3, axis=2) if pixels.shape[2] == 1 else pixels[..., :3]
