"""The two clocks of a bag: which orders the messages, and which topics may be paired by them.

Frame i of the camera shows i, and action i is i, so every pair that is off shows.
"""

from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from hma_data.episodes.align import to_clip
from hma_data.errors import EpisodeError
from hma_data.inspection.infer import infer
from hma_data.inspection.inspect import examine, inspect_recording
from hma_data.registry.embodiment import Embodiment
from hma_data.sources.bags.clocks import SECOND_NS, MessageTimes, sorted_by
from hma_data.storage.yaml_io import parse_yaml
from tests.data import ros2
from tests.data.bag_files import SOURCE

PERIOD_NS = SECOND_NS // 10
FRAMES = 40
YAML = """
id: toy
kind: simulation
frequency_hz: 10
target_hz: 10
action: {{space: mixed, components: [{{key: {action}, dims: 1}}]}}
cameras: [{{name: cam, key: /cam{stamp}}}]
sync: {{actions: hold, tolerance_ms: 5{sync}}}
source: {{format: rosbag}}
"""


def at(i: int) -> int:
    return ros2.START_NS + i * PERIOD_NS


def robot(sync: str = "", stamp: str = "", action: str = "/cmd.data") -> Embodiment:
    return Embodiment.from_yaml(YAML.format(sync=sync, stamp=stamp, action=action))


def bag(
    path: Path,
    header: Callable[[int], int],
    received: Callable[[int], int] = at,
    stamped: bool = False,
    order: Sequence[int] = range(FRAMES),
    mcap: bool = False,
) -> Path:
    messages = []
    for i in order:
        messages.append(("/cam", ros2.image(header(i), i), received(i)))
        action = ros2.joints(header(i), ["a"], [i]) if stamped else ros2.array([i])
        messages.append(("/cmd", action, received(i) + 10**6))
    return ros2.write(path, messages, mcap)


def pairs(path: Path, embodiment: Embodiment, episode: str = "") -> list[tuple[int, int]]:
    name = episode or SOURCE.episode_ids(str(path))[0]
    clip = to_clip(SOURCE.read(str(path), name, embodiment), embodiment)
    return list(zip(ros2.numbers(clip), clip.actions[:, 0].astype(int).tolist(), strict=True))


@pytest.mark.parametrize("rate", ["frequency_hz: unknown", "frequency_hz: null\nstride: 4"])
def test_a_bag_whose_rate_nobody_states_is_inspected_by_its_times(rate: str, tmp_path: Path) -> None:
    def paused(i: int) -> int:
        return at(i) + (i >= 20) * 5 * SECOND_NS

    path, yaml = bag(tmp_path / "run", paused, paused), tmp_path / "toy.yaml"
    text = YAML.format(sync="", stamp="", action="/cmd.data")
    yaml.write_text(text.replace("frequency_hz: 10", rate))
    assert inspect_recording(path, yaml)["embodiment"]["rate on the grid"] == "10 Hz"
    said = " ".join(map(str, examine(path, yaml)))
    assert "/cam: pauses for 5.1 s" in said
    assert ("a window, 48 frames — set a smaller stride" in said) == ("stride" in rate)


IN_ORDER = [(i, i) for i in range(FRAMES)]


