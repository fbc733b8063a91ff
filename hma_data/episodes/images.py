"""Decode pictures, rotate, crop, and resize them to the tokenizer's square; find cameras that show nothing.

N pictures, H×W pixels; uint8 RGB everywhere. Only this module resizes pictures; the filter is part of the
tokenizer's spec because it changes the tokens.
"""

import math
import os
import threading
from functools import cache, lru_cache
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from hma_data.arrays import Images, Indices
from hma_data.episodes.episode import OneByOne, Stream
from hma_data.errors import EpisodeError, MissingDependencyError
from hma_data.registry.components import Camera, Quality

Filter = Literal["area", "linear", "antialias"]
_REDUCED = ((8, 64), (4, 32), (2, 16))  # share of a JPEG's sides, and the flag of cv2.IMREAD_REDUCED_*
LEAST_SUM = 2000  # pixels of one call; with fewer, INTER_AREA is as fast as sums
BATCH = 16  # pictures that `antialias` resizes in one call
MAX_PIXELS = 64_000_000  # a picture that claims more is a decompression bomb or an error
FINE_BLOCKS, COARSE_BLOCKS = (16, 16), (8, 8)  # blocks
BLANK_LEVELS = 8  # levels from the darkest to the brightest coarse block: 3 % of full scale
STILL_LEVELS = 4  # levels by which a fine block changes
BT601, OTHER_MATRICES = 5, (1, 7, 9)  # FFmpeg's AVCOL_SPC: BT.709, SMPTE 240M and BT.2020 differ from BT.601
DEPTH_BITS = 12  # of one channel, at least; cameras of grey have 8 or 10
HDR = {16: "PQ", 18: "HLG"}  # FFmpeg's AVCOL_TRC
TO_SDR = (
    "tone-map it: ffmpeg -i IN -vf zscale=t=linear:npl=100,format=gbrpf32le,zscale=p=bt709,tonemap=hable,"
    "zscale=t=bt709:m=bt709:r=tv,format=yuv420p -fps_mode passthrough OUT"
)
LIMITED, FULL = 1, 2  # FFmpeg's AVCOL_RANGE: luma of 16 to 235, or of 0 to 255
_memory = threading.local()  # use -> array that `_held` keeps


@cache
def opencv() -> Any:
    """Import and return the cv2 module."""
    os.environ.setdefault("OPENCV_IO_MAX_IMAGE_PIXELS", str(MAX_PIXELS))  # OpenCV reads it when it is loaded
    try:
        import cv2
    except ImportError as fault:
        remedy = "pip uninstall opencv-python && pip install --force-reinstall opencv-python-headless"
        raise MissingDependencyError("opencv", str(fault), remedy) from fault
    return cv2


def image_codec(data: bytes | memoryview | NDArray[np.uint8]) -> str | None:
    """Return jpeg or png by the first bytes of a still picture; None for anything else."""
    start = bytes(data[:4])
    return "png" if start == b"\x89PNG" else "jpeg" if start[:2] == b"\xff\xd8" else None


def decode_image(data: bytes | NDArray[np.uint8], where: str, least: int = 0) -> Images:
    """Decode a JPEG, PNG or other still picture to (H, W, 3) RGB.

    With `least`, a JPEG is decoded at 1/8, 1/4 or 1/2 of its size, the smallest with so many pixels a side.
    """
    cv2 = opencv()
    buffer = np.frombuffer(data, np.uint8) if isinstance(data, bytes | bytearray | memoryview) else data
    codec, deep = image_codec(buffer), False
    flags = cv2.IMREAD_COLOR_RGB | cv2.IMREAD_IGNORE_ORIENTATION
    if least and codec == "jpeg":
        side = _short_side(memoryview(buffer))
        flags |= next((flag for share, flag in _REDUCED if side >= share * least), 0)
    picture, fault = None, ""
    try:
        if codec == "png":  # its header states 16 bits, of grey or of grey and alpha
            deep = buffer[24:26].tobytes() in (b"\x10\0", b"\x10\4")
        elif codec is None and len(buffer):  # TIFF, PGM and PFM may be depth; they are rare, so decode twice
            plain = cv2.imdecode(buffer, cv2.IMREAD_UNCHANGED)
            deep = plain is not None and plain.ndim == 2 and plain.dtype != np.uint8
        if len(buffer) and not deep:
            picture = cv2.imdecode(buffer, flags)
    except cv2.error as error:  # OpenCV checks the claimed size before it decodes
        fault = f": {error.err}"
    if deep:
        fault = "an image has more than 8 bits of grey: depth, not colour"
        raise EpisodeError(where, fault, "name another camera")
    if picture is None:
        raise EpisodeError(where, f"an image of {len(buffer)} bytes cannot be decoded{fault}")
    return picture


