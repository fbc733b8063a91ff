"""Pictures of bags: raw encodings, compressed, video."""

import base64
import json
import resource
import weakref
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pytest
import zstandard
from mcap.writer import CompressionType

from hma_data.episodes.episode import OneByOne
from hma_data.episodes.images import prepare, prepared
from hma_data.errors import EpisodeError
from hma_data.sources.bags import container
from hma_data.sources.bags.bag import Bag
from hma_data.sources.bags.container import decompress
from hma_data.sources.bags.images import VideoDecoder, image_kind, is_keyframe, picture, video_codec
from hma_data.sources.bags.mcap import McapFile
from tests.data import ros2
from tests.data.bag_files import CAMERA, KINDS, SOURCE, arm, make_recording, read, write_mcap
from tests.data.bag_files import as_cdr as cdr
from tests.data.sources.common.test_video_kinds import make


def image(encoding: str, data: np.ndarray, width: int, height: int, step: int) -> dict[str, Any]:
    flat = np.frombuffer(data.tobytes(), np.uint8)
    return {"encoding": encoding, "width": width, "height": height, "step": step, "data": flat}


def smooth(height: int = 16, width: int = 24) -> np.ndarray:
    y, x = np.mgrid[:height, :width]
    return np.stack([x * 8, y * 12, 255 - x * 5 - y * 4], -1).astype(np.uint8)


@pytest.mark.parametrize("padding", [0, 5])
def test_raw_encodings_become_rgb(padding: int) -> None:
    rgb = smooth()
    height, width = rgb.shape[:2]
    alpha = np.full((height, width, 1), 7, np.uint8)
    for encoding, pixels in {
        "rgb8": rgb,
        "bgr8": rgb[..., ::-1],
        "rgba8": np.concatenate([rgb, alpha], -1),
        "bgra8": np.concatenate([rgb[..., ::-1], alpha], -1),
        "8UC3": rgb[..., ::-1],  # OpenCV's names are blue first
        "8UC4": np.concatenate([rgb[..., ::-1], alpha], -1),
    }.items():
        rows = pixels.reshape(height, -1)
        rows = np.pad(rows, ((0, 0), (0, padding)), constant_values=99)
        found = picture(image(encoding, rows, width, height, rows.shape[1]), "raw", "")
        np.testing.assert_array_equal(found, rgb, err_msg=encoding)
    grey = picture(image("mono8", rgb[..., 0], width, height, width), "raw", "")
    np.testing.assert_array_equal(grey, np.repeat(rgb[..., :1], 3, -1))


