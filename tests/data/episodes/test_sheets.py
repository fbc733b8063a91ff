"""Text in pictures: what is too long is shortened where nothing is lost."""

import pytest

from hma_data.episodes.sheets import fitted, fitted_names, text_width


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
    assert fitted_names(["gripper", "dx"], 200) == ["gripper", "dx"]
    short = fitted("pick up the red block and put it into the green bowl", 200)
    assert short.startswith("pick up") and short.endswith("bowl") and ".." in short
