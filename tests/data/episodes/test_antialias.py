"""The filter `antialias`: its bytes are those that docs/format.md defines. Sheets and films."""

import io
from typing import Any

import cv2
import numpy as np
import pytest
from numpy.typing import NDArray
from PIL import Image

from hma_data.episodes.episode import Pictures
from hma_data.episodes.images import decode_image, prepare, prepared, resize
from hma_data.episodes.sheets import fitted, fitted_names, gif_bytes, text_width
from hma_data.registry.components import Camera

Bytes = NDArray[np.uint8]
JPEG, HALF, QUARTER = 92, cv2.IMREAD_REDUCED_COLOR_2, cv2.IMREAD_REDUCED_COLOR_4


def defined(frames: Bytes, height: int, width: int) -> Bytes:
    """Resize (N, H, W, 3) as docs/format.md defines it: columns, then rows, each rounded to a byte."""
    return one_axis(one_axis(frames, width, 2), height, 1)


def one_axis(frames: Bytes, count: int, axis: int) -> Bytes:
    source = frames.shape[axis]
    if source == count:
        return frames
    scale = source / count
    reach, rows = max(scale, 1.0), []
    for i in range(count):
        centre = (i + 0.5) * scale
        first, end = max(int(centre - reach + 0.5), 0), min(int(centre + reach + 0.5), source)
        weights = np.maximum(0, 1 - np.abs(np.arange(first, end) + 0.5 - centre) / reach)
        rows.append((first, weights / weights.sum()))
    largest = max(weights.max() for _, weights in rows)
    bits = max(b for b in range(1, 23) if int(largest * 2**b + 0.5) < 2**15)
    moved, made = np.moveaxis(frames, axis, 0).astype(np.int64), []
    for first, weights in rows:
        whole = np.floor(weights * 2**bits + 0.5).astype(np.int64)
        total = np.tensordot(whole, moved[first : first + len(whole)], 1)
        made.append((total + 2 ** (bits - 1)) >> bits)
    return np.moveaxis(np.clip(made, 0, 255).astype(np.uint8), 0, axis)


def noise(*shape: int) -> Bytes:
    return np.random.default_rng(0).integers(0, 256, (*shape, 3), np.uint8)


@pytest.mark.parametrize(
    ("height", "width", "size"), [(48, 48, 25), (120, 120, 31), (40, 40, 39), (20, 20, 33), (9, 9, 8)]
)
def test_its_bytes_are_the_defined_ones(height: int, width: int, size: int) -> None:
    frames = noise(3, height, width)
    assert np.array_equal(resize(frames, size, "stretch", "antialias"), defined(frames, size, size))


@pytest.mark.parametrize("count", [1, 16, 17])
def test_a_picture_does_not_depend_on_those_beside_it(count: int) -> None:
    frames = noise(count, 30, 50)[:, :, ::-1]
    alone = [resize(frame[None], 16, resize_filter="antialias")[0] for frame in frames]
    assert np.array_equal(resize(frames, 16, resize_filter="antialias"), alone)


def test_a_letterbox_has_black_borders() -> None:
    frames = noise(2, 24, 48)
    made = resize(frames, 16, "letterbox", "antialias")
    assert np.array_equal(made[:, 4:12], defined(frames, 8, 16))
    assert not made[:, :4].any() and not made[:, 12:].any()


def jpeg(height: int, width: int) -> bytes:
    smooth = cv2.resize(noise(1, 6, 8)[0], (width, height), interpolation=cv2.INTER_CUBIC)
    return cv2.imencode(".jpg", smooth, [cv2.IMWRITE_JPEG_QUALITY, JPEG])[1].tobytes()


@pytest.mark.parametrize(
    ("least", "flag"), [(0, cv2.IMREAD_COLOR), (49, cv2.IMREAD_COLOR), (48, HALF), (25, HALF), (24, QUARTER)]
)
def test_a_jpeg_is_decoded_at_the_smallest_size_that_is_large_enough(least: int, flag: int) -> None:
    data = jpeg(96, 130)
    expected = cv2.imdecode(np.frombuffer(data, np.uint8), flag)[..., ::-1]
    assert np.array_equal(decode_image(data, "here", least), expected)


def test_a_header_that_is_cut_off_is_no_reason_to_fail_early() -> None:
    data = jpeg(96, 130)
    comment = b"\xff\xfe\x00\x05abc"  # another segment before the frame header
    expected = decode_image(data, "here", 48)
    assert np.array_equal(decode_image(data[:2] + comment + data[2:], "here", 48), expected)
    with pytest.raises(Exception, match="cannot be decoded"):
        decode_image(data[:12], "here", 48)


def test_other_pictures_are_decoded_whole() -> None:
    data = cv2.imencode(".png", noise(1, 96, 130)[0])[1].tobytes()
    assert decode_image(data, "here", 24).shape == (96, 130, 3)


def test_a_stream_is_reduced_unless_the_camera_is_cropped() -> None:
    data = jpeg(96, 130)
    stream = Pictures(np.arange(1.0), lambda index, least=0: decode_image(data, "here", least), reduces=True)
    whole, half = (decode_image(data, "here", least)[None] for least in (0, 40))
    assert half.shape == (1, 48, 65, 3)

    def made(resize_filter: Any, **camera: Any) -> Bytes:
        settings = Camera.model_validate({"name": "c", "key": "k", **camera})
        got = prepared(stream, [0, 0], settings, 40, resize_filter)
        assert np.array_equal(got[0], got[1])
        frames = half if resize_filter == "antialias" and not settings.crop else whole
        assert np.array_equal(got[:1], prepare(frames, settings, 40, resize_filter))
        return got

    for given in ({}, {"rotate": 90}, {"resize": "letterbox"}, {"crop": [10, 10, 80, 80]}):
        made("antialias", **given)
        made("area", **given)


@pytest.mark.parametrize(
    "names",
    [
        [f"observation.state.left_shoulder_{axis}_joint.position" for axis in ("pitch", "roll", "yaw")],
        [f"{side}_hand_{finger}_0_joint" for side in ("left", "right") for finger in ("thumb", "index")],
        [f"a_very_long_name_without_an_end_{i}" for i in range(12)],
    ],
)
def test_shortened_names_fit_and_still_differ(names: list[str]) -> None:
    short = fitted_names(names, 100, 0.36)
    assert len(set(short)) == len(names)
    assert max(text_width(name, 0.36) for name in short) <= 100


def test_what_fits_stays_and_the_middle_of_a_long_text_goes() -> None:
    assert fitted("gripper", 200) == "gripper"
    short = fitted("pick up the red block and put it into the green bowl", 200)
    assert short.startswith("pick up") and short.endswith("bowl") and ".." in short


def test_a_gif_has_every_frame_in_its_colours_and_at_its_rate() -> None:
    colours = np.array([[200, 30, 60], [10, 160, 90], [20, 40, 220]], np.uint8)
    frames = np.broadcast_to(colours[:, None, None], (3, 24, 32, 3)).copy()
    film: Any
    with Image.open(io.BytesIO(gif_bytes(frames, 5.0))) as film:
        assert (film.n_frames, film.size, film.info["duration"]) == (3, (32, 24), 200)
        for number, frame in enumerate(frames):
            film.seek(number)
            assert np.abs(np.asarray(film.convert("RGB"), int) - frame).max() <= 8
