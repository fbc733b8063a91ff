"""Scenes to drive in: what the values of an action are, prompts, recordings, and what is saved of a drive."""

import io
import zipfile
from dataclasses import replace
from itertools import groupby
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.episodes.align import to_clip
from hma_data.episodes.images import resize
from hma_data.episodes.sheets import grid, png_bytes
from hma_data.errors import UsageError
from hma_data.lab import family
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import ShardSet
from hma_data.sources.base import open_source
from hma_model.checkpoint.folder import BUNDLED, Checkpoint
from hma_model.generation.unmask import Decoding
from hma_model.play.pads import Pad, describe, hint, labels, pads
from hma_model.play.save import film, lerobot_episode
from hma_model.play.session import Frame, Session, jpeg
from hma_model.worlds.images import fitted
from hma_model.worlds.scenes import PROMPT_FRAMES, LabRobot, RecordedRobot, apart, drivable
from tests.conftest import BlockTokenizer
from tests.data import cameras as three
from tests.model.robots import CONFIG, save, yaml
from tests.model.shards import state_pauses
from tests.model.true_world import TrueWorld, lab_robots

RIGHT_DOWN, UP = (False, False), (False, True)
HALVES = (0.0, 0.0, 0.5, 1.0), (0.5, 0.0, 1.0, 1.0)
KINDS: dict[str, tuple[list[str], list[Pad]]] = {  # robot -> kinds of its values, and its image's pads
    "mover_04": (["rate"] * 2, [Pad(0, 1)]),
    "mover_02": (["target"] * 2, [Pad(0, 1, RIGHT_DOWN, (0, 0), (128, 128))]),
    "mover_10": (["rate"] * 2, [Pad(1, 0, UP)]),
    "pusht_fast": (["target"] * 2, [Pad(0, 1, RIGHT_DOWN, (0, 0), (512, 512))]),
    "pusht_slow": (["rate", "rate", "switch"], [Pad(0, 1)]),
    "pendulum": (["rate"], [Pad(0, None, UP)]),
    "arm1_03": (["target"], [Pad(0, None, (True, True))]),  # hangs from above: clockwise is to the left
    "arm4_04": (["target"] * 4 + ["switch"], [Pad(0, 1, UP, zone=HALVES[0]), Pad(2, 3, UP, zone=HALVES[1])]),
    "crane_01": (["rate", "rate", "switch"], [Pad(0, 1, UP)]),
    "gantry_04": (["rate"] * 3, [Pad(0, 1)]),
}


@pytest.mark.parametrize("name", KINDS)
def test_each_value_of_an_action_rests_or_stays_as_its_robot_means_it(name: str) -> None:
    (robot,) = lab_robots(name).values()
    kinds, dragged = KINDS[name]
    assert [dim.kind for dim in robot.dimensions] == kinds
    assert pads(robot) == dragged
    for dim in robot.dimensions:
        assert dim.low < dim.high and (dim.kind != "rate" or dim.low == -dim.high)


def test_a_drag_moves_the_slider_of_the_rail_that_is_pressed() -> None:
    (upright,), (level,) = (lab_robots(name).values() for name in ("rails_03", "rails_09"))
    assert [(pad.x, pad.y) for pad in pads(upright)] == [(None, 1), (None, 0)]  # the right one has the arrows
    first, second = pads(level)[:2]
    assert (first.x, first.y, first.high) == (0, None, (128, 128))
    assert first.zone[:2] == (0, 0) and first.zone[3] == second.zone[1]


PARTS = ["arm1_03", "arm1_17", "arm2_12", "arm3_05", "mover_02", "gantry_04", "rails_03"]


@pytest.mark.parametrize("name", PARTS)
def test_a_drag_to_the_right_or_down_moves_a_part_there(name: str) -> None:
    (robot,) = lab_robots(name).values()
    body, pad = family.Body.of(name), pads(robot)[0 if name.startswith("arm") else -1]
    pose = np.zeros(len(body.axes)) if name.startswith("arm") else body.limits.mean(0)
    moved = [k for k, i in enumerate((pad.x, pad.y)) if i == 0 or (i and not name.startswith("arm"))]
    assert moved  # of an arm, the first link
    for k in moved:
        action = np.where([dim.kind == "rate" for dim in robot.dimensions], 0.0, pose)
        action[(pad.x, pad.y)[k]] += -0.1 if pad.flips[k] else 0.1
        before, after = (body.mechanism.tip(one)[0] for one in (pose, body.moved(pose, action)))
        assert after[k] > before[k]


