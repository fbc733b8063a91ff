"""What messages of images hold goes before what they are called: video, lost frames, mosaics."""

from functools import cache
from pathlib import Path

import cv2
import numpy as np
import pytest

from hma_data.episodes.images import Images
from hma_data.errors import EpisodeError
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.bags.clocks import SECOND_NS
from hma_data.sources.bags.images import VideoDecoder, has_b_slices, is_keyframe
from tests.data import ros2
from tests.data.bag_files import SOURCE
from tests.data.sources.bags.test_bag_pairing import at, pairs, robot

FRAMES = 24
VIDEO = ros2.define(
    "foxglove_msgs/msg/CompressedVideo",
    "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n",
)
STREAMS = {
    "h264": ("libx264", {"bf": "0", "tune": "zerolatency"}),
    "h264 with B-frames": ("libx264", {"bf": "2", "x264-params": "b-adapt=0:scenecut=0"}),
    "h264 with a pyramid of B-frames": (
        "libx264",
        {"bf": "4", "x264-params": "b-adapt=0:scenecut=0:b-pyramid=normal"},
    ),
    "h265": ("libx265", {"x265-params": "log-level=none:bframes=0"}),
    "h265 with B-frames": (
        "libx265",
        {"x265-params": "log-level=none:bframes=3:b-adapt=0:scenecut=0:open-gop=0"},
    ),
}


def packets(name: str) -> list[tuple[int, bytes]]:
    encoder, options = STREAMS[name]
    pictures = (ros2.pixels(i, 96) for i in range(FRAMES))
    return ros2.packets(pictures, encoder, options | {"crf": "4"}, gop=8)


def bag(path: Path, name: str, message, stamped_as_shown: bool = False) -> Path:
    messages = []
    for i, (shown, data) in enumerate(packets(name)):
        ns = at(shown if stamped_as_shown else i)
        messages += [("/cam", message(ns, name, data), at(i)), ("/cmd", ros2.array([i]), at(i) + 10**6)]
    return ros2.write(path, messages)


def foxglove(ns: int, name: str, data: bytes):
    return VIDEO(ros2.stamp(ns), "x", np.frombuffer(data, np.uint8), name.split()[0])


IN_ORDER = [(i, i) for i in range(FRAMES)]


@pytest.mark.parametrize("name", STREAMS)
@pytest.mark.parametrize("stamped_as_shown", [False, True])
def test_video_is_in_the_order_in_which_it_is_shown(name, stamped_as_shown, tmp_path) -> None:
    path = bag(tmp_path / "run", name, foxglove, stamped_as_shown)
    assert pairs(path, robot(sync=", stamp: receive")) == IN_ORDER
    if not stamped_as_shown:
        assert pairs(path, robot()) == IN_ORDER


@pytest.mark.parametrize("name", ["h264 with B-frames", "h265 with B-frames"])
def test_frames_of_reordered_video_may_be_asked_for_in_any_order(name: str, tmp_path: Path) -> None:
    path = bag(tmp_path / "run", name, foxglove)
    stream = SOURCE.read(str(path), "run", robot()).streams["cam"]
    wanted = [20, 3, 9, 9, 0, 23, 10]
    found = [round((float(np.median(frame)) - 40) / ros2.LEVELS) for frame in stream.frames(wanted)]
    assert found == wanted


def test_a_lost_reference_of_reordered_video_shifts_no_frame(tmp_path: Path) -> None:
    stream = packets("h264 with B-frames")
    lost = next(i for i, (_, data) in enumerate(stream) if i > 8 and not has_b_slices(data))
    messages = []
    for i, (_, data) in enumerate(stream):
        messages += [] if i == lost else [("/cam", foxglove(at(i), "h264", data), at(i))]
        messages.append(("/cmd", ros2.array([i]), at(i) + 10**6))
    path = ros2.write(tmp_path / "run", messages)
    with pytest.raises(EpisodeError, match=r"lack one|damaged|cannot be decoded"):
        pairs(path, robot())


def test_an_episode_in_reordered_video_has_its_own_frames(tmp_path: Path) -> None:
    messages = []
    for i, (_, data) in enumerate(packets("h264 with B-frames")):
        ns = at(i) + (3 * SECOND_NS if i >= 8 else 0)  # the second group of frames comes after a pause
        messages += [("/cam", foxglove(ns, "h264", data), ns), ("/cmd", ros2.array([i]), ns + 10**6)]
    path = ros2.write(tmp_path / "run", messages)
    parts = robot().to_dict() | {"source": {"format": "rosbag", "segments": {"gap_s": 1}}}
    embodiment = Embodiment.from_values(parts, "")
    assert pairs(path, embodiment, "run/0000") == IN_ORDER[:8]
    assert pairs(path, embodiment, "run/0001") == IN_ORDER[8:]


