"""Film gets actions: shards that verify and say that they are inferred, with their true error."""

import shutil
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from hma_data.conversion.job import convert
from hma_data.episodes.sheets import write_mp4
from hma_data.errors import EpisodeError, HMAError, OutputError, UsageError
from hma_data.lab import family, record
from hma_data.registry.embodiment import Embodiment
from hma_data.shards.reader import EpisodeReader, ShardSet
from hma_data.shards.schema import flag_counts, read_footer
from hma_data.shards.verify import verify
from hma_data.tokenizers.base import get_tokenizer
from hma_model.generation import commands as generation_commands
from hma_model.simulate import World, read_prompt
from hma_model.synthetic import film as film_module
from hma_model.synthetic import labels
from hma_model.synthetic.film import ShardFilm, read_film
from hma_model.synthetic.labels import explained_95, infer, label_actions
from tests.conftest import BlockTokenizer
from tests.data import cameras
from tests.model.shards import state_pauses
from tests.model.true_world import BlockLatents, tiny_model, trained_on

ROBOT = "rails_03"
KNOWN = labels.LabelError("s", "val", ("a",), (0.1,), (1.0,), (None,), 9)


@pytest.fixture(autouse=True)
def yaml(monkeypatch: pytest.MonkeyPatch) -> None:
    """Let the model, which is of no checkpoint, have the YAML of its robot."""
    monkeypatch.setattr(labels, "yaml_of", lambda model, name: family.embodiment(name))


@pytest.fixture(scope="module")
def world() -> World:
    return World(tiny_model(ROBOT, "inverse"), get_tokenizer("fsq-8"))


