"""What `hma bench holds` says of objects that stay, turn, melt, or lie elsewhere."""

from dataclasses import replace

import h5py
import numpy as np
import pytest

from hma_data.errors import UsageError
from hma_data.lab import pusht
from hma_data.lab.simulator import embodiment
from hma_model.evaluation.wholeness import Left, left_at, left_words, palettes
from recipes.bench import holds
from recipes.lab import pushes

RED, BLUE, GREY = (200, 20, 20), (20, 20, 200), (230, 230, 230)
SIDE, FRAMES = 64, 3


def scene(places: list[tuple[int, int]], bar: bool = True) -> np.ndarray:
    """A film (1, T, S, S, 3) of a red L at these places (x, y), and of a blue robot that rests."""
    film = np.full((1, len(places), SIDE, SIDE, 3), GREY, np.uint8)
    film[:, :, 50:58, 50:58] = BLUE
    for frame, (x, y) in enumerate(places):
        film[0, frame, y : y + 16, x : x + 4] = RED
        if bar:
            film[0, frame, y + 12 : y + 16, x : x + 12] = RED
    return film


def found(made: np.ndarray, places: list[tuple[int, int]]) -> holds.Found:
    loose = np.array(places, float) + 1
    own = np.broadcast_to((54.0, 54.0), loose.shape)
    parts = np.stack([own, loose], axis=1)[None] * 2  # px of 128
    return holds.Found("toy", scene(places), made, parts, driven=1)


PLACES = [(5, 5), (12, 9), (25, 20)]


def row(made: np.ndarray) -> dict[str, float]:
    return holds._row(found(made, PLACES), FRAMES - 1)


def test_a_film_that_is_the_truth_holds_in_every_figure() -> None:
    truth = row(scene(PLACES))
    assert (truth["left"], truth["limbs"], truth["shape"], truth["off"], truth["overlap"]) == (1, 1, 1, 0, 1)
    assert truth["moved"] == 1 and truth["repeat"] == 0 and truth["static_db"] == 99
    assert truth["left_whole"] == truth["limbs_whole"] == 1


def test_an_object_that_lies_elsewhere_keeps_its_shape_and_is_off() -> None:
    made = row(scene([PLACES[0]] * FRAMES))
    assert made["shape"] == 1 and made["left"] == 1 and made["overlap"] == 0
    assert made["off"] == pytest.approx(1, abs=0.01)  # it is left where it was


def test_an_object_that_is_turned_keeps_its_shape_and_one_that_lost_a_limb_does_not() -> None:
    turned = scene(PLACES)
    turned[0, -1] = np.rot90(turned[0, -1], axes=(0, 1))
    assert row(turned)["shape"] > 0.9
    limb = row(scene(PLACES, bar=False))
    assert limb["shape"] < 0.75 and limb["left"] == pytest.approx(64 / 96, abs=0.01)
    assert limb["left_whole"] == 0 and limb["limbs_whole"] == 1


def test_what_is_left_is_said_with_whether_it_stays_whole() -> None:
    whole = left_at(found(scene(PLACES), PLACES), FRAMES - 1)
    assert whole == {"the robot": Left(1.0, 1.0, 1.0), "loose objects": Left(1.0, 1.0, 1.0)}
    assert left_words(whole).endswith("100% of loose objects left (100% whole, shape overlap 100%); intact")
    torn = left_at(found(scene(PLACES, bar=False), PLACES), FRAMES - 1)
    assert torn["the robot"].intact and not torn["loose objects"].intact
    assert left_words(torn).endswith("damaged: loose objects")
    many = left_at(found(np.roll(scene(PLACES), 1, axis=-1), PLACES), FRAMES - 1)  # other colours
    assert many["the robot"] == Left(0.0, 0.0, 0.0)


def test_an_object_that_is_lost_and_one_that_is_doubled_are_not_whole_though_their_mean_is() -> None:
    lost, doubled = scene(PLACES), scene(PLACES)
    lost[..., :40, :40, :] = GREY
    doubled[:, -1, :16, 40:56] = doubled[:, -1, 20:36, 25:41]
    one = found(scene(PLACES), PLACES)
    two = {name: np.concatenate([getattr(one, name)] * 2) for name in ("true", "parts")}
    loose = left_at(replace(one, made=np.concatenate([lost, doubled]), **two), FRAMES - 1)["loose objects"]
    assert (loose.share, loose.whole) == (1, 0) and not loose.intact