@pytest.mark.parametrize("name", ["h264", "h264 with B-frames", "h265"])
@pytest.mark.parametrize("format_", ["{}", "bgr8; {} compressed", "jpeg", ""])
def test_video_in_compressed_images_is_read_as_video(name: str, format_: str, tmp_path: Path) -> None:
    def labelled(ns: int, name: str, data: bytes):
        return ros2.compressed(ns, format_.format(name.split()[0]), data)

    path = bag(tmp_path / "run", name, labelled)
    assert pairs(path, robot()) == IN_ORDER
    camera = next(key for key in SOURCE.inspect(str(path)).keys if key.key == "/cam")
    assert (camera.kind, camera.codec, camera.shape) == ("camera", name.split()[0], (96, 96, 3))


def test_a_jpeg_that_is_called_h264_is_read_as_a_jpeg(tmp_path: Path) -> None:
    messages = []
    for i in range(FRAMES):
        data = cv2.imencode(".jpg", ros2.pixels(i))[1].tobytes()
        messages += [("/cam", ros2.compressed(at(i), "h264", data), at(i)), ("/cmd", ros2.array([i]), at(i))]
    assert pairs(ros2.write(tmp_path / "run", messages), robot()) == IN_ORDER


# -- mosaics

PATTERNS = {"rggb": (0, 0), "bggr": (1, 1), "gbrg": (1, 0), "grbg": (0, 1)}  # where the red pixel is


def mosaic(colour: tuple[int, int, int], red_at: tuple[int, int]) -> np.ndarray:
    found = np.full((32, 32), colour[1], np.uint8)
    row, column = red_at
    found[row::2, column::2] = colour[0]
    found[1 - row :: 2, 1 - column :: 2] = colour[2]
    return found


def only_frame(path: Path) -> np.ndarray:
    episode = SOURCE.read(str(path), "run", robot())
    return episode.streams["cam"].frames([0])[0]


def mosaic_bag(path: Path, format_: str, pixels: np.ndarray, suffix: str = ".png") -> Path:
    data = cv2.imencode(suffix, pixels)[1].tobytes()
    messages = [("/cam", ros2.compressed(at(i), format_, data), at(i)) for i in range(3)]
    return ros2.write(path, [*messages, ("/cmd", ros2.array([1]), at(0))])


@pytest.mark.parametrize("pattern", PATTERNS)
@pytest.mark.parametrize("kind", ["png", "jpeg"])
def test_a_compressed_mosaic_is_given_its_colours(pattern: str, kind: str, tmp_path: Path) -> None:
    colour = (200, 90, 30)
    path = mosaic_bag(
        tmp_path / "run",
        f"bayer_{pattern}8; {kind} compressed ",
        mosaic(colour, PATTERNS[pattern]),
        f".{kind}",
    )
    frame = only_frame(path)[8:24, 8:24].reshape(-1, 3).mean(axis=0)
    assert np.abs(frame - colour).max() < (2 if kind == "png" else 12)
    camera = next(key for key in SOURCE.inspect(str(path)).keys if key.key == "/cam")
    assert camera.shape == (32, 32, 3)


def test_a_mosaic_that_was_made_colour_before_is_left_as_it_is(tmp_path: Path) -> None:
    pixels = np.full((32, 32, 3), (30, 90, 200), np.uint8)  # as OpenCV has it, blue first
    frame = only_frame(mosaic_bag(tmp_path / "run", "bayer_rggb8; jpeg compressed bgr8", pixels, ".jpg"))
    assert np.abs(frame.reshape(-1, 3).mean(axis=0) - (200, 90, 30)).max() < 6


def test_a_mosaic_of_16_bits_is_refused(tmp_path: Path) -> None:
    path = mosaic_bag(tmp_path / "run", "bayer_rggb16; png compressed ", np.full((32, 32), 4000, np.uint16))
    with pytest.raises(EpisodeError, match="more than 8 bits of grey"):
        only_frame(path)


