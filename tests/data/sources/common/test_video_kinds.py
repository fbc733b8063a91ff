"""Containers, codecs and colours as they are met, and containers that lie."""

from collections.abc import Callable, Iterator
from fractions import Fraction
from pathlib import Path

import av
import cv2
import numpy as np
import pytest

from hma_data.errors import EpisodeError
from hma_data.sources.bags.images import VideoDecoder
from hma_data.sources.common.video_file import VideoFile, frame_table
from hma_data.tokenizers.training.frames import read_pictures
from tests.data.videos import HEIGHT, WIDTH, encode, in_order, number_of, picture

N = 26
X264, AV1 = ("libx264", {"crf": "4"}), ("libsvtav1", {"crf": "10", "preset": "12"})


def make(
    path: Path,
    codec: str,
    options: dict[str, str],
    gop: int = 8,
    times: list[int] | None = None,
    ticks: int = 10,
    **container: str,
) -> Path:
    base = Fraction(1, ticks)
    with av.open(str(path), "w", options=container) as out:
        stream = out.add_stream(codec, rate=10, options=options)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.gop_size, stream.codec_context.time_base = gop, base
        for i, time in enumerate(times or range(N)):
            frame = av.VideoFrame.from_ndarray(picture(i), format="rgb24")
            frame.pts, frame.time_base = time, base
            out.mux(stream.encode(frame))
        out.mux(stream.encode(None))
    return path


def without(box: bytes) -> Callable[[Path], Path]:
    def made(folder: Path) -> Path:
        path = encode(folder / "v.mp4", range(N))
        content = path.read_bytes()
        assert content.count(box) == 1
        path.write_bytes(content.replace(box, b"free"))
        return path

    return made


def cut_by_edit_list(folder: Path) -> Path:
    """An MP4 whose edit list begins half a second into its media."""
    path = encode(folder / "v.mp4", range(N))
    content = bytearray(path.read_bytes())
    at = content.index(b"elst") + 16
    ticks = frame_table(path).stamps
    begin = int.from_bytes(content[at : at + 4], "big") + int(5 * (ticks[1] - ticks[0]))
    content[at : at + 4] = begin.to_bytes(4, "big")
    path.write_bytes(content)
    return path


UNEVEN = np.cumsum(np.random.default_rng(0).integers(1, 9, N)).tolist()
REFRESH = X264[1] | {"x264-params": "intra-refresh=1:keyint=8"}
OPEN264 = X264[1] | {"x264-params": "open-gop=1:keyint=8:bframes=3"}
OPEN265 = {"crf": "4", "x265-params": "open-gop=1:keyint=8:log-level=none"}
KINDS: dict[str, Callable[[Path], Path]] = {
    "h264 of one group": lambda at: make(at / "v.mp4", *X264, gop=60),
    "h264 open groups": lambda at: make(at / "v.mp4", "libx264", OPEN264),
    "h264 gradual refresh": lambda at: make(at / "v.mp4", "libx264", REFRESH),
    "h264 uneven times": lambda at: make(at / "v.mp4", *X264, times=UNEVEN, ticks=90),
    "h264 late start": lambda at: make(at / "v.mp4", *X264, times=[i + 37 for i in range(N)]),
    "h264 fragments": lambda at: make(at / "v.mp4", *X264, movflags="frag_keyframe+empty_moov"),
    "h264 avi": lambda at: make(at / "v.avi", *X264),
    "h264 mkv": lambda at: make(at / "v.mkv", *X264),
    "h264 flv": lambda at: make(at / "v.flv", *X264),
    "h264 ts": lambda at: make(at / "v.ts", *X264),
    "h264 cut by edit list": cut_by_edit_list,
    "h264 no list of keyframes": without(b"stss"),
    "h264 no times of frames": without(b"ctts"),
    "hevc open groups": lambda at: make(at / "v.mp4", "libx265", OPEN265),
    "av1 groups of 2": lambda at: make(at / "v.mp4", *AV1, gop=2),
    "av1 of one group": lambda at: make(at / "v.mp4", *AV1, gop=60),
    "av1 webm": lambda at: make(at / "v.webm", *AV1),
    "vp9 webm": lambda at: make(at / "v.webm", "libvpx-vp9", {"crf": "4", "cpu-used": "8"}),
    "mpeg4 avi": lambda at: make(at / "v.avi", "mpeg4", {"qmin": "1", "qmax": "2", "bf": "2"}),
    "mpeg2 mpg": lambda at: make(at / "v.mpg", "mpeg2video", {"qmin": "1", "qmax": "2", "bf": "2"}),
}  # fmt: skip


