"""Frames by index out of video files, against decoding the whole file in order; pictures made square."""

import shutil
from pathlib import Path

import av
import cv2
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from hma_data.episodes.episode import Pictures
from hma_data.episodes.images import decode_image, prepare, prepared
from hma_data.errors import EpisodeError
from hma_data.registry.components import Camera
from hma_data.sources.common.video_file import VideoFile, frame_table
from tests.data.fresh import run_fresh
from tests.data.videos import HEIGHT, WIDTH, encode, in_order, number_of, picture, turn
from tests.hostile import Row, damage, untouched, whole

LENGTH = 40


@pytest.fixture(scope="module", params=["h264", "av1"])
def video(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return encode(tmp_path_factory.mktemp("video") / "v.mp4", range(LENGTH), request.param)


def test_every_frame_equals_decoding_in_order(video: Path) -> None:
    assert np.array_equal(VideoFile(video).frames(range(LENGTH)), in_order(video))


@settings(max_examples=15)
@given(calls=st.lists(st.lists(st.integers(0, LENGTH - 1), max_size=6), min_size=1, max_size=5))
def test_any_order_of_calls_gives_the_frames_asked_for(video: Path, calls: list[list[int]]) -> None:
    file = VideoFile(video)
    for indices in calls:
        assert [number_of(frame) for frame in file.frames(indices)] == indices


def test_rising_batches_decode_each_frame_once(video: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, seen = VideoFile(video), []
    inner = VideoFile._index_of
    monkeypatch.setattr(VideoFile, "_index_of", lambda self, frame: seen.append(1) or inner(self, frame))
    for start in range(0, LENGTH, 8):
        file.frames(range(start, start + 8))
    assert len(seen) == LENGTH


def test_a_far_jump_skips_to_its_keyframe(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file, seen = VideoFile(encode(tmp_path / "v.mp4", range(LENGTH), gop=8, b_frames=0)), []
    inner = VideoFile._index_of
    monkeypatch.setattr(VideoFile, "_index_of", lambda self, frame: seen.append(1) or inner(self, frame))
    file.frames([0, 34])
    assert len(seen) <= 1 + 8


FORKING = """
import os, sys
from pathlib import Path
from hma_data.sources.common.video_file import VideoFile
from tests.data.videos import number_of

file = VideoFile(Path(sys.argv[1]))
file.frames([3])
child = os.fork()
if child == 0:
    os._exit(0 if [number_of(frame) for frame in file.frames([4, 5, 30])] == [4, 5, 30] else 1)
mine = [number_of(frame) for frame in file.frames([4, 5, 31])]
assert os.waitstatus_to_exitcode(os.waitpid(child, 0)[1]) == 0
assert mine == [4, 5, 31]
"""


def test_a_forked_child_and_its_parent_read_the_same_file(video: Path) -> None:
    run_fresh(FORKING, video)


def test_no_indices_give_no_pictures(video: Path) -> None:
    assert VideoFile(video).frames([]).shape == (0, 1, 1, 3)  # as of every stream


@pytest.mark.parametrize(
    ("matrix", "shown"),
    [
        ((-1, 0, 0, 1), lambda plain: plain[:, ::-1]),
        ((1, 0, 0, -1), lambda plain: plain[::-1]),
        ((-1, 0, 0, -1), lambda plain: plain[::-1, ::-1]),
        ((0, 1, 1, 0), lambda plain: plain.transpose(1, 0, 2)),
    ],
    ids=["left-right", "upside down", "half a turn", "across"],
)
def test_a_file_that_says_it_is_mirrored_is_shown_so(tmp_path, matrix, shown) -> None:
    path = encode(tmp_path / "v.mp4", [20, 21])
    plain = VideoFile(path).frames([0])[0]
    np.testing.assert_array_equal(VideoFile(turn(path, matrix)).frames([0])[0], shown(plain))


def test_a_file_filmed_upright_is_turned(tmp_path: Path) -> None:
    path = turn(encode(tmp_path / "v.mp4", [20, 21]))
    table = frame_table(path)
    assert (table.width, table.height) == (HEIGHT, WIDTH)  # as decoded, not as stored
    frame = VideoFile(path).frames([0])[0]
    assert frame.shape == (WIDTH, HEIGHT, 3)  # turned clockwise: the mark goes from top left to top right
    assert frame[:12, -12:].mean() > 200 > frame[-12:].mean()
    assert frame[:12, :12].mean() < 200


def sound(path: Path) -> None:
    with av.open(str(path), "w") as container:
        stream = container.add_stream("aac", rate=16000, layout="mono")
        frame = av.AudioFrame.from_ndarray(np.zeros((1, 1024), np.float32), format="fltp", layout="mono")
        frame.sample_rate = 16000
        container.mux(stream.encode(frame))
        container.mux(stream.encode(None))


HLS = "#EXTM3U\n#EXT-X-TARGETDURATION:4\n#EXTINF:4,\ninner.mp4\n#EXT-X-ENDLIST\n"
NO_VIDEO = "cannot be decoded as video: Invalid data found when processing input — it may be cut off"
HOSTILE: dict[str, Row] = {
    "no file": (untouched, r"v\.mp4: no such video file — copy the recording again, whole"),
    "empty": (whole(b""), r"v\.mp4: is empty — copy it again"),
    "zeros": (whole(bytes(5000)), rf"v\.mp4: {NO_VIDEO}"),
    "sound alone": (sound, r"v\.mp4: has no video in it"),
    "a playlist": (whole(HLS), r"v\.mp4: cannot be decoded"),  # and does not open the other file
    "a list of files": (whole("ffconcat version 1.0\nfile inner.mp4\n"), r"v\.mp4: cannot be decoded"),
}


@pytest.mark.parametrize("case", HOSTILE)
def test_a_file_that_is_no_video_is_told_in_words(case: str, video: Path, tmp_path: Path) -> None:
    shutil.copy(video, tmp_path / "inner.mp4")
    spoil, said, *_ = HOSTILE[case]
    spoil(tmp_path / "v.mp4")
    with pytest.raises(EpisodeError, match=said) as found:
        VideoFile(tmp_path / "v.mp4")
    assert "\n" not in str(found.value)


@given(data=st.data())
def test_a_cut_or_flipped_file_gives_right_frames_or_our_error(video, tmp_path, data) -> None:
    path = Path(shutil.copyfile(video, tmp_path / "bad.mp4"))
    cut = damage(data, path)
    try:
        file = VideoFile(path)
        frames = file.frames(range(min(len(file), 1000)))
    except EpisodeError as fault:
        assert str(path) in str(fault)
        return
    if cut:  # a flipped bit of the picture itself cannot be known
        assert [number_of(frame) for frame in frames] == list(range(len(frames)))


@pytest.mark.real
@pytest.mark.parametrize(
    "name",
    [
        "lerobot/g1_v21/videos/chunk-000/observation.images.cam_high/episode_000001.mp4",
        "hands/demo3.mp4",
        "hands/banner.gif",
    ],
)
def test_a_real_video_strided_equals_decoding_in_order(real_data: Path, name: str) -> None:
    wanted = [0, 1, 7, 31, 60, 61, 90]
    with av.open(str(real_data / name)) as container:
        decoded = [frame for _, frame in zip(range(91), container.decode(video=0))]
    file = VideoFile(real_data / name)
    for index, mine in zip(wanted, file.frames(wanted), strict=True):
        assert np.array_equal(mine, decoded[index].to_ndarray(format="rgb24"))
    last = len(file) - 1
    assert np.array_equal(file.frames([last, 0])[1], decoded[0].to_ndarray(format="rgb24"))


def test_pictures_survive_their_codec(video: Path) -> None:
    off = np.abs(VideoFile(video).frames([7])[0].astype(int) - picture(7))
    assert np.median(off) <= 1


def test_a_crop_that_leaves_the_picture_is_refused() -> None:
    camera = Camera(name="c", key="k", crop=(4, 0, 8, 8))
    with pytest.raises(EpisodeError, match=r"crop \[4, 0, 8, 8\] leaves the image of 8×8"):
        prepare(np.zeros((1, 8, 8, 3), np.uint8), camera, 8)


@pytest.mark.parametrize("rule", ["short_side_crop", "letterbox", "stretch"])
@pytest.mark.parametrize("resize_filter", ["area", "linear"])
@pytest.mark.parametrize(("height", "width"), [(48, 64), (30, 17), (16, 16), (9, 40)])
@pytest.mark.parametrize(
    "changes",
    [
        {},
        {"color": "bgr", "flip": "horizontal", "rotate": 90},  # clockwise
        {"flip": "vertical", "rotate": 180},
        {"rotate": 270},
        {"crop": [1, 2, 7, 6]},
    ],
)
def test_resizing_is_opencvs_on_a_packed_copy_bit_for_bit(rule, resize_filter, height, width, changes):
    frames = np.random.default_rng(3).integers(0, 256, (3, height, width, 3), np.uint8)
    camera = Camera.model_validate({"name": "c", "key": "k", "resize": rule, **changes})
    stream = Pictures(np.arange(3.0), lambda index: frames[index])
    mine = prepare(frames, camera, 16, resize_filter)
    np.testing.assert_array_equal(prepared(stream, range(3), camera, 16, resize_filter), mine)
    np.testing.assert_array_equal(prepared(stream, [2], camera, 16, resize_filter), mine[2:])
    plain = camera.model_copy(update={"resize": "stretch"})
    for raw, square in zip(frames, mine):
        turned = resize_input(raw, plain)
        side = min(turned.shape[:2])
        if rule == "short_side_crop":
            top, left = (turned.shape[0] - side) // 2, (turned.shape[1] - side) // 2
            turned = turned[top : top + side, left : left + side]
        scale = 16 / max(turned.shape[:2])
        inner = (
            [max(1, round(size * scale)) for size in turned.shape[:2]] if rule == "letterbox" else [16, 16]
        )
        shrinks = inner[0] < turned.shape[0] or inner[1] < turned.shape[1]
        how = cv2.INTER_AREA if resize_filter == "area" and shrinks else cv2.INTER_LINEAR
        expected = np.zeros((16, 16, 3), np.uint8)
        top, left = (16 - inner[0]) // 2, (16 - inner[1]) // 2
        expected[top : top + inner[0], left : left + inner[1]] = cv2.resize(
            turned.copy(), (inner[1], inner[0]), interpolation=how
        )
        np.testing.assert_array_equal(square, expected)


def resize_input(raw: np.ndarray, camera: Camera) -> np.ndarray:
    if camera.color == "bgr":
        raw = raw[..., ::-1]
    if camera.flip:
        raw = raw[:, ::-1] if camera.flip == "horizontal" else raw[::-1]
    raw = np.rot90(raw, -(camera.rotate or 0) // 90)
    if camera.crop:
        x, y, width, height = camera.crop
        raw = raw[y : y + height, x : x + width]
    return raw


def test_no_pictures_stay_none_and_a_change_of_size_is_an_error() -> None:
    sizes = [(8, 8, 3), (8, 8, 3), (6, 8, 3)]
    stream = Pictures(np.arange(3.0), lambda index: np.zeros(sizes[index], np.uint8))
    assert stream.frames([]).shape[0] == 0
    assert stream.frames([2]).shape == (1, 6, 8, 3)
    with pytest.raises(EpisodeError, match="change size within the episode"):
        stream.frames([0, 1, 2])


HUGE = """
import sys
from pathlib import Path
from hma_data.episodes.images import decode_image
from hma_data.errors import EpisodeError

for path in sys.argv[1:]:
    try:
        decode_image(Path(path).read_bytes(), "e")
    except EpisodeError:
        continue
    raise AssertionError(path)
"""


def test_a_huge_size_is_refused_wherever_it_is_claimed(tmp_path: Path) -> None:
    bmp, png, jpg = (
        bytearray(cv2.imencode(kind, np.zeros((8, 8, 3), np.uint8))[1]) for kind in (".bmp", ".png", ".jpg")
    )
    bmp[18:26] = (30_000).to_bytes(4, "little") * 2
    png[16:24] = (30_000).to_bytes(4, "big") * 2
    at = jpg.index(b"\xff\xc0")
    jpg[at + 5 : at + 9] = (30_000).to_bytes(2, "big") * 2
    jpg[2:2] = (b"\xff\xe1\xff\xff" + bytes(65533)) * 2  # more metadata before it than is looked at
    for name, data in {"bmp": bmp, "png": png, "jpg": jpg}.items():
        (tmp_path / name).write_bytes(data)
    run_fresh(HUGE, *(tmp_path / name for name in ("bmp", "png", "jpg")))


@given(data=st.data())
def test_a_damaged_picture_is_a_picture_or_our_error(data: st.DataObject) -> None:
    suffix = data.draw(st.sampled_from([".png", ".jpg", ".bmp", ".webp", ".tiff"]))
    content = bytearray(
        cv2.imencode(suffix, np.random.default_rng(0).integers(0, 256, (9, 7, 3), np.uint8))[1]
    )
    for _ in range(data.draw(st.integers(1, 4))):
        content[data.draw(st.integers(0, len(content) - 1))] = data.draw(st.integers(0, 255))
    content = content[: data.draw(st.integers(0, len(content)))]
    try:
        assert decode_image(bytes(content), "e").shape[2] == 3
    except EpisodeError as fault:
        assert str(fault)


@pytest.mark.parametrize(
    ("suffix", "dtype"), [(".png", "u2"), (".tiff", "u2"), (".tiff", "f4"), (".pgm", "u2"), (".pfm", "f4")]
)
def test_depth_is_refused(suffix: str, dtype: str) -> None:
    depth = cv2.imencode(suffix, np.full((8, 8), 3000, dtype))[1].tobytes()
    with pytest.raises(EpisodeError, match="more than 8 bits of grey: depth, not colour"):
        decode_image(depth, "camera 0")