GROUP, LONG = 9, 27
QUIET = "log-level=none:keyint=9:min-keyint=9:scenecut=0"
AOM = {"usage": "realtime", "cpu-used": "8", "lag-in-frames": "0"}
CODECS = {
    "x264": ("h264", "libx264", {"bf": "0"}),
    "x264 zero latency, slices": ("h264", "libx264", {"tune": "zerolatency", "slices": "3"}),
    "x264 baseline": ("h264", "libx264", {"profile": "baseline", "refs": "1"}),
    "x264 high 4:4:4": ("h264", "libx264", {"profile": "high444", "bf": "0"}),
    "x265": ("h265", "libx265", {"x265-params": f"{QUIET}:bframes=0"}),
    "x265 one reference": ("h265", "libx265", {"x265-params": f"{QUIET}:bframes=0:ref=1:repeat-headers=1"}),
    "x265 scaling lists": ("h265", "libx265", {"x265-params": f"{QUIET}:bframes=0:scaling-list=default"}),
    "aom resilient": ("av1", "libaom-av1", {**AOM, "error-resilience": "default"}),
}
REORDERED = {
    "x264 with b-frames": ("h264", "libx264", {"bf": "3", "x264-params": "b-pyramid=normal"}),
    "x264 interlaced": ("h264", "libx264", {"bf": "0", "flags": "+ildct+ilme"}),
    "x264 intra refresh": ("h264", "libx264", {"bf": "0", "x264-params": "intra-refresh=1"}),
    "x265 with b-frames": ("h265", "libx265", {"x265-params": f"{QUIET}:bframes=4:b-pyramid=1"}),
    "x265 open groups": ("h265", "libx265", {"x265-params": f"{QUIET}:bframes=3:open-gop=1"}),
    "x265 layers in time": ("h265", "libx265", {"x265-params": f"{QUIET}:bframes=3:temporal-layers=1"}),
    "aom": ("av1", "libaom-av1", AOM),
    "aom with hidden frames": ("av1", "libaom-av1", {"cpu-used": "8"}),
    "aom resilient with hidden frames": (
        "av1",
        "libaom-av1",
        {"cpu-used": "8", "error-resilience": "default"},
    ),
    "svt": ("av1", "libsvtav1", {"preset": "12", "svtav1-params": "pred-struct=1:lookahead=0"}),
    "svt with hidden frames": ("av1", "libsvtav1", {"preset": "12"}),
}


@cache
def messages(name: str) -> list[bytes]:
    _, encoder, options = {**CODECS, **REORDERED}[name]
    ground = np.random.default_rng(0).integers(0, 255, (12, 16, 3), np.uint8).repeat(8, 0).repeat(8, 1)
    pictures = (np.roll(ground, (3 * i, 5 * i), (0, 1)) for i in range(LONG))
    pixels = "yuv444p" if options.get("profile") == "high444" else "yuv420p"
    return [data for _, data in ros2.packets(pictures, encoder, options, GROUP, pixels)]


def decoded(packets: list[bytes], codec: str, in_order: bool) -> list[Images | None]:
    keyframes = np.array([is_keyframe(packet, codec) for packet in packets])
    decoder, found = None, []
    for i in range(len(packets)):
        if decoder is None or not in_order:
            decoder = VideoDecoder(codec, keyframes, lambda start: iter(packets[start:]), "x")
        try:
            found.append(next(decoder.each([i])))
        except EpisodeError:
            found.append(None)
    return found


@pytest.mark.parametrize("name", CODECS)
@pytest.mark.parametrize("in_order", [True, False])
def test_no_picture_is_made_from_one_that_is_missing(name: str, in_order: bool) -> None:
    codec, packets = CODECS[name][0], messages(name)
    whole = decoded(packets, codec, in_order=True)
    assert len(packets) == LONG and all(picture is not None for picture in whole)
    for lost in (1, 5, 8, 13):
        found = decoded(packets[:lost] + packets[lost + 1 :], codec, in_order)
        following = -(-(lost + 1) // GROUP) * GROUP
        for i, picture in enumerate(found):
            at = i + (i >= lost)
            assert (picture is None) == (lost < at < following), (lost, at)
            assert picture is None or np.array_equal(picture, whole[at])


@pytest.mark.parametrize("name", [*CODECS, *REORDERED])
def test_nothing_is_missed_where_nothing_is_missing(name: str) -> None:
    codec, packets = {**CODECS, **REORDERED}[name][0], messages(name)
    keyframes = np.array([is_keyframe(packet, codec) for packet in packets])
    decoder = VideoDecoder(codec, keyframes, lambda start: iter(packets[start:]), "x")
    shown = 0
    for i in range(len(packets)):
        try:
            shown += len(list(decoder.each([i])))
        except EpisodeError as fault:  # a message of hidden frames alone
            assert "missing" not in str(fault) and name.endswith("hidden frames")
    assert shown > LONG / 2