@pytest.mark.parametrize(
    ("encoding", "corners"), [("rggb", "RGGB"), ("bggr", "BGGR"), ("gbrg", "GBRG"), ("grbg", "GRBG")]
)
def test_bayer_patterns_keep_the_colours_in_place(encoding: str, corners: str) -> None:
    rgb = smooth()
    mosaic = np.zeros(rgb.shape[:2], np.uint8)
    for i, colour in enumerate(corners):
        mosaic[i // 2 :: 2, i % 2 :: 2] = rgb[i // 2 :: 2, i % 2 :: 2, "RGB".index(colour)]
    found = picture(image(f"bayer_{encoding}8", mosaic, 24, 16, 24), "raw", "")
    assert np.abs(found[2:-2, 2:-2].astype(int) - rgb[2:-2, 2:-2]).max() <= 6


@pytest.mark.parametrize(("encoding", "luma"), [("yuv422", 1), ("yuv422_yuy2", 0)])
def test_yuv_is_the_inverse_of_the_standard_conversion(encoding: str, luma: int) -> None:
    """Rec. 601, studio range: grey of luma 126 is 128; a red sample is red."""
    packed = np.zeros((2, 4, 2), np.uint8)
    packed[..., luma], packed[..., 1 - luma] = 126, 128
    grey = picture(image(encoding, packed, 4, 2, 8), "raw", "")
    np.testing.assert_allclose(grey, 128, atol=1)
    packed[..., luma], packed[:, ::2, 1 - luma], packed[:, 1::2, 1 - luma] = 81, 90, 240
    np.testing.assert_allclose(picture(image(encoding, packed, 4, 2, 8), "raw", "")[0, 0], [254, 0, 0], 0, 2)


@pytest.mark.parametrize("encoding", ["16UC1", "32FC1", "rgb16", ""])
def test_what_is_no_8_bit_colour_is_refused(encoding: str) -> None:
    with pytest.raises(EpisodeError, match=r"not 8-bit colour.*rgb8"):
        picture(image(encoding, np.zeros(32, np.uint8), 4, 4, 8), "raw", "depth")


def in_levels(values: np.ndarray, black: float, white: float) -> np.ndarray:
    grey = [
        [round(255 * min(max((v - black) / (white - black), 0), 1)) for v in row] for row in values.tolist()
    ]
    return np.repeat(np.array(grey, np.uint8)[..., None], 3, -1)


@pytest.mark.parametrize("order", ["<", ">"])
def test_16_bits_of_grey_are_scaled_by_the_levels_of_the_camera(order: str) -> None:
    values = np.random.default_rng(0).integers(0, 5000, (6, 8), np.uint16)
    expected = in_levels(values, 200, 4095)
    rows = np.pad(values.astype(f"{order}u2").view(np.uint8).reshape(6, 16), ((0, 0), (0, 4)))
    raw = image("mono16", rows, 8, 6, 20) | {"is_bigendian": int(order == ">")}
    np.testing.assert_array_equal(picture(raw, "raw", "", (200, 4095)), expected)
    png = cv2.imencode(".png", values)[1].reshape(-1)
    still = {"format": "mono16; png compressed ", "data": png}
    np.testing.assert_array_equal(picture(still, "still", "", (200, 4095)), expected)
    for message, kind in ((raw, "raw"), (still, "still")):
        with pytest.raises(EpisodeError, match=r"16 bits of grey.*levels: \[0, 4095\]"):
            picture(message, kind, "cam")


def test_mono16_that_its_driver_compressed_to_8_bits_needs_no_levels() -> None:
    jpeg = cv2.imencode(".jpg", smooth()[..., 0])[1].reshape(-1)
    found = picture({"format": "mono16; jpeg compressed mono8", "data": jpeg}, "still", "")
    np.testing.assert_array_equal(found, cv2.imdecode(jpeg, cv2.IMREAD_COLOR))


@pytest.mark.parametrize(
    "broken",
    [
        {"data": np.zeros(5, np.uint8)},
        {"width": 10**6, "height": 10**6},
        {"step": 3},
        {"height": 0},
        {"width": -4},
        {"width": None},
        {"encoding": "yuv422", "width": 3},
    ],
)
def test_a_raw_picture_that_does_not_fit_is_refused(broken: dict[str, Any]) -> None:
    message = image("rgb8", np.zeros(48, np.uint8), 4, 4, 12) | broken
    with pytest.raises(EpisodeError):
        picture(message, "raw", "camera")


def test_compressed_depth_is_refused_and_jpeg_is_decoded() -> None:
    jpeg = cv2.imencode(".jpg", smooth())[1]
    found = picture({"format": "rgb8; jpeg compressed bgr8", "data": jpeg.reshape(-1)}, "still", "")
    np.testing.assert_array_equal(found, cv2.imdecode(jpeg, cv2.IMREAD_COLOR)[..., ::-1])
    with pytest.raises(EpisodeError, match="depth"):
        picture({"format": "16UC1; compressedDepth png", "data": jpeg.reshape(-1)}, "still", "")
    for data in (b"no picture", "n@t base64", 5):
        with pytest.raises(EpisodeError):
            picture({"format": "jpeg", "data": data}, "still", "")


def gradients(count: int) -> np.ndarray:
    y, x = np.mgrid[:64, :96]
    pictures = [np.stack([x * 2, y * 3, np.full_like(x, 8 * i)], -1) for i in range(count)]
    return np.stack(pictures).astype(np.uint8)


def write_video(path: Path, codec: str, name: str, options: dict[str, str], drop: int = 0) -> np.ndarray:
    pictures = gradients(30)
    packets = [data for _, data in ros2.packets(pictures, codec, options, gop=10)]
    assert len(packets) == 30
    video, messages = ros2.Kind("foxglove.CompressedVideo", "jsonschema", b"{}"), []
    for i, packet in list(enumerate(packets))[drop:]:
        stamp, data = {"sec": 1 + i, "nsec": 0}, base64.b64encode(packet).decode()
        text = json.dumps({"timestamp": stamp, "format": name, "data": data})
        messages.append(("/video", video, (1 + i) * 10**9, text.encode()))
        messages.append(("/n", ros2.Kind(), (1 + i) * 10**9, b'{"value": 1}'))
    ros2.write_mcap(path, messages, chunk_size=4096)
    return pictures


VIDEO_YAML = """
id: video
kind: real
frequency_hz: 30
action: {space: mixed, components: [{key: /n.value, dims: 1}]}
cameras: [{name: cam, key: /video}]
source: {format: rosbag}
"""
LOW_DELAY = {"preset": "ultrafast", "tune": "zerolatency", "crf": "10"}


@pytest.mark.parametrize(("codec", "name"), [("libx264", "h264"), ("libx265", "h265")])
def test_video_gives_the_asked_frames_in_any_order(tmp_path: Path, codec: str, name: str) -> None:
    options = LOW_DELAY | ({"x265-params": "log-level=none:keyint=10:bframes=0"} if name == "h265" else {})
    pictures = write_video(tmp_path / "v.mcap", codec, name, options)
    stream = read(tmp_path / "v.mcap", arm(VIDEO_YAML)).streams["cam"]
    for indices in ([0, 1, 2], [3, 7, 7], [25, 29], [12], [5, 4], [11, 28]):
        found = stream.frames(indices).astype(int)
        assert np.abs(found - pictures[indices]).mean() < 4, indices


def test_video_begins_at_its_first_key_frame(tmp_path: Path) -> None:
    pictures = write_video(tmp_path / "v.mcap", "libx264", "h264", LOW_DELAY, drop=4)
    stream = read(tmp_path / "v.mcap", arm(VIDEO_YAML)).streams["cam"]
    assert stream.timestamps[0] == 11
    assert np.abs(stream.frames([0]).astype(int) - pictures[10]).mean() < 4


def test_unknown_video_is_refused(tmp_path: Path) -> None:
    write_video(tmp_path / "v.mcap", "libvpx-vp9", "mjpeg2000", {"deadline": "realtime"})
    said = r"/video: video in 'mjpeg2000' cannot be read"
    with pytest.raises(EpisodeError, match=rf"v\.mcap: {said}.*h264"):
        read(tmp_path / "v.mcap", arm(VIDEO_YAML))
    assert any(said in problem for problem in SOURCE.inspect(str(tmp_path / "v.mcap")).problems)


@pytest.mark.parametrize("padding", [0, 4])
@pytest.mark.parametrize("encoding", ["nv12", "nv21"])
def test_semi_planar_yuv_is_converted_plane_by_plane(encoding: str, padding: int) -> None:
    """Rec. 601, studio range: luma 81 with U 90 and V 240 is red."""
    luma, colours = np.full((4, 6), 81, np.uint8), np.zeros((2, 6), np.uint8)
    first, second = (90, 240) if encoding == "nv12" else (240, 90)
    colours[:, ::2], colours[:, 1::2] = first, second
    rows = np.pad(np.concatenate([luma, colours]), ((0, 0), (0, padding)))
    found = picture(image(encoding, rows, 6, 4, 6 + padding), "raw", "")
    np.testing.assert_allclose(found, np.broadcast_to([254, 0, 0], (4, 6, 3)), atol=2)
    with pytest.raises(EpisodeError, match="has 20 bytes"):
        picture(image(encoding, np.zeros(20, np.uint8), 4, 4, 4), "raw", "")
    with pytest.raises(EpisodeError, match="6×3 in nv.. does not have even sides"):
        picture(image(encoding, np.zeros(64, np.uint8), 6, 3, 6), "raw", "")


@pytest.mark.parametrize(
    "stated",
    ["jpeg", "rgb8; jpeg compressed bgr8", "bgr8; jpeg compressed ", "png", "bgr8; png compressed bgr8", ""],
)
def test_compressed_pictures_are_told_by_their_bytes(stated: str) -> None:
    encoded = cv2.imencode(".png" if "png" in stated else ".jpg", smooth()[..., ::-1])[1]
    found = picture({"format": stated, "data": encoded.reshape(-1)}, "still", "")
    assert np.abs(found.astype(int) - smooth()).mean() < 6


VP9 = {"lag-in-frames": "0", "deadline": "realtime", "cpu-used": "8", "auto-alt-ref": "0"}
AV1 = {"preset": "12", "svtav1-params": "pred-struct=1:lookahead=0"}


@pytest.mark.parametrize(
    ("codec", "name", "options"),
    [("libx264", "h264", LOW_DELAY), ("libvpx-vp9", "vp9", VP9), ("libsvtav1", "av1", AV1)],
)
def test_key_frames_of_every_codec_are_told(tmp_path, codec, name, options) -> None:
    pictures = write_video(tmp_path / "v.mcap", codec, name, options)
    packets = ros2.packets(pictures, codec, options, gop=10)
    assert [i for i, data in packets if is_keyframe(data, name)] == [0, 10, 20]
    stream = read(tmp_path / "v.mcap", arm(VIDEO_YAML)).streams["cam"]
    for indices in ([3], [25, 12], [29]):
        assert np.abs(stream.frames(indices).astype(int) - pictures[indices]).mean() < 12


@pytest.mark.parametrize(
    ("codec", "name", "options"), [("libx264", "h264", LOW_DELAY), ("libvpx-vp9", "vp9", VP9)]
)
def test_an_episode_that_begins_between_key_frames_is_decoded_from_the_one_before(
    tmp_path: Path, codec: str, name: str, options: dict[str, str]
) -> None:
    write_video(tmp_path / "v.mcap", codec, name, options)
    whole = read(tmp_path / "v.mcap", arm(VIDEO_YAML)).streams["cam"].frames(range(30))
    parted = arm(VIDEO_YAML, **{"format: rosbag": "format: rosbag, segments: {gap_s: 0.5}"})
    refs = SOURCE.index(str(tmp_path / "v.mcap"), parted)
    assert [ref.frames for ref in refs] == [1] * 30  # a picture a second
    for i in (0, 7, 10, 23):
        found = SOURCE.read(str(tmp_path / "v.mcap"), refs[i].id, parted).streams["cam"]
        assert found.timestamps.tolist() == [1 + i]
        np.testing.assert_array_equal(found.frames([0])[0], whole[i])


def test_frames_made_from_a_damaged_message_are_refused_up_to_the_next_keyframe(tmp_path: Path) -> None:
    made, group, hit = make(tmp_path / "v.h264", "libx264", {"crf": "4", "bf": "0"}, gop=13), 13, 6
    with av.open(str(made)) as container:
        packets = [bytes(packet) for packet in container.demux(video=0) if packet.size]
    keyframes = np.arange(len(packets)) % group == 0
    spoilt = bytearray(packets[hit])
    spoilt[12:] = np.random.default_rng(0).integers(0, 256, len(spoilt) - 12, np.uint8).tobytes()
    damaged = [*packets[:hit], bytes(spoilt), *packets[hit + 1 :]]

    def decoder(messages: list[bytes]) -> VideoDecoder:
        return VideoDecoder("h264", keyframes, lambda start: iter(messages[start:]), "v.mcap /video")

    whole = list(decoder(packets).each(range(len(packets))))
    going_on = decoder(damaged)
    for i in range(len(packets)):
        for asked in (going_on, decoder(damaged)):
            if hit <= i < group:
                with pytest.raises(EpisodeError, match=f"frame {i} of the video is damaged"):
                    next(asked.each([i]))
            else:
                np.testing.assert_array_equal(next(asked.each([i])), whole[i])


@pytest.mark.parametrize(
    ("stated", "codec"),
    [("libx264", "h264"), ("h264_nvenc", "h264"), ("hevc_vaapi", "h265"), ("h264;yuv420p;bgr8;bgr8", "h264"),
     ("libsvtav1", "av1"), ("mpeg4", "mpeg4")],
)  # fmt: skip
def test_the_codec_of_an_ffmpeg_packet_is_that_of_its_encoder(stated: str, codec: str) -> None:
    assert image_kind("ffmpeg_image_transport_msgs/msg/FFMPEGPacket") == "video"
    assert video_codec({"encoding": stated, "data": b""}) == codec


# -- pictures and numbers, chunk by chunk


RECORDING = make_recording(12)


@pytest.mark.parametrize("room", [1, 1 << 20])
@pytest.mark.parametrize("kind", ["ros1", "mcap-cdr-zstd", "mcap-without-chunks", "ros2-sqlite3"])
def test_pictures_come_in_any_order_and_repeated(tmp_path, monkeypatch, kind, room) -> None:
    monkeypatch.setattr(container, "CACHED_BYTES", room)
    stream = read(KINDS[kind](tmp_path, RECORDING), arm()).streams["front"]
    assert isinstance(stream, OneByOne) and stream.frames([]).shape[0] == 0
    for indices in ([0], [11, 3, 3], [2, 9]):
        np.testing.assert_array_equal(stream.frames(indices), RECORDING.pictures[indices])
        for index, one in zip(indices, stream.each(indices), strict=True):
            np.testing.assert_array_equal(one, RECORDING.pictures[index])


@pytest.mark.parametrize("size", [16, 40])
def test_squares_made_one_by_one_are_those_of_whole_batches(tmp_path: Path, size: int) -> None:
    for rule in ("short_side_crop", "letterbox", "stretch"):
        robot = arm(
            **{"key: /cam/image.raw}": f"key: /cam/image.raw, resize: {rule}, color: bgr, rotate: 90}}"}
        )
        folder = tmp_path / rule
        folder.mkdir()
        stream = read(KINDS["mcap-json"](folder, RECORDING), robot).streams["front"]
        for indices in ([0, 1, 2, 3], [7, 7, 7], [5, 1, 11, 1], [4]):
            expected = prepare(stream.frames(indices), robot.cameras[0], size)
            np.testing.assert_array_equal(prepared(stream, indices, robot.cameras[0], size), expected)


def test_sizes_that_are_claimed_take_no_memory() -> None:
    before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    with pytest.raises(ValueError, match="unpacks to"):
        decompress("zstd", zstandard.compress(bytes(10)), 500 << 20)
    assert resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before < 100 << 10  # KiB
    with pytest.raises(ValueError, match="claims"):
        decompress("zstd", b"", 1 << 50)


def test_chunks_of_a_bag_go_with_it(tmp_path: Path) -> None:
    bag = Bag(write_mcap(tmp_path / "run.mcap", RECORDING, cdr(), compression=CompressionType.ZSTD))
    (file,) = bag.files()
    assert isinstance(file, McapFile) and list(bag.records())
    kept = weakref.ref(file._chunks)
    del bag, file
    assert kept() is None


def test_pictures_that_change_size_are_refused(tmp_path: Path) -> None:
    how = cdr()
    plain, count = how[CAMERA], iter(range(99))

    def encode(item: Any) -> bytes:
        smaller = item._replace(value=item.value[:-2]) if next(count) == 5 else item
        return plain.encode(smaller)

    how[CAMERA] = plain._replace(encode=encode)
    stream = read(write_mcap(tmp_path / "run.mcap", RECORDING, how), arm()).streams["front"]
    camera = arm().cameras[0]
    with pytest.raises(EpisodeError, match="change size"):
        stream.frames(range(12))
    with pytest.raises(EpisodeError, match="change size"):
        prepared(stream, range(12), camera, 16)
    np.testing.assert_array_equal(stream.frames([5])[0], RECORDING.pictures[5][:-2])