@pytest.fixture(scope="module")
def real(world: World, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("real")
    convert(family.embodiment(ROBOT), record(ROBOT, folder, 2), world.tokenizer, folder / "shards")
    return folder / "shards"


class Oracle:
    """An inference that knows the actions of the shards, and errs by a share of their deviation."""

    def __init__(self, film: ShardFilm, share: float) -> None:
        self.known, self.rng, self.share, self.calls = {}, np.random.default_rng(0), share, 0
        for number in range(len(film.episodes())):
            stored, actions, _ = film.labelled(number)
            self.known[stored.tobytes()] = actions[:-1]

    def __call__(self, model: Any, actions: Any, stored: np.ndarray) -> np.ndarray:
        self.calls += 1
        true = self.known[stored.tobytes()]
        return (true + self.share * true.std() * self.rng.normal(size=true.shape)).astype(np.float32)


@pytest.mark.slow
def test_labelled_shards_verify_and_say_what_they_are(world, real, tmp_path, monkeypatch) -> None:
    shards = ShardSet(real)
    knows = Oracle(ShardFilm(world, shards, shards.row_stride), 0.5)
    monkeypatch.setattr(labels, "infer", knows)
    out = tmp_path / "a folder"
    found = label_actions(real, out, ROBOT, checkpoint="", check=real, world=world)
    splits = [row["split"] for row in ShardSet(real).episodes.to_pylist()]
    assert knows.calls == (splits.count("val") or len(splits)) + len(splits)
    assert verify(out) == []
    assert found.error.explained == pytest.approx((0.75, 0.75), abs=0.2)
    made_by = found.manifest.plan["made_by"]
    assert made_by["inferred_actions"] is True and made_by["error"]["rmse"] == list(found.error.rmse)
    for shard in found.manifest.shards:
        assert read_footer(out / shard.path)[0].plan["made_by"] == made_by
    shards = ShardSet(out)
    assert "inferred" in shards.embodiment.provenance["recording"] and shards.manifest.frame_stride > 1
    reader = EpisodeReader(shards, shards.columns())
    shown = ShardFilm(world, ShardSet(real), ShardSet(real).row_stride)
    for row in shards.episodes.to_pylist():
        columns = reader.episode(row, shards.manifest.cameras[0])
        names = [episode.id for episode in shown.episodes()]
        stored, actions, _ = shown.labelled(names.index(row["id"]))
        np.testing.assert_array_equal(columns["tokens"].reshape(len(stored) - 1, 8, 8), stored[:-1])
        assert np.abs(columns["action"] - actions[:-1]).max() < 4 * actions.std()
        assert flag_counts(row["flags"])["inferred_actions"] == len(stored) - 1


def test_inference_reads_each_chunk_off_a_window_around_it(world: World) -> None:
    actions = world.action_spec(ROBOT)
    stored = np.random.default_rng(0).integers(0, 8**6, (11, 8, 8))
    made, width = infer(world.model, actions, stored), world.model.config.frames
    tokens = torch.from_numpy(stored.astype(np.int64))
    for number, start in enumerate([0, 0, 0, 2, 2, 4, 4, 6, 7, 7]):
        window = tokens[None, start : start + width]
        read = world.model.predict_actions(window, ROBOT, readout="inverse")[0, number - start]
        np.testing.assert_allclose(made[number], actions.clip(read.numpy().reshape(-1, 2)).ravel(), atol=1e-3)
    assert len(made) == 10


def test_the_variance_explained_has_an_interval_over_recordings() -> None:
    rng = np.random.default_rng(0)
    level, values = np.repeat(rng.uniform(0.1, 0.9, 20), 10)[:, None], rng.normal(size=(200, 1))
    misses = level * rng.normal(size=(200, 1))
    ((low, high),), (apart,) = (explained_95(misses, values, np.arange(200) // n) for n in (10, 1))
    share = 1 - np.square(misses).mean() / values.var()
    assert low < share < high and high - low > 1.2 * (apart[1] - apart[0])
    assert explained_95(misses, values, np.zeros(200)) == (None,)


@pytest.mark.slow
def test_labels_no_better_than_the_mean_are_refused(world: World, real: Path, tmp_path: Path) -> None:
    with pytest.raises(HMAError, match="are no better than their mean on labelled video"):
        label_actions(real, tmp_path / "out", ROBOT, checkpoint="run", world=world, check=real)
    assert not (tmp_path / "out").exists()


def film(folder: Path) -> np.ndarray:
    levels = np.linspace(20, 230, 30).astype(np.uint8)
    write_mp4(folder / "long.mp4", [np.full((96, 128, 3), level, np.uint8) for level in levels], 30)
    return levels


def test_what_cannot_be_labelled_is_refused(world: World, tmp_path: Path) -> None:
    def run(place: Path = tmp_path, **given: Any) -> None:
        given = {"checkpoint": "run", "world": world} | given
        label_actions(place, tmp_path / "out", ROBOT, **given)

    film(tmp_path)
    with pytest.raises(HMAError, match="run: was not trained to infer actions, but for forward"):
        run(world=World(tiny_model(ROBOT), get_tokenizer("fsq-8")))
    with pytest.raises(UsageError, match="it has no labelled recordings here — .*--check SHARDS"):
        run()
    (tmp_path / "empty").mkdir()
    with pytest.raises(UsageError, match="empty: is neither a shard set nor a folder with video files"):
        run(tmp_path / "empty")
    with pytest.raises(UsageError, match="nothing: does not exist — give a folder of .mp4"):
        run(tmp_path / "nothing", world=None, checkpoint="no such checkpoint")  # the film is looked at first
    (tmp_path / "out").write_text("")
    with pytest.raises(OutputError, match="out: cannot be written"):
        run()


def test_video_files_are_taken_at_the_rate_of_the_model(world: World, tmp_path: Path) -> None:
    levels = film(tmp_path)
    (found,) = read_film(world, tmp_path, ROBOT, 10.0)
    assert (found.id, found.group, found.instruction) == ("long", "", "")
    shown = world.tokenizer.decode(found.frames()).mean(axis=(1, 2, 3))
    assert len(shown) == 10 and np.abs(shown - levels[::3]).max() < 12
    shutil.copy(tmp_path / "long.mp4", tmp_path / "long.mov")
    assert [one.id for one in read_film(world, tmp_path, ROBOT, 10.0)] == ["long", "long.mp4"]


def test_a_video_whose_clock_jumps_is_refused(world: World, tmp_path: Path, monkeypatch) -> None:
    film(tmp_path)
    monkeypatch.setattr(film_module, "frame_table", lambda file: SimpleNamespace(times=np.array([0.0, 1e6])))
    (found,) = read_film(world, tmp_path, ROBOT, 10.0)
    with pytest.raises(EpisodeError, match="has 2 frames in 1,000,000 s"):
        found.frames()


@pytest.mark.slow
def test_film_that_cannot_be_read_goes_to_quarantine(world, real, tmp_path, monkeypatch) -> None:
    places = tmp_path / "film of a day"
    places.mkdir()
    film(places)
    whole = (places / "long.mp4").read_bytes()
    (places / "cut.mp4").write_bytes(whole[: len(whole) // 2])
    (places / "none.mp4").write_bytes(b"")
    write_mp4(places / "one.mp4", [np.zeros((96, 128, 3), np.uint8)], 10)
    monkeypatch.setattr(labels, "measure", lambda *_: KNOWN)
    found = label_actions(places, tmp_path / "out", ROBOT, checkpoint="", check=real, world=world)
    assert found.manifest.quarantined == 3 and verify(tmp_path / "out") == []
    said = (tmp_path / "out" / "quarantine.jsonl").read_text()
    assert "cut.mp4" in said and "none.mp4" in said and "one: has fewer than two frames" in said
    assert [row["id"] for row in ShardSet(tmp_path / "out").episodes.to_pylist()] == ["long"]


def grey(folder: Path, **levels: int) -> None:
    folder.mkdir(exist_ok=True)
    for name, level in levels.items():
        write_mp4(folder / f"{name}.mp4", [np.full((128, 128, 3), level, np.uint8)] * 8, 10)


def shown(world: World, out: Path) -> dict[str, int]:
    shards = ShardSet(out)
    reader, found = EpisodeReader(shards, shards.columns()), {}
    for row in shards.episodes.to_pylist():
        tokens = reader.episode(row, shards.manifest.cameras[0])["tokens"]
        found[row["id"]] = int(world.tokenizer.decode(shards.tokens(tokens)).mean().round(-1))
    return found


def test_film_that_has_grown_or_changed_is_never_taken_for_what_was_labelled(world, tmp_path, monkeypatch):
    monkeypatch.setattr(labels, "measure", lambda *_: KNOWN)
    monkeypatch.setattr(labels, "_check_set", lambda *_: None)
    labelled = list[int]()

    def infer_and_count(*given: Any) -> np.ndarray:
        labelled.append(1)
        return infer(*given)

    def stop(done: float, words: str, total: float) -> None:
        if done == 2:
            raise KeyboardInterrupt

    def run(**given: Any) -> int:
        before = len(labelled)
        label_actions(tmp_path / "film", tmp_path / "out", ROBOT, checkpoint="", world=world, **given)
        return len(labelled) - before

    monkeypatch.setattr(labels, "infer", infer_and_count)
    grey(tmp_path / "film", b=60, c=200, d=160)
    with pytest.raises(KeyboardInterrupt):
        run(on_progress=stop)
    grey(tmp_path / "film", a=120, c=20)  # one is added, and a labelled one is another
    assert run() == 3  # b was labelled before
    assert shown(world, tmp_path / "out") == {"a": 120, "b": 60, "c": 20, "d": 160}
    assert run() == 0
    grey(tmp_path / "film", e=90)
    with pytest.raises(OutputError, match="out: holds another shard set — choose another folder"):
        run()


@pytest.fixture(scope="module", params=[BlockTokenizer, BlockLatents])
def three(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> ShardSet:
    return ShardSet(cameras.three_shards(tmp_path_factory.mktemp("three"), request.param()))


@pytest.mark.parametrize(
    ("views", "seen"),
    [
        ("first", ["top"]),
        ("drawn", ["top"]),
        ("wrist", ["wrist"]),
        (["wrist"], ["wrist"]),
        (["side", "top"], ["side", "top"]),
    ],
)
def test_film_shows_the_cameras_that_the_model_was_trained_on(three, views, seen, tmp_path) -> None:
    world = trained_on(views, three, tmp_path / "model")
    film = ShardFilm(world, three, three.row_stride)
    stored = film.stored(1)
    red = stored[:, 0] % 16 if three.spec.kind == "continuous" else stored % 16
    for view, name in enumerate(seen):
        assert (red[:, 8 * view : 8 * view + 8] == 1 + 4 * list(cameras.SIZES).index(name)).all()
    place = {"shards": three.folder, "episode": 1, "frames": len(stored) - 1}
    frames, chunks = read_prompt(world.model, three.embodiment.id, place)
    np.testing.assert_array_equal(frames, stored[:-1])
    np.testing.assert_array_equal(chunks, film.labelled(1)[1][: len(frames) - 1])


@pytest.mark.parametrize("three", [BlockTokenizer], indirect=True)
def test_film_that_pauses_is_labelled_in_parts(three: ShardSet, tmp_path: Path) -> None:
    world, row = trained_on("first", three, tmp_path / "model"), three.episodes.to_pylist()[0]
    paused = shutil.copytree(three.folder, tmp_path / "paused")
    state_pauses(paused, {4: 90})
    whole, film = (ShardFilm(world, shards, 2) for shards in (three, ShardSet(paused)))
    found = [(episode.id, episode.group) for episode in film.episodes()]
    assert found[:2] == [(f"{row['id']}_from_{start}", row["id"]) for start in (0, 5)]
    assert len(found) == len(whole.episodes()) + 1
    stored, actions, known = film.labelled(0)
    np.testing.assert_array_equal(stored, whole.labelled(0)[0][:3])
    assert len(actions) == 3 and known.tolist() == [True, True, False]
    assert len(film.stored(1)) == -(-(row["length"] - 5) // 2)


@pytest.mark.parametrize("views", ["wrist", ["side", "top"]])
@pytest.mark.parametrize("three", [BlockTokenizer], indirect=True)
def test_labelled_shards_name_the_cameras_that_their_images_are_of(three, views, tmp_path, monkeypatch):
    monkeypatch.setattr(labels, "yaml_of", generation_commands.yaml_of)
    monkeypatch.setattr(labels, "measure", lambda *_: KNOWN)
    world: Any = World(trained_on(views, three, tmp_path / "model", "inverse").model, BlockTokenizer())
    given: Any = {"checkpoint": "", "check": three.folder, "world": world}
    label_actions(three.folder, tmp_path / "out", three.embodiment.id, **given)
    made = ShardSet(tmp_path / "out")
    names = [views] if isinstance(views, str) else views
    assert made.manifest.cameras == names and verify(tmp_path / "out") == []
    reader, row = EpisodeReader(made, made.columns(names)), made.episodes.to_pylist()[0]
    for name in names:
        (tokens,) = (value for key, value in reader.episode(row, name).items() if key == "tokens")
        assert (tokens % 16 == 1 + 4 * list(cameras.SIZES).index(name)).all()


def test_films_of_one_camera_are_refused_by_a_model_of_several(three: ShardSet, tmp_path: Path) -> None:
    world = trained_on(["side", "top"], three, tmp_path / "model")
    (tmp_path / "film").mkdir()
    (tmp_path / "film" / "a.mp4").touch()
    with pytest.raises(UsageError, match="has videos of one camera, but the model sees 2 at once"):
        read_film(world, tmp_path / "film", three.embodiment.id, 5.0)


@pytest.mark.parametrize("views", ["nose", ["nose"]])
def test_film_of_the_robot_without_the_models_camera_is_refused(three, views, tmp_path) -> None:
    world = trained_on(views, three, tmp_path / "model")
    with pytest.raises(UsageError, match="three_hdf5 has the cameras top, wrist, side in .* not nose"):
        ShardFilm(world, three, three.row_stride)
    values = cameras.arm().to_dict()
    people = Embodiment.from_values(values | {"id": "people", "cameras": values["cameras"][:1]}, "people")
    recording = cameras.write_hdf5(tmp_path / "people.hdf5")
    convert(people, recording, BlockTokenizer(), tmp_path / "people")
    film = ShardFilm(world, ShardSet(tmp_path / "people"), three.row_stride, three.embodiment.id)
    assert film.cameras == ["top"]