def test_a_robot_says_what_a_drag_on_its_image_does() -> None:
    said = {name: hint(robot) for name, robot in lab_robots("mover_04", "rails_03", "arm4_04").items()}
    assert said["mover_04"] == "Drag on the image: sideways for vx, up or down for vy"
    assert said["rails_03"] == "Drag on the image, one area each: slider 1, slider 2"
    assert said["arm4_04"].endswith("one area each: joint 1 and joint 2, joint 3 and joint 4")


def test_values_without_names_are_labelled_by_the_end_of_their_key() -> None:
    (robot,) = lab_robots("mover_04").values()
    given: list[tuple[list[dict[str, Any]], list[str]]] = [
        ([{"key": "cmd/joint target", "dims": 2}], ["joint target 0", "joint target 1"]),
        ([{"key": "left/q", "dims": 1}, {"key": "right/q", "dims": 1}], ["left q", "right q"]),
        ([{"key": "/arm/cmd.position", "dims": 1, "names": ["elbow_joint"]}], ["elbow joint"]),
        ([{"key": "/arm/cmd.position", "dims": 1}, {"key": "grip", "dims": 1}], ["cmd position", "grip"]),
        (
            [{"key": "action", "dims": 2, "slice": [0, 2]}, {"key": "action", "dims": 1, "slice": [2, 3]}],
            ["action 0", "action 1", "action 2"],
        ),
    ]
    for components, wanted in given:
        values = robot.embodiment.to_dict()
        values["action"] = {"space": "joint_position", "components": components}
        own = Embodiment.from_values(values, "a robot")
        dims = tuple(replace(robot.dimensions[0], name=name) for name in own.action.names())
        shown: Any = SimpleNamespace(key="a", source="recordings", embodiment=own, dimensions=dims)
        assert labels(shown) == [one["label"] for one in describe(shown)["dimensions"]] == wanted
        assert hint(shown).endswith(wanted[1] if len(wanted) == 2 else wanted[0]) or len(wanted) == 3


def test_all_robots_of_the_embedded_model_can_be_driven() -> None:
    parts = [drivable(Checkpoint.open(part), (), pytest.fail) for part in BUNDLED.values()]
    robots = {name: robot for part in parts for name, robot in part.items()}
    assert not isinstance(robots.pop("fetch:images"), LabRobot)
    assert len(robots) == 16 and all(isinstance(robot, LabRobot) for robot in robots.values())


@pytest.mark.parametrize("name", ["mover_02", "pusht_fast", "arm2_12", "pusht_slow"])
def test_a_scene_begins_with_a_prompt_and_a_action_that_leaves_the_robot_there(name: str) -> None:
    (robot,) = lab_robots(name).values()
    scene = robot.scene(3)
    assert scene.prompt.frames.shape == (PROMPT_FRAMES, 128, 128, 3)
    assert scene.prompt.chunks.shape == (PROMPT_FRAMES - 1, robot.embodiment.chunk_dim)
    chunk = np.tile(scene.action, robot.embodiment.stride)
    for _ in range(25):  # a target is reached
        still = scene.advance(chunk)
    again = scene.advance(chunk)
    assert still and again and still[1] is not None and again[1] is not None
    moved = np.abs(still[1].astype(int) - again[1]).mean()
    assert moved < 0.1


