"""The colours of videos that state a matrix or a range, against FFmpeg's own conversion and OpenCV's."""

from collections.abc import Iterator
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from hma_data.sources.bags.images import VideoDecoder
from hma_data.sources.common.video_file import VideoFile
from hma_data.tokenizers.training.frames import read_pictures

SIDE = 128
COLOURS = ((200, 30, 30), (30, 200, 30), (30, 30, 200), (128, 128, 128))
UNSTATED, BT709, BT470, SMPTE170M, SMPTE240M, BT2020 = 2, 1, 5, 6, 7, 9
RED_AND_BLUE = {
    BT709: (0.2126, 0.0722),
    SMPTE240M: (0.212, 0.087),
    BT2020: (0.2627, 0.0593),
}  # shares of luma
LIMITED, FULL = 1, 2
OPTIONS = {"libx264": {"crf": "1"}, "libvpx-vp9": {"crf": "4"}, "ffv1": dict[str, str]()}
NEAR = 4  # levels: rounding of YUV, and what the codec loses


def patches(matrix: int, full: bool, bits: int) -> list[np.ndarray]:
    """The colours side by side as planes Y, Cb and Cr, by the formulas of ITU-T H.273."""
    picture = np.repeat(np.array([COLOURS], float) / 255, SIDE // len(COLOURS), axis=1).repeat(SIDE, axis=0)
    red, green, blue = np.moveaxis(picture, 2, 0)
    kr, kb = RED_AND_BLUE.get(matrix, (0.299, 0.114))
    luma = kr * red + (1 - kr - kb) * green + kb * blue
    cb, cr = (blue - luma) / (2 - 2 * kb), (red - luma) / (2 - 2 * kr)
    if full:
        top, middle = 2**bits - 1, 2 ** (bits - 1)
        planes = [luma * top, cb * top + middle, cr * top + middle]
    else:
        step = 2 ** (bits - 8)
        planes = [(luma * 219 + 16) * step, (cb * 224 + 128) * step, (cr * 224 + 128) * step]
    return [np.rint(plane).astype(np.uint16 if bits > 8 else np.uint8) for plane in planes]


def film(path: Path, matrix: int, full: bool, codec: str = "libx264", kind: str = "yuv420p") -> Path:
    """A video of three frames that show the colours and state matrix and range."""
    spread = FULL if full else LIMITED
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10, options=OPTIONS[codec])
        stream.width = stream.height = SIDE
        stream.pix_fmt = kind
        stream.codec_context.colorspace, stream.codec_context.color_range = matrix, spread
        for number in range(3):
            frame = av.VideoFrame(SIDE, SIDE, kind)
            frame.colorspace, frame.color_range, frame.pts = matrix, spread, number
            luma, *colour = patches(matrix, full, 10 if "10" in kind else 8)
            for plane, values in zip(frame.planes, [luma, *(half[::2, ::2] for half in colour)]):
                lines = np.zeros((plane.height, plane.line_size), np.uint8)
                row = np.ascontiguousarray(values).view(np.uint8)
                lines[:, : row.shape[1]] = row
                plane.update(lines.tobytes())
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def frame_of(path: Path) -> av.VideoFrame:
    with av.open(str(path)) as container:
        return next(iter(container.decode(video=0)))


def by_ffmpeg(path: Path) -> np.ndarray:
    frame, graph = frame_of(path), av.filter.Graph()
    steps = (
        graph.add_buffer(width=SIDE, height=SIDE, format=frame.format, time_base=frame.time_base),
        graph.add("scale"),
        graph.add("format", "rgb24"),
        graph.add("buffersink"),
    )
    graph.link_nodes(*steps).configure()
    steps[0].push(frame)
    return steps[-1].pull().to_ndarray()