@pytest.mark.parametrize(
    ("header", "says"),
    [
        (lambda i: at(i) - 500_000_000, r"/cam are 0\.5 s behind receipt, /cmd has only receive times"),
        (lambda i: at(i) - 400_000_000, r"pairs would be off by 0\.4 s"),
        (lambda i: at(i) - 200_000_000, r"/cam are 0\.2 s behind receipt"),
        (lambda i: at(i) + 300_000_000, r"/cam are 0\.3 s ahead of receipt"),
        (lambda i: at(i) + 80_000_000, r"/cam are 0\.08 s ahead of receipt"),
        (lambda i: at(i) - i * 5_000_000, r"/cam .*drift by 0\.203 s over the recording"),
        (lambda i: at(i) + i * 5_000_000, r"/cam .*drift by 0\.203 s over the recording"),
        (lambda i: 5 * SECOND_NS + i * PERIOD_NS, r"/cam do not come from the recorder's clock"),
        (lambda i: 5 * SECOND_NS + i * PERIOD_NS // 2, r"/cam do not come from the recorder's clock"),
    ],
)  # fmt: skip
def test_clocks_that_differ_are_named_and_a_choice_is_asked(header, says, tmp_path) -> None:
    path = bag(tmp_path / "run", header)
    with pytest.raises(EpisodeError, match=says) as error:
        pairs(path, robot())
    assert "sync: {stamp: receive}" in str(error.value) and "stamp: header at camera cam" in str(error.value)
    assert pairs(path, robot(sync=", stamp: receive")) == IN_ORDER  # the advice is right


def test_a_stamp_stated_at_the_camera_keeps_its_clock(tmp_path: Path) -> None:
    path = bag(tmp_path / "run", lambda i: at(i) - 500_000_000)
    assert {frame - action for frame, action in pairs(path, robot(stamp=", stamp: header"))} == {5}


@pytest.mark.parametrize("delay_ms", [-5, 0, 40, 90])
def test_the_delay_of_a_camera_is_no_other_clock(delay_ms: int, tmp_path: Path) -> None:
    path = bag(tmp_path / "run", lambda i: at(i) - delay_ms * 10**6, lambda i: at(i))
    assert pairs(path, robot())


def test_headers_of_one_simulated_clock_pair_with_each_other(tmp_path: Path) -> None:
    path = bag(tmp_path / "run", lambda i: 5 * SECOND_NS + i * PERIOD_NS, stamped=True)
    assert pairs(path, robot(action="/cmd.position")) == IN_ORDER


def test_a_first_stamp_of_zero_leaves_the_topic_to_receipt(tmp_path: Path) -> None:
    path = bag(tmp_path / "run", lambda i: at(i) - 20_000_000 if i else 0)
    assert pairs(path, robot()) == IN_ORDER


@pytest.mark.parametrize(
    "received",
    [
        lambda i: at(i) + (PERIOD_NS + 2_000_000 if i == 10 else 0),  # swapped
        lambda i: at(15) + i * 1000 if 10 <= i < 15 else at(i),  # in a burst
        lambda i: at(i) - (2_030_000_000 if i >= 20 else 0),  # set back
    ],
)
@pytest.mark.parametrize("mcap", [False, True])
@pytest.mark.parametrize("sorted_file", [False, True])
def test_even_headers_win_over_arrival(received, mcap, sorted_file, tmp_path) -> None:
    """Neither a network that swaps messages nor a recorder whose clock is set back changes the order."""
    order = sorted(range(FRAMES), key=received) if sorted_file else range(FRAMES)
    path = bag(tmp_path / "run", at, received, stamped=True, order=order, mcap=mcap)
    assert pairs(path, robot(action="/cmd.position")) == IN_ORDER
    values = parse_yaml(infer(str(path), "x"), "x")
    assert "stamp" not in values["sync"]  # `stamp: receive` would mix the frames


def restarted(i: int) -> int:
    return (100 * SECOND_NS if i < 20 else SECOND_NS) + i % 20 * PERIOD_NS


@pytest.mark.parametrize("stamped", [False, True])
def test_headers_that_begin_anew_are_refused_with_what_helps(stamped: bool, tmp_path: Path) -> None:
    path = bag(tmp_path / "run", restarted, stamped=stamped)
    action = "/cmd.position" if stamped else "/cmd.data"
    with pytest.raises(EpisodeError, match=r"header stamps go back by 101 s at message 20") as error:
        pairs(path, robot(action=action))
    assert "segments: {gap_s: 1}" in str(error.value) and "sync: {stamp: receive}" in str(error.value)
    assert pairs(path, robot(sync=", stamp: receive", action=action)) == IN_ORDER
    if stamped:
        parts = Embodiment.from_values(
            robot(action=action).to_dict() | {"source": {"format": "rosbag", "segments": {"gap_s": 1}}}, ""
        )
        assert pairs(path, parts, "run/0000") == IN_ORDER[:20]
        assert pairs(path, parts, "run/0001") == IN_ORDER[20:]


@pytest.mark.parametrize("step_s", [0.5, 10])
def test_no_receipt_is_advised_where_both_clocks_were_set_back(step_s: float, tmp_path: Path) -> None:
    def stepped(i: int) -> int:
        return at(i) - (int(step_s * SECOND_NS) if i >= 20 else 0)

    path = bag(tmp_path / "run", stepped, stepped)
    with pytest.raises(EpisodeError, match="header stamps go back") as error:
        pairs(path, robot())
    assert "receive" not in str(error.value)
    with pytest.raises(EpisodeError, match="receive times go back"):
        pairs(path, robot(sync=", stamp: receive"))


def test_a_clock_stepped_forward_is_a_pause(tmp_path: Path) -> None:
    path = bag(tmp_path / "run", *[lambda i: at(i) + (3600 * SECOND_NS if i >= 20 else 0)] * 2)
    assert pairs(path, robot()) == IN_ORDER


def test_infer_measures_on_the_clock_that_it_proposes(tmp_path: Path) -> None:
    path = bag(tmp_path / "run", restarted, stamped=True)
    values = parse_yaml(infer(str(path), "x"), "x")
    assert values["sync"]["stamp"] == "receive" and values["sync"]["max_skew_ms"] <= 200
    assert values["frequency_hz"] == 10
    assert "/cam" in values["provenance"]["stamp"]


def test_infer_asks_where_clocks_differ(tmp_path: Path) -> None:
    path = bag(tmp_path / "run", lambda i: at(i) + 300_000_000)
    values = parse_yaml(infer(str(path), "x"), "x")
    assert values["sync"]["stamp"] == "receive"
    asked = values["provenance"]["stamp"]
    assert asked.startswith("TODO") and "0.3 s ahead of receipt" in asked


@pytest.mark.parametrize("count", [1, 3])
def test_actions_that_end_before_the_first_frame_are_said(count: int, tmp_path: Path, caplog) -> None:
    messages = [
        ("/cmd", ros2.joints(at(-8 + i), ["a"], [7]), at(-8 + i)) for i in range(count)
    ] + [("/cam", ros2.image(at(i), i), at(i)) for i in range(24)]  # fmt: skip
    path = ros2.write(tmp_path / "run", messages)
    clip = to_clip(SOURCE.read(str(path), "run", robot(action="/cmd.position")), robot())
    assert (clip.actions == 7).all() and clip.flags["held_actions"] == 24
    line = next(record.message for record in caplog.records if "before the first frame" in record.message)
    assert "/cmd" in line and "24 frames" in line
    (found,) = [one for one in examine(path) if one.check == "offset"]
    assert found.key == "/cmd" and "before the first frame" in found.message


COUNT = 20
SECOND = 10**9


@pytest.mark.parametrize("back_s", [0.75, 5, 3600])
def test_a_clock_that_is_set_back_is_never_sorted(back_s: float) -> None:
    times = np.arange(40) * SECOND // 10
    times[20:] -= round(back_s * SECOND)
    assert sorted_by(times, np.zeros(40, np.int64)) is None
    files = np.zeros(40, np.int64)
    fault = MessageTimes("/cam", times, None, files).set_back_error("receive", "").fault
    assert f"go back by {back_s - 0.1:.3g} s at message 20" in fault
    parts = np.repeat([1, 0], 20)  # the parts of one recording may be stored in any order
    if back_s > 2:
        assert sorted_by(times, parts) is not None