@pytest.mark.parametrize("size", [96, 256])
def test_what_truly_happens_is_shown_in_the_size_of_the_models_images(size: int) -> None:
    class Scaled(TrueWorld):
        def image(self, session: int) -> np.ndarray:
            return resize(super().image(session)[None], size)[0]

    robots = drivable(Checkpoint.open("embedded-fsq"), (), pytest.fail)
    plain = robots["mover_04"]
    robot = LabRobot(plain.embodiment, Checkpoint.open("embedded-fsq").stats("mover_04"), size)
    scene = robot.scene(0)
    found = scene.advance(None)
    assert scene.prompt.frames.shape == (PROMPT_FRAMES, size, size, 3) and found[1].shape == (size, size, 3)
    session = Session("s", robot, 0, robot.scene(0), Scaled(), Decoding(2, 0.0))
    assert session.start.psnr is not None


@pytest.fixture
def shards(
    toy_arm: Embodiment, toy_recording: Path, block_tokenizer: BlockTokenizer, tmp_path: Path
) -> ShardSet:
    convert(toy_arm, toy_recording, block_tokenizer, tmp_path / "shards", settings=Settings(val_fraction=0.5))
    return ShardSet(tmp_path / "shards")


def test_a_recordings_truth_is_known_for_its_own_actions(shards, block_tokenizer) -> None:
    robot = RecordedRobot(shards, lambda: block_tokenizer, shards.manifest.stats, "first")
    one, other = robot.scene(0), robot.scene(1)
    assert not np.array_equal(one.prompt.frames, other.prompt.frames)
    assert [(dim.name, dim.kind) for dim in robot.dimensions] == [("a", "rate"), ("b", "rate"), ("c", "rate")]
    frames, count = [*one.prompt.frames], 0
    while (step := one.advance(None)) is not None:
        chunk, image = step
        assert image is not None
        shown = image[0, 0, 1] // 17  # the toy's image and actions tell its frame
        assert shown == (chunk.reshape(2, 3)[-1, 1] + 1) % 16
        frames.append(image)
        count += 1
    assert count == len(frames) - PROMPT_FRAMES > 0
    assert other.advance(np.zeros(6, np.float32)) is not None
    followed = other.advance(None)
    assert followed is not None and followed[1] is None  # it was left