def colours_of(picture: np.ndarray) -> np.ndarray:
    width = SIDE // len(COLOURS)
    return picture[SIDE // 2, width // 2 :: width].astype(int)


def h264_messages(path: Path) -> list[bytes]:
    with av.open(str(path)) as container:
        stream = container.streams.video[0]
        to_messages = av.BitStreamFilterContext("h264_mp4toannexb", stream)
        return [bytes(out) for packet in container.demux(stream) for out in to_messages.filter(packet)]


def from_bag(messages: list[bytes], first_of: tuple[int, ...] = (0,)) -> list[np.ndarray]:
    keyframes = np.isin(np.arange(len(messages)), first_of)

    def fetch(start: int) -> Iterator[bytes]:
        return iter(messages[start:])

    return list(VideoDecoder("h264", keyframes, fetch, "v.mcap /video").each(range(len(messages))))


MATRICES = [UNSTATED, BT709, BT470, SMPTE170M, SMPTE240M, BT2020]


@pytest.mark.parametrize("full", [False, True], ids=["limited", "full"])
@pytest.mark.parametrize("matrix", MATRICES)
def test_every_reader_gives_the_colours_that_were_filmed(tmp_path: Path, matrix: int, full: bool) -> None:
    path = film(tmp_path / "v.mp4", matrix, full)
    expected = by_ffmpeg(path)
    assert np.abs(colours_of(expected) - COLOURS).max() <= NEAR
    assert np.array_equal(VideoFile(path).frames([0])[0], expected)
    assert np.array_equal(from_bag(h264_messages(path))[0], expected)
    assert np.array_equal(next(iter(read_pictures(path, 1))), expected)
    by_opencv = cv2.VideoCapture(str(path)).read()[1][..., ::-1]
    assert np.abs(expected.astype(int) - by_opencv).max() <= 1


@pytest.mark.parametrize("full", [False, True], ids=["limited", "full"])
@pytest.mark.parametrize("matrix", MATRICES)
@pytest.mark.parametrize(
    ("codec", "kind"), [("libx264", "yuv420p10le"), ("libvpx-vp9", "yuv420p"), ("ffv1", "yuv420p10le")]
)
def test_10_bits_and_codecs_without_a_format_for_full_range_keep_their_colours(
    tmp_path: Path, codec: str, kind: str, matrix: int, full: bool
) -> None:
    path = film(tmp_path / "v.mkv", matrix, full, codec, kind)
    found = VideoFile(path).frames([0])[0]
    assert np.array_equal(found, by_ffmpeg(path))
    assert np.abs(colours_of(found) - COLOURS).max() <= NEAR


@pytest.mark.parametrize("full", [False, True], ids=["limited", "full"])
@pytest.mark.parametrize("matrix", [UNSTATED, BT709, BT2020])
@pytest.mark.parametrize("kind", ["gray", "gray10le"])
def test_grey_has_no_matrix(tmp_path: Path, kind: str, matrix: int, full: bool) -> None:
    path = film(tmp_path / "v.mkv", matrix, full, "ffv1", kind)
    assert np.array_equal(VideoFile(path).frames([0])[0], by_ffmpeg(path))


@pytest.mark.parametrize("matrix", [UNSTATED, BT709])
@pytest.mark.parametrize("kind", ["bgr0", "gbrp10le"])
def test_rgb_has_no_matrix(tmp_path: Path, kind: str, matrix: int) -> None:
    picture = np.random.default_rng(0).integers(0, 256, (SIDE, SIDE, 3), np.uint8)
    path = tmp_path / "v.mkv"
    with av.open(str(path), "w") as container:
        stream = container.add_stream("ffv1", rate=10)
        stream.width = stream.height = SIDE
        stream.pix_fmt = kind
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24").reformat(format=kind)
        frame.colorspace = stream.codec_context.colorspace = matrix
        container.mux([*stream.encode(frame), *stream.encode(None)])
    assert np.array_equal(VideoFile(path).frames([0])[0], picture)


@pytest.mark.parametrize("order", [(BT709, SMPTE170M), (SMPTE170M, BT709), (BT709, BT2020)])
def test_colours_may_change_within_a_video(tmp_path: Path, order: tuple[int, int]) -> None:
    films = [film(tmp_path / f"{matrix}.mp4", matrix, False) for matrix in order]
    parts = [h264_messages(path) for path in films]
    found = from_bag([*parts[0], *parts[1]], first_of=(0, len(parts[0])))
    assert np.array_equal(found[0], by_ffmpeg(films[0]))
    assert np.array_equal(found[len(parts[0])], by_ffmpeg(films[1]))
