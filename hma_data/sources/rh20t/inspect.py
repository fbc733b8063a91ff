"""Inspect RH20T's scenes without an embodiment: cameras, tables, times, and what looks wrong."""

from pathlib import Path

import numpy as np

from hma_data.errors import HMAError
from hma_data.sources.common import checks
from hma_data.sources.common.inspection import Inspection, KeyInfo
from hma_data.sources.common.places import local_path, unfollowed
from hma_data.sources.common.survey import Survey, sampled
from hma_data.sources.rh20t.scenes import INSTRUCTION_FIELD, Film, Scene, scenes

MAX_LENGTHS = 1_000  # most scenes whose lengths are reported


def inspect(uri: str, episodes: int) -> Inspection:
    """See Source.inspect.

    Raises:
        SourceError: there is no scene.
    """
    found = scenes(uri)
    names = list(found)
    survey = Survey(len(names))
    for link in unfollowed(local_path(uri)):
        survey.note(link)
    keys: dict[str, KeyInfo] = {}
    lengths: list[int] = []
    told = ""
    chosen = sampled(len(names), episodes)
    pairs = max(1, checks.PAIRS // max(len(chosen), 1))
    for name in (names[i] for i in chosen):
        scene = Scene(found[name])
        survey.episode(name)
        try:
            lengths.append(_look(name, scene, keys, survey, pairs))
            told = told or scene.task(INSTRUCTION_FIELD)
        except HMAError as fault:
            survey.fault(name, fault)
    listed = tuple(survey.key(info) for info in keys.values())
    cameras = [info for info in listed if info.kind == "camera" and info.hz]
    return Inspection(
        format="rh20t",
        uri=uri,
        episodes=len(names),
        keys=listed,
        frames=sum(lengths) if len(lengths) == len(names) else None,
        lengths=tuple(lengths[:MAX_LENGTHS]),
        hz=cameras[0].hz if cameras else None,
        facts={
            "dataset": "RH20T",
            "rate": "measured from the cameras' timestamps" if cameras else "",
            "task": told or "no task_description.json in a folder above: episodes get no instruction",
        },
        looked_at=len(survey.looked),
        findings=survey.findings(listed),
        checks=survey.checks(),
    )


def _look(name: str, scene: Scene, keys: dict[str, KeyInfo], survey: Survey, pairs: int) -> int:
    """Hand a scene's times, numbers and some frames to the survey; return the frames of its first film."""
    first: np.ndarray | None = None
    for camera in scene.cameras:
        try:
            film = Film(scene, camera)
            table = film.file.table
            clock = survey.times(name, camera, film.timestamps, camera=True)
            size = (table.height, table.width, 3)
            info = KeyInfo(camera, "camera", size, "uint8", clock.hz, codec=table.codec, count=len(table))
            keys.setdefault(camera, info)
            indices = checks.choose(len(film.timestamps), pairs, table.keys[: len(film.timestamps)])
            for run in checks.runs(indices):
                survey.pictures(name, camera, film.frames(run), run, table.codec)
            if first is None:
                first = film.timestamps
            else:
                survey.skew(camera, checks.skew(film.timestamps, first), float(np.median(np.diff(first))))
            film.file.close()
        except HMAError as fault:
            survey.fault(name, fault, camera)
    for table_name in scene.tables:
        try:
            _table(name, scene, table_name, keys, survey)
        except HMAError as fault:
            survey.fault(name, fault, Path(table_name).name)
    return 0 if first is None else len(first)


def _table(name: str, scene: Scene, table: str, keys: dict[str, KeyInfo], survey: Survey) -> None:
    camera = next((one for one in scene.cameras if scene.fields(table, one)), "")
    for key in scene.fields(table, camera):
        _, values = scene.series(key, camera)
        info = KeyInfo(key, "vector", values.shape[1:], str(values.dtype), count=len(values))
        keys.setdefault(key, info)
        survey.numbers(name, key, values)