def test_no_scene_of_a_recording_crosses_a_pause(shards: ShardSet, block_tokenizer: BlockTokenizer) -> None:
    rows = shards.episodes.to_pylist()
    state_pauses(shards.folder, *[{row["length"] // 3: 50, row["length"] // 3 + 1: 50} for row in rows])
    robot = RecordedRobot(ShardSet(shards.folder), lambda: block_tokenizer, shards.manifest.stats, "first")
    scene, frames = robot.scene(0), PROMPT_FRAMES
    while (step := scene.advance(None)) is not None:
        assert step[1] is not None
        frames += 1
    longest = max(row["length"] - row["length"] // 3 - 2 for row in rows)
    assert PROMPT_FRAMES < frames <= longest // shards.row_stride
    state_pauses(shards.folder, *[dict.fromkeys(range(row["length"]), 50) for row in rows])
    robot = RecordedRobot(ShardSet(shards.folder), lambda: block_tokenizer, shards.manifest.stats, "first")
    with pytest.raises(UsageError, match="has no episode longer than 4 frames without a pause"):
        robot.scene(0)


class StillWorld(TrueWorld):
    def open(self, embodiment: str, frames: Any, chunks: Any = None, *, seed: int = 0) -> int:
        self.begun.append((frames, chunks))
        return 0

    def image(self, session: int) -> np.ndarray:
        return np.zeros_like(self.begun[0][0][0])


def test_recorded_actions_that_nobody_knows_reach_the_model_as_unknown_and_nobody_else(
    shards: ShardSet, block_tokenizer: BlockTokenizer, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, world = (
        RecordedRobot(shards, lambda: block_tokenizer, shards.manifest.stats, "first"),
        StillWorld(),
    )
    robot.dimensions = tuple(replace(dim, kind="target") for dim in robot.dimensions)
    whole, windows, unknown = robot.scene(0), robot._windows, [2, 4]
    plain = windows.batch

    def masked(numbers: list[int]) -> Any:
        batch = plain(numbers)
        batch.action_mask[:, unknown] = False
        return batch

    monkeypatch.setattr(windows, "batch", masked)
    session = Session("s", robot, 0, robot.scene(0), world, Decoding(2, 0.0))
    np.testing.assert_array_equal(world.begun[0][1][:2], whole.prompt.chunks[:2])
    assert np.isnan(world.begun[0][1][2]).all()
    np.testing.assert_array_equal(session.held, whole.prompt.chunks[1, -3:])
    session.replays, shown = True, []
    session.viewer = SimpleNamespace(show=lambda frame, facts: shown.append(facts["action"]))  # type: ignore
    chunks = []
    for now in range(2):
        chunks.append(session.next_chunk())
        session.take(world.image(0), float(now), 0.0)
    assert np.isfinite(chunks[0]).all() and np.isnan(chunks[1]).all()
    assert shown == [chunks[0][-3:].tolist()] * 2 and session.held.tolist() == shown[0]
    assert np.isfinite(lerobot_episode(robot, session.film())[0].action).all()
    unknown[:] = [0, 1, 2]
    np.testing.assert_allclose(robot.scene(0).action, shards.manifest.stats["action"]["mean"], rtol=1e-6)


def test_new_scenes_come_to_every_window_once_before_any_comes_again() -> None:
    for count in range(1, 201):
        assert {number * apart(count) % count for number in range(count)} == {*range(count)}
        assert count < 16 or 0.35 < apart(count) / count < 0.65  # neighbours in number lie apart


def test_a_robot_without_simulator_and_shards_of_another_model_are_refused(shards) -> None:
    with pytest.raises(UsageError, match="does not know the robot toy_arm"):
        drivable(Checkpoint.open("embedded-fsq"), [shards], pytest.fail)


def test_a_robot_without_simulator_begins_from_its_sample_or_from_images(tmp_path: Path) -> None:
    save(tmp_path / "model", {"arm_a": 2, "arm_b": 2})
    opened = Checkpoint.open(tmp_path / "model")
    with pytest.raises(UsageError, match="none of its robots has a simulator .* — give shards of it"):
        drivable(opened, (), pytest.fail)
    rng = np.random.default_rng(0)
    images = rng.integers(0, 256, (6, 16, 16, 3), dtype=np.uint8)
    cells = list(images.repeat(8, axis=1).repeat(8, axis=2))
    sheet = png_bytes(grid([cells] * 3, ["truth", "predicted", "other"]))
    (opened.folder / "embodiments/arm_a/sample.png").write_bytes(sheet)
    (robot,) = drivable(opened, (), pytest.fail).values()
    scene = robot.scene(0)
    assert (robot.embodiment.id, robot.source) == ("arm_a", "images")
    assert np.array_equal(scene.prompt.frames, images[:1].repeat(PROMPT_FRAMES, axis=0))
    chunk = np.ones(robot.embodiment.chunk_dim, np.float32)
    assert scene.advance(chunk) == (chunk, None) and scene.advance(None) is None
    large = images[:2].repeat(2, axis=1).repeat(2, axis=2)
    robots = drivable(opened, (), pytest.fail, list(large))
    assert list(robots) == ["arm_a:images", "arm_b:images"]
    begun = robots["arm_b:images"].scene(1).prompt
    assert np.array_equal(begun.frames, images[:2]) and np.isnan(begun.chunks).all()
    with pytest.raises(UsageError, match="--prompt: its images differ in size — give images of one size"):
        drivable(opened, (), pytest.fail, [images[0], large[0]])


@pytest.mark.parametrize(
    ("camera", "cropped"),
    [
        ({}, True),  # the crop fits in the image
        ({"size": [24, 40]}, True),
        ({"size": [40, 24], "rotate": 90}, True),
        ({"size": [240, 400]}, False),  # it is of larger images
        ({"crop": [20, 2, 40, 20]}, False),
        ({"flip": "vertical", "color": "bgr"}, True),  # images are upright and RGB
    ],
)
def test_images_are_cropped_as_those_of_a_conversion(camera: dict[str, Any], cropped: bool) -> None:
    values = Embodiment.from_yaml(yaml("arm")).to_dict()
    values["cameras"][0] |= {"crop": [3, 2, 20, 20]} | camera
    images = np.random.default_rng(0).integers(0, 256, (2, 24, 40, 3), dtype=np.uint8)
    wanted = resize(images[:, 2:22, 3:23] if cropped else images, 16)
    assert np.array_equal(fitted(images, CONFIG, Embodiment.from_values(values, "an arm")), wanted)


def test_a_saved_dataset_names_the_cameras_that_the_model_shows(block_tokenizer, tmp_path) -> None:
    shards = ShardSet(three.three_shards(tmp_path, val_fraction=0))
    arm, stats = shards.embodiment, {"action": {"mean": [0.0, 0.0], "std": [1.0, 1.0]}}

    def saved(cameras: object) -> list[str]:
        robot = RecordedRobot(shards, lambda: block_tokenizer, stats, cameras)
        views = [np.full((16, 16, 3), 90 * view, np.uint8) for view in range(len(robot.cameras))]
        image, actions = jpeg(np.concatenate(views, axis=1)), np.zeros((arm.stride, 2), np.float32)
        state = np.zeros(3, np.float32)  # of which the robot's YAML knows nothing
        frames = [Frame(i, image, None, actions, state, None) for i in range(3)]
        episode, own = lerobot_episode(robot, frames)
        assert episode.state is None and own.state is None
        shown = [episode.pictures[camera.key] for camera in own.cameras]
        assert all(np.abs(np.stack(view) - 90.0 * i).max() < 3 for i, view in enumerate(shown))
        assert {len(view) for view in shown} == {3} and episode.hold == arm.stride == len(episode.action) // 3
        return [camera.name for camera in own.cameras]

    assert saved("first") == saved("drawn") == ["top"]
    assert saved("wrist") == ["wrist"] and saved(["side", "wrist"]) == ["side", "wrist"]


@pytest.mark.slow
@pytest.mark.parametrize("name", ["arm2_12", "pusht_slow"])
def test_a_saved_dataset_reads_as_what_was_driven(name: str, tmp_path: Path) -> None:
    (robot,) = lab_robots(name).values()
    world = TrueWorld()
    session, rng = (
        Session("s", robot, 0, robot.scene(0), world, Decoding(2, 0.0)),
        np.random.default_rng(0),
    )
    low, high = (np.array([getattr(dim, end) for dim in robot.dimensions]) for end in ("low", "high"))
    for now in range(5):
        session.held = rng.uniform(low, high).astype(np.float32)
        chunk = session.next_chunk()
        assert chunk is not None
        session.take(world.step({session.row: chunk})[session.row], float(now), 0.0)
    told: list[tuple[str, int, int]] = []
    data = film("lerobot", robot, session.film(), lambda *words: told.append(words))
    rows = 6 * robot.embodiment.stride
    assert [words for words, _ in groupby(words for words, *_ in told)] == [
        "loading lerobot", "writing frames", "encoding videos", "packing the files",
    ]  # fmt: skip
    assert [done for words, done, _ in told if words == "writing frames"] == [*range(rows + 1)]
    assert {total for *_, total in told} == {rows}
    with zipfile.ZipFile(io.BytesIO(data)) as archive:
        archive.extractall(tmp_path)
    own = Embodiment.load(tmp_path / name / "embodiment.yaml")
    source = open_source("lerobot")
    (identity,) = source.episode_ids(str(tmp_path / name))
    clip = to_clip(source.read(str(tmp_path / name), identity, own), own)
    stride = robot.embodiment.stride
    assert own.stride == stride and len(clip) == 6 * stride
    driven = np.concatenate([frame.actions for frame in session.frames])
    np.testing.assert_array_equal(clip.actions[: len(driven)], driven)
    assert clip.states is not None and clip.states.shape[1] == len(session.start.state)  # type: ignore[arg-type]
    shown = [clip.frames_at(camera.name, np.arange(0, len(clip), stride)) for camera in own.cameras]
    assert (
        len(shown) == 2 and np.abs(shown[0].astype(int) - shown[1]).mean() < 2
    )  # the world is without error
    newest = world.rows[session.row].picture()
    assert np.abs(shown[0][-1].astype(int) - newest).mean() < 4