@pytest.fixture(scope="module", params=list(KINDS))
def video(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    try:
        return KINDS[request.param](tmp_path_factory.mktemp("kinds"))
    except (ValueError, av.error.FFmpegError) as fault:
        pytest.skip(f"this PyAV cannot encode it: {fault}")


def test_all_frames_are_those_of_decoding_in_order(video: Path) -> None:
    np.testing.assert_array_equal(VideoFile(video).frames(range(len(VideoFile(video)))), in_order(video))


def test_strided_backward_and_scattered_frames_are_those_of_decoding_in_order(video: Path) -> None:
    expected = in_order(video)
    last = len(expected) - 1
    scattered = np.random.default_rng(1).permutation(len(expected))[:9].tolist()
    for order in (list(range(0, last, 5)), list(range(last, 0, -7)), scattered, [last, 0, 9, 8, 17]):
        file = VideoFile(video)
        for index in order:
            np.testing.assert_array_equal(file.frames([index])[0], expected[index], f"{index} of {order}")


def test_times_rise_and_their_steps_are_the_files(video: Path, request: pytest.FixtureRequest) -> None:
    times = frame_table(video).times
    wanted = np.diff(UNEVEN) / 90 if "uneven" in request.node.name else np.full(len(times) - 1, 0.1)
    np.testing.assert_allclose(np.diff(times), wanted, atol=2e-3)


def test_an_edit_list_hides_the_frames_before_it(tmp_path: Path) -> None:
    shown = [number_of(frame) for frame in VideoFile(cut_by_edit_list(tmp_path)).frames(range(18))]
    assert shown == list(range(shown[0], shown[0] + 18)) and shown[0] >= 5


def test_a_lying_container_that_gives_fewer_frames_is_refused(tmp_path, monkeypatch) -> None:
    path = without(b"ctts")(tmp_path)
    table = frame_table(path)
    longer = type(table)(**{**vars(table), "times": np.append(table.times, 99.0)})
    monkeypatch.setattr("hma_data.sources.common.video_file.frame_table", lambda path: longer)
    with pytest.raises(EpisodeError, match=r"gives \d+ frames, its packets state \d+"):
        VideoFile(path).frames([3])


def test_frames_made_from_a_damaged_one_are_refused_up_to_the_next_keyframe(tmp_path: Path) -> None:
    whole = make(tmp_path / "whole.mp4", "libx264", {"crf": "4", "bf": "0"}, gop=13)
    intact = VideoFile(whole).frames(range(N))
    path, content, hit = tmp_path / "hit.mp4", whole.read_bytes(), 6
    with av.open(str(whole)) as container:
        packet = [found for found in container.demux(video=0) if found.size][hit]
        begin, end = packet.pos, packet.pos + packet.size
    for seed in range(60):
        spoilt = bytearray(content)
        draw = np.random.default_rng(seed)
        spoilt[begin + 12 : end] = draw.integers(0, 256, end - begin - 12, np.uint8).tobytes()
        path.write_bytes(bytes(spoilt))
        with av.open(str(path)) as container:
            frames = [(f.is_corrupt, f.to_ndarray(format="rgb24")) for f in container.decode(video=0)]
        silent = [i for i, (told, shown) in enumerate(frames) if not told and (shown != intact[i]).any()]
        if len(frames) == N and silent and any(told for told, _ in frames):
            break
    for i in range(N):
        try:
            assert np.array_equal(VideoFile(path).frames([i])[0], intact[i])
        except EpisodeError:
            assert i < 13
    with pytest.raises(EpisodeError, match="damaged"):
        VideoFile(path).frames([silent[0]])


def test_a_group_is_decoded_no_further_back_than_its_keyframe(tmp_path, monkeypatch) -> None:
    file, seen = VideoFile(make(tmp_path / "v.mp4", *AV1, gop=2)), []
    inner = VideoFile._index_of
    monkeypatch.setattr(VideoFile, "_index_of", lambda self, frame: seen.append(1) or inner(self, frame))
    file.frames(range(0, N, 5))
    assert len(seen) <= 2 * len(range(0, N, 5))


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
OPTIONS |= {"libx265": {"x265-params": "log-level=none"}, "libsvtav1": {"preset": "12"}}
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


def film(
    path: Path,
    matrix: int,
    full: bool,
    codec: str = "libx264",
    kind: str = "yuv420p",
    transfer: int = UNSTATED,
) -> Path:
    spread = FULL if full else LIMITED
    with av.open(str(path), "w") as container:
        stream = container.add_stream(codec, rate=10, options=OPTIONS[codec])
        stream.width = stream.height = SIDE
        stream.pix_fmt = kind
        stream.codec_context.colorspace, stream.codec_context.color_range = matrix, spread
        stream.codec_context.color_trc = transfer
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


def by_ffmpeg(path: Path) -> np.ndarray:
    with av.open(str(path)) as container:
        frame, graph = next(iter(container.decode(video=0))), av.filter.Graph()
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
@pytest.mark.parametrize("matrix", [UNSTATED, BT709, BT2020])
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


@pytest.mark.parametrize("kind", ["gray12le", "gray16le"])
def test_depth_is_no_video(tmp_path: Path, kind: str) -> None:
    with pytest.raises(EpisodeError, match=rf"v\.mkv: the video has {kind[4:6]} bits of grey: depth"):
        VideoFile(film(tmp_path / "v.mkv", UNSTATED, False, "ffv1", kind)).frames([0])


@pytest.mark.parametrize(("transfer", "name"), [(16, "PQ"), (18, "HLG")])
def test_hdr_is_refused_with_what_tone_maps_it(tmp_path: Path, transfer: int, name: str) -> None:
    said = rf"is HDR \({name}\): .* — tone-map it: ffmpeg .*tonemap"
    for codec in ("libx264", "libx265", "libsvtav1"):
        path = film(tmp_path / f"{codec}.mp4", BT2020, False, codec, "yuv420p10le", transfer)
        with pytest.raises(EpisodeError, match=rf"{codec}\.mp4: the video {said}"):
            VideoFile(path)
    with pytest.raises(EpisodeError, match=rf"v\.mcap /video: the video {said}"):
        from_bag(h264_messages(tmp_path / "libx264.mp4"))


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