def _short_side(jpeg: memoryview) -> int:
    """Return the pixels of a JPEG's short side, as its frame header states; 0 where there is none."""
    at = 2
    while at + 9 <= len(jpeg) and jpeg[at] == 0xFF:
        marker = jpeg[at + 1]
        if 0xC0 <= marker <= 0xCF and marker not in (0xC4, 0xC8, 0xCC):
            return min(int.from_bytes(jpeg[at + 5 : at + 7]), int.from_bytes(jpeg[at + 7 : at + 9]))
        at += 1 if marker == 0xFF else 2 + int.from_bytes(jpeg[at + 2 : at + 4])
    return 0


def refuse_hdr(context: Any, where: str) -> None:
    """Raise EpisodeError if a decoder (PyAV's codec context) that has given a frame gives HDR video."""
    if transfer := HDR.get(int(context.color_trc)):
        fault = f"the video is HDR ({transfer}): without tone mapping its images are grey and flat"
        raise EpisodeError(where, fault, TO_SDR)


class FrameToRGB:
    """A converter of PyAV's video frames to RGB, by the matrix and range that they state; one serves many.

    A frame that states none is BT.601 in the range of its pixel format, as FFmpeg has it.

    Args:
        where: the video, for the error.
    """

    def __init__(self, where: str) -> None:
        from av.video.reformatter import VideoReformatter

        self._where = where
        # Two, because FFmpeg keeps the matrix of the frame before, and a video may change what it states.
        self._usual, self._stated = VideoReformatter(), VideoReformatter()

    def __call__(self, frame: Any) -> Images:
        """Return the frame's image (H, W, 3), a view of FFmpeg's memory.

        Raises:
            EpisodeError: it is depth: one channel of 12 bits (lerobot's) or more.
        """
        rgb = self._converted(frame)
        plane = rgb.planes[0]
        lines = np.frombuffer(plane, np.uint8).reshape(-1, plane.line_size)[: rgb.height, : rgb.width * 3]
        return lines.reshape(rgb.height, rgb.width, 3)

    def _converted(self, frame: Any) -> Any:
        """Return the frame as one of PyAV in rgb24."""
        full, kind = frame.color_range == FULL, frame.format
        if len(kind.components) == 1 and (bits := kind.components[0].bits) >= DEPTH_BITS:
            fault = f"the video has {bits} bits of grey: depth, not colour"
            raise EpisodeError(self._where, fault, "name another camera")
        other = frame.colorspace in OTHER_MATRICES
        # FFmpeg converts RGB, grey and "yuvj" the same with and without what they state.
        colourless = kind.is_rgb or len(kind.components) < 3
        usual = colourless or (full and kind.name.startswith("yuvj") and not other)
        if usual or not (full or other):
            return self._usual.reformat(frame, format="rgb24")
        matrix = int(frame.colorspace) if other else BT601
        return self._stated.reformat(
            frame,
            format="rgb24",
            src_colorspace=matrix,
            # RGB has no matrix, but PyAV applies that of the frame only where the two differ.
            dst_colorspace=BT601 if matrix != BT601 else OTHER_MATRICES[0],
            src_color_range=FULL if full else LIMITED,
            dst_color_range=FULL,
        )


