"""Inspect RH20T's scenes without an embodiment: cameras, tables, times, and what looks wrong."""

from functools import partial

from hma_data.sources.common.inspection import Inspection, KeyInfo
from hma_data.sources.common.places import local_path, unfollowed
from hma_data.sources.common.survey import Series, Survey
from hma_data.sources.rh20t.scenes import INSTRUCTION_FIELD, Film, Scene, scenes


def inspect(uri: str, episodes: int) -> Inspection:
    """See Source.inspect.

    Raises:
        SourceError: there is no scene.
    """
    found = scenes(uri)
    survey = Survey(len(found))
    for link in unfollowed(local_path(uri)):
        survey.note(link)
    lengths: list[int] = []
    told = ""
    for name in survey.sample(list(found), episodes):
        scene = Scene(found[name])
        keys = {camera: partial(_film, scene, camera) for camera in scene.cameras}
        for table in scene.tables:
            with survey.reading(name, table):
                camera = next((one for one in scene.cameras if scene.fields(table, one)), "")
                keys |= {key: partial(_numbers, scene, key, camera) for key in scene.fields(table, camera)}
        lengths.append(survey.look(name, keys))
        with survey.reading(name):
            told = told or scene.task(INSTRUCTION_FIELD)
    hz = next((survey.rate(key) for key, info in survey.infos.items() if info.kind == "camera"), None)
    facts = {
        "dataset": "RH20T",
        "rate": "measured from the cameras' timestamps" if hz else "",
        "task": told or "no task_description.json in a folder above: episodes get no instruction",
    }
    return survey.inspection("rh20t", uri, survey.infos.values(), lengths, facts, hz=hz)


def _film(scene: Scene, camera: str) -> Series:
    film = Film(scene, camera)
    table, count = film.file.table, len(film.timestamps)
    size = (table.height, table.width, 3)
    info = KeyInfo(camera, "camera", size, "uint8", codec=table.codec, count=len(table))
    starts = table.keys[:count]
    return Series(None, film.frames, count, starts, table.codec, film.timestamps, info)


def _numbers(scene: Scene, key: str, camera: str) -> Series:
    _, values = scene.series(key, camera)
    info = KeyInfo(key, "vector", values.shape[1:], str(values.dtype), count=len(values))
    return Series(lambda: values, info=info)
