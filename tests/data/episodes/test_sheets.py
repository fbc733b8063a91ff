"""Text in pictures, shortened where nothing is lost; films that move."""

import io
from typing import Any

import numpy as np
import pytest
from PIL import Image

from hma_data.episodes.sheets import fitted, fitted_names, gif_bytes, text_width


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