def test_two_places_of_one_object_are_one_object_though_one_lies_on_its_edge() -> None:
    shaded = scene(PLACES)
    for frame, (x, y) in enumerate(PLACES):
        shaded[0, frame, y + 12 : y + 16, x : x + 12] = (180, 20, 20)
    corner = np.array(PLACES, float) + 1
    foot = np.array(PLACES, float) + np.array([9, 14])
    own = np.broadcast_to((54.0, 54.0), corner.shape)
    parts = np.stack([own, corner, foot], axis=1)[None] * 2
    judged = holds._row(holds.Found("toy", shaded, scene(PLACES), parts, driven=1), FRAMES - 1)
    assert (judged["moved"], judged["overlap"], judged["shape"], judged["left"]) == (1, 1, 1, 1)


def test_an_objects_color_is_not_that_of_a_place_at_its_edge() -> None:
    blended = scene(PLACES)
    for frame, (x, y) in enumerate(PLACES):
        blended[0, frame, y, x : x + 4] = (205, 40 + 5 * frame, 40 + 5 * frame)
    edge, inside = np.array(PLACES, float), np.array(PLACES, float) + 2
    parts = np.stack([np.full_like(edge, 54), edge, inside], axis=1)[None] * 2
    _, loose = palettes(holds.Found("toy", blended, blended, parts, driven=1))
    np.testing.assert_array_equal(loose, [RED])


def test_what_melted_or_what_nobody_touched_is_told() -> None:
    gone = scene(PLACES)
    gone[gone == RED[0]] = GREY[0]
    gone[0, -1][(scene(PLACES)[0, -1] == RED).all(-1)] = GREY
    melted = row(gone)
    assert melted["left"] == 0 and melted["shape"] == 0 and melted["off"] is None
    darker = scene(PLACES)
    darker[0, -1, :4] -= 40
    assert row(darker)["static_db"] < 30 and row(darker)["left"] == 1


def test_a_robot_without_a_simulator_is_named() -> None:
    with pytest.raises(UsageError, match="bridge: has no simulator in the toolkit"):
        holds.run({**holds.BENCH.defaults, "robots": "bridge"})


@pytest.mark.parametrize("way", pushes.MIRRORS)
def test_a_mirrored_episode_shows_the_disc_where_it_is(way: tuple[bool, bool, bool]) -> None:
    demo = pushes.contact_demo(912, 0)
    seen = pushes.mirrored(demo, *way)
    for one in (demo, seen):
        images, places = one.observations["image"], (one.observations["agent_pos"] * pusht.PX).astype(int)
        shown = {tuple(image[y, x]) for image, (x, y) in zip(images, places, strict=True)}
        assert shown == {(78, 126, 255)}
    assert np.ptp(seen.actions, axis=0) == pytest.approx(np.ptp(demo.actions, axis=0)[:: -1 if way[0] else 1])
    if not way[0] or way[1] == way[2]:  # these are their own inverses
        again = pushes.mirrored(seen, *way)
        assert np.array_equal(again.observations["image"], demo.observations["image"])
        np.testing.assert_allclose(again.actions, demo.actions, atol=1e-3)


def test_contact_episodes_are_those_of_the_recording_with_the_places_of_the_parts(tmp_path) -> None:
    pushes.record_contact(tmp_path / "part.hdf5", range(1), seed=912)
    episode = pushes.contact_episode(20, 2, seed=912, episode=0)
    with h5py.File(tmp_path / "part.hdf5") as file:
        demo = file["data/demo_0"]
        np.testing.assert_array_equal(demo["obs/image"][:40:2], episode.pictures)
        np.testing.assert_array_equal(demo["actions"][:40].reshape(20, 4), episode.chunks)
    places = episode.parts.round().astype(int)
    disc, tee = (
        {tuple(frame[y, x]) for frame, (x, y) in zip(episode.pictures, places[:, part], strict=True)}
        for part in (0, 1)
    )
    assert len(disc) == 1 and disc != tee


def test_contact_is_of_one_robot_and_as_long_as_its_recording() -> None:
    with pytest.raises(UsageError, match="driver=contact is of pusht_fast, not of arm1_02"):
        holds.run(holds.BENCH.defaults | {"driver": "contact", "robots": "arm1_02"})
    with pytest.raises(UsageError, match="has 50 frames an episode, not 51"):
        pushes.contact_episode(51, 2, seed=0, episode=0)


@pytest.mark.parametrize("robot", ["mover_04", "pusht_fast"])
def test_keys_are_held_at_an_end_or_in_the_middle_of_each_action(robot: str) -> None:
    e = embodiment(robot)
    held = round(holds.HELD_S * e.rate_hz)
    actions = holds.held_keys(robot, 10 * held + 1, seed=3, number=1)
    assert (
        len(actions) == 10 * held + 1
        and not np.diff(actions[: 10 * held].reshape(10, held, -1), axis=1).any()
    )
    ranges = np.array([part.range for part in e.action.components for _ in range(part.dims)])
    kinds = (actions - ranges[:, 0]) / np.ptp(ranges, axis=1)
    assert set(np.unique(kinds)) == {0, 0.5, 1}
