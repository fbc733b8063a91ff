"""Containers and codecs as they are met, and containers that lie: any frame equals decoding in order."""

from collections.abc import Callable
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest

from hma_data.errors import EpisodeError
from hma_data.sources.common.video_file import VideoFile, frame_table
from tests.data.videos import HEIGHT, WIDTH, encode, number_of, picture

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
    """A video of N pictures by that encoder; `times` in ticks of 1/`ticks` s."""
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
    """An H.264 MP4 with B-frames whose table of that name is gone."""

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


def in_order(path: Path) -> np.ndarray[Any, Any]:
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])


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