def upright(frames: Images, camera: Camera) -> Images:
    """Return raw frames (N, H, W, 3) of a camera in RGB, flipped and rotated as its YAML says."""
    if camera.color == "bgr":
        frames = frames[..., ::-1]
    if camera.flip:
        frames = np.flip(frames, axis=1 if camera.flip == "vertical" else 2)
    if camera.rotate:
        frames = np.rot90(frames, k=-camera.rotate // 90, axes=(1, 2))
    return frames


def prepare(
    frames: Images, camera: Camera, size: int, resize_filter: Filter = "area", out: Images | None = None
) -> Images:
    """Return raw frames of a camera as (N, size, size, 3) RGB.

    Colour order, flip, rotation, crop and resizing follow the camera's YAML.

    Args:
        out: (N, size, size, 3) to write the result to; new memory by default.
    """
    frames = upright(frames, camera)
    if camera.crop:
        x, y, width, height = camera.crop
        if y + height > frames.shape[1] or x + width > frames.shape[2]:
            fault = f"crop {list(camera.crop)} leaves the image of {frames.shape[2]}×{frames.shape[1]}"
            raise EpisodeError(f"camera {camera.name}", fault)
        frames = frames[:, y : y + height, x : x + width]
    return resize(frames, size, camera.resize, resize_filter, out)


def prepared(
    stream: Stream,
    indices: Indices,
    camera: Camera,
    size: int,
    resize_filter: Filter = "area",
) -> Images:
    """Return pictures of a stream as (n, size, size, 3) RGB, as `prepare` makes them of `stream.frames`.

    Where the stream can give pictures one by one, they are resized one by one, so that large pictures are not
    in memory together.
    """
    if not isinstance(stream, OneByOne) or not len(indices):
        return prepare(stream.frames(indices), camera, size, resize_filter)
    distinct, inverse = np.unique(np.asarray(indices, np.int64), return_inverse=True)
    squares = np.empty((len(distinct), size, size, 3), np.uint8)
    # A crop counts the pixels of the whole picture.
    reduces = resize_filter == "antialias" and not camera.crop
    for i, picture in enumerate(stream.each(distinct, size) if reduces else stream.each(distinct)):
        prepare(picture[None], camera, size, resize_filter, squares[i : i + 1])
    return squares if np.array_equal(inverse, np.arange(len(squares))) else squares[inverse]


def resize(
    frames: Images,
    size: int,
    rule: str = "short_side_crop",
    resize_filter: Filter = "area",
    out: Images | None = None,
) -> Images:
    """Resize pictures (N, H, W, 3) to (N, size, size, 3).

    Args:
        rule: short_side_crop (short side to `size`, centre crop), letterbox (long
            side to `size`, black borders) or stretch.
        resize_filter: area averages when shrinking and is linear when enlarging; linear is always linear;
            antialias is linear, and when shrinking its triangle is as much wider (docs/format.md).
        out: (N, size, size, 3) to write the result to; new memory by default.
    """
    cv2 = opencv()
    height, width = frames.shape[1:3]
    if rule == "short_side_crop" and height != width:
        height = width = min(height, width)
        frames = _middle(frames, height, width)
    if (height, width) == (size, size):
        if out is None:
            return np.ascontiguousarray(frames)
        out[:] = frames
        return out
    out = np.empty((len(frames), size, size, 3), np.uint8) if out is None else out
    if rule == "letterbox":
        scale = size / max(height, width)
        inner_h, inner_w = max(1, round(height * scale)), max(1, round(width * scale))
    else:
        inner_h = inner_w = size
    if (inner_h, inner_w) != (size, size):
        out[:] = 0
    inner = _middle(out, inner_h, inner_w)
    if resize_filter == "antialias":
        _resize_antialiased(frames, inner)
        return out
    shrinks = inner_h < height or inner_w < width
    interpolation = cv2.INTER_AREA if resize_filter == "area" and shrinks else cv2.INTER_LINEAR
    by_sums = interpolation == cv2.INTER_AREA and _takes_sums(height, width, inner_h, inner_w)
    for frame, square in zip(frames, inner):
        if by_sums:
            _resize_by_sums(frame, square)
            continue
        # OpenCV takes gaps between rows, but not between pixels or backwards.
        rows, *pixel = frame.strides
        if rows <= 0 or pixel != [3, 1]:
            frame = np.ascontiguousarray(frame)
        cv2.resize(frame, (inner_w, inner_h), dst=square, interpolation=interpolation)
    return out


def _middle(frames: Images, height: int, width: int) -> Images:
    """Return the middle (N, height, width, 3) of pictures, a view."""
    top, left = (frames.shape[1] - height) // 2, (frames.shape[2] - width) // 2
    return frames[:, top : top + height, left : left + width]


@lru_cache(maxsize=64)
def _shares(inputs: int, outputs: int) -> tuple[int, list[list[tuple[int, int]]]]:
    """Return p, and for each of q outputs the (index, weight) of the inputs that it covers, of p.

    p/q is inputs/outputs in lowest terms. Weights are q-ths of an input, so those of an output add up to p.
    """
    p, q = (count // math.gcd(inputs, outputs) for count in (inputs, outputs))
    shares = []
    for start in range(0, p * q, p):
        covered = range(start // q, -(-(start + p) // q))
        shares.append([(i, min(start + p, (i + 1) * q) - max(start, i * q)) for i in covered])
    return p, shares


def _takes_sums(height: int, width: int, inner_h: int, inner_w: int) -> bool:
    """Check whether `_resize_by_sums` surely makes the bytes of INTER_AREA, and is faster.

    INTER_AREA adds float32. On an axis where an output covers n inputs, it rounds n + 1 times. A mean is an
    integer over p·p' of the two axes: if both are odd, it is 1/(2·p·p') or more away from half a level.
    """
    (p, down), (other, across) = _shares(height, inner_h), _shares(width, inner_w)
    longest, total = max(p, other), p * other
    shrinks = p > len(down) > 1 and other > len(across) > 1
    if not shrinks or not total % 2 or 255 * longest >= 2**16 or height * width < LEAST_SUM * longest:
        return False
    roundings = max(map(len, down)) + max(map(len, across)) + 2
    return 255 * roundings * 2.0**-24 < 1 / (2 * total)


def _resize_by_sums(frame: Images, square: Images) -> None:
    """Resize a picture (H, W, 3) into (h, w, 3) by exact means, in about half the time of INTER_AREA."""
    cv2, (height, width) = opencv(), square.shape[:2]
    total = _shares(len(frame), height)[0] * _shares(frame.shape[1], width)[0]
    whole = _held("whole", frame.shape, np.uint16)
    np.copyto(whole, frame)
    columns = _held("columns", (frame.shape[1], height, 3), np.uint16)
    cv2.transpose(_weighted_sums(whole, height, "rows"), dst=columns)
    if 255 * total >= 2**16:
        columns = columns.astype(np.float32)
    means = _held("means", (width, height, 3), np.uint8)
    cv2.convertScaleAbs(_weighted_sums(columns, width, "sums"), dst=means, alpha=1 / total)
    cv2.transpose(means, dst=square)


def _weighted_sums(lines: NDArray[Any], outputs: int, use: str) -> NDArray[Any]:
    """Return the weighted sums (outputs, W, 3) of the lines (H, W, 3) that each output covers, in `_held`."""
    cv2, (p, shares) = opencv(), _shares(len(lines), outputs)
    groups = lines.reshape(len(lines) // p, p, -1)
    sums = _held(use, (len(groups), len(shares), groups.shape[2]), lines.dtype)
    for i, ((first, weight), (second, other), *more) in enumerate(shares):
        cv2.addWeighted(groups[:, first], weight, groups[:, second], other, 0, dst=sums[:, i])
        for j, further in more:
            cv2.addWeighted(groups[:, j], further, sums[:, i], 1, 0, dst=sums[:, i])
    return sums.reshape(outputs, *lines.shape[1:])


def _held(use: str, shape: tuple[int, ...], kind: Any) -> NDArray[Any]:
    """Return memory of this thread for that use: to get it anew for each picture may cost more than sums."""
    held = vars(_memory)
    if use not in held or (held[use].shape, held[use].dtype) != (shape, kind):
        held[use] = np.empty(shape, kind)
    found: NDArray[Any] = held[use]
    return found


def _resize_antialiased(frames: Images, out: Images) -> None:
    """Resize pictures (N, H, W, 3) into (N, h, w, 3) by torch's antialiased bilinear filter for bytes."""
    import torch  # here, because only a tokenizer asks for this filter

    for start in range(0, len(frames), BATCH):
        some = torch.from_numpy(np.ascontiguousarray(frames[start : start + BATCH])).permute(0, 3, 1, 2)
        made = torch.nn.functional.interpolate(some, out.shape[1:3], mode="bilinear", antialias=True)
        out[start : start + BATCH] = made.permute(0, 2, 3, 1).numpy()


def describe_resize(camera: Camera, height: int, width: int, size: int) -> str:
    """Return what becomes of a camera's pictures, in one line.

    Args:
        height, width: of a recorded picture in pixels.
        size: side of the tokenizer's square.
    """
    text = f"{camera.name}: {width}×{height}"
    if camera.rotate in (90, 270):
        height, width = width, height
    if camera.crop:
        _, _, width, height = camera.crop
        text += f", crop {width}×{height}"
    text += f" → {size}×{size}"
    short, long = sorted((height, width))
    if short == long:
        return text
    side, share = "width" if width > height else "height", f"{100 * (1 - short / long):.0f} %"
    if camera.resize == "stretch":
        return f"{text}, stretched by {long / short:.2f}"
    if camera.resize == "letterbox":
        other = "height" if side == "width" else "width"
        return f"{text}, letterbox: {share} of the {other} is black"
    return f"{text}, {share} of the {side} cropped; resize: letterbox keeps it"


# -- cameras that show nothing


class PictureCheck:
    """The check of one camera in one episode; its pictures (n, S, S, 3) are added in their order.

    A picture is judged by the mean colours of blocks: 16×16 blocks for what changes over time, 8×8 for what
    differs at all. A mean leaves little of a sensor's noise and of a codec's errors, while a thing that is
    seen, or moves, changes the mean of its block. A picture repeats the one before only where all pixels are
    equal. Levels are those of uint8, 0 to 255.

    Attributes:
        pictures: number of pictures added.
        repeated: number of pictures that show the same as the picture before.
    """

    def __init__(self) -> None:
        self.pictures = self.repeated = 0
        self._low = np.full((*FINE_BLOCKS, 3), 255, np.uint8)
        self._high = np.zeros((*FINE_BLOCKS, 3), np.uint8)
        self._darkest, self._brightest = np.full(3, 255, np.uint8), np.zeros(3, np.uint8)
        self._last: Images | None = None

    def add(self, frames: Images) -> None:
        """Add the next pictures (n, S, S, 3)."""
        cv2 = opencv()
        for frame in frames:
            self.pictures += 1
            if self._last is not None and np.array_equal(frame, self._last):
                self.repeated += 1
                continue
            self._last = frame
            fine = cv2.resize(frame, FINE_BLOCKS, interpolation=cv2.INTER_AREA)
            coarse = cv2.resize(fine, COARSE_BLOCKS, interpolation=cv2.INTER_AREA)
            self._low, self._high = np.minimum(self._low, fine), np.maximum(self._high, fine)
            self._darkest = np.minimum(self._darkest, coarse.min(axis=(0, 1)))
            self._brightest = np.maximum(self._brightest, coarse.max(axis=(0, 1)))

    @property
    def blank(self) -> bool:
        """Check whether all pictures show one colour, the same throughout; one picture does not count."""
        return self.contrast <= BLANK_LEVELS and self.pictures > 1

    @property
    def contrast(self) -> int:
        """Return the levels from the darkest to the brightest coarse block of all pictures."""
        return int((self._brightest - self._darkest).max())

    @property
    def still(self) -> bool:
        """Check whether all pictures show the same; one picture does not count."""
        return int((self._high - self._low).max()) <= STILL_LEVELS and self.pictures > 1


def picture_flags(seen: PictureCheck, rule: Quality, episode_id: str, camera: str) -> dict[str, int]:
    """Return the flags of one camera in one episode: name -> number of pictures.

    The first that applies counts: a blank camera is also still, and a still one repeats its pictures.
    """
    share = seen.repeated / max(seen.pictures - 1, 1)
    for name, met, count, said in (
        ("blank", seen.blank, seen.pictures, "shows one colour throughout"),
        ("still", seen.still, seen.pictures, "shows one image throughout"),
        ("repeated", share > rule.repeated_share, seen.repeated, "repeats pictures"),
    ):
        if met and getattr(rule, name) == "refuse":
            remedy = f"quality: {{{name}: flag}} in the YAML keeps such episodes"
            raise EpisodeError(episode_id, f"camera {camera} {said}", remedy)
        if met:
            return {f"{name}_pictures:{camera}": count}
    return {}
