"""Read embodiments: one robot as one dataset recorded it, described by one YAML of the registry.

The YAML decides everything else: the keys that a converter reads, the stride, the width of stem and head,
and the name under which something is published. Nothing is guessed: a YAML states what is unknown.

A action dims, K = stride * A values of an action chunk.
"""

import json
import math
import os
import re
from collections.abc import Sequence
from functools import cached_property
from typing import TYPE_CHECKING, Any, Literal, Self

from pydantic import BaseModel, Field, ValidationError, ValidationInfo, field_validator

from hma_data.errors import RegistryError, meant
from hma_data.registry.components import (
    LAYOUTS,
    Action,
    Camera,
    Component,
    Count,
    Marker,
    Number,
    Quality,
    Segments,
    SourceSpec,
    SpecModel,
    Sync,
    Vector,
)
from hma_data.registry.folders import file_id, registry_files, registry_folders
from hma_data.storage.files import short_sha256
from hma_data.storage.kinds import misplaced
from hma_data.storage.paths import StrPath, as_path, as_text
from hma_data.storage.yaml_io import Problem, parse_yaml, plain_fault, read_yaml, write_yaml

if TYPE_CHECKING:  # `hma registry list` needs no numpy
    from hma_data.arrays import Bools

FIRST_CAMERA = "first"  # stands for the first camera of a set, whatever its name
ID_PATTERN = re.compile(r"[a-z0-9][a-z0-9_.-]{0,99}")
TODO = "TODO"
WITHOUT_STEPS = {"rosbag": "a bag has times", "rh20t": "RH20T has times (keys may end in /next)"}
ONE_INDEX = ("rlds", "hdf5", "lerobot")  # formats in which frame i, action i and state i belong together
# The fields that decide the content of shards. target_hz and stride act later, when windows are drawn.
_DECIDES: Any = {
    "id": True,
    "kind": True,
    "frequency_hz": True,
    "action": True,
    "state": True,
    "cameras": {"__all__": {"name", "key", "color", "resize", "rotate", "flip", "crop", "stamp", "levels"}},
    "sync": True,
    "source": {"format", "instruction", "layout", "segments"},
    "quality": True,
}


class Embodiment(SpecModel):
    """A robot as one dataset recorded it. Frozen; made from YAML by `load` or `find`."""

    id: str = Field(description="name of the robot's file, <id>.yaml")
    description: str = Field("", description="one line about the recordings")
    robot: str | None = Field(None, description="name of the robot")
    kind: Literal["real", "simulation", "human"] = Field(description="who or what was recorded")
    frequency_hz: Number | Literal["unknown"] | None = Field(
        description="control rate in Hz, or unknown; null only if the recordings have timestamps"
    )
    target_hz: Number = Field(
        2.0, ge=0.001, le=100_000, description="frame rate of the model; determines the stride"
    )
    stride_override: Count | None = Field(
        None, alias="stride", ge=1, description="recorded steps from one frame of the model to the next"
    )
    action: Action = Field(description="the action vector at each step")
    state: Vector | None = Field(None, description="the robot's own measurements")
    cameras: tuple[Camera, ...] = Field(min_length=1, description="cameras; the first is the default")
    sync: Sync = Field(Sync(), description="alignment of streams of different rates")
    source: SourceSpec = Field(description="location and format of the recordings")
    quality: Quality = Field(Quality(), description="rules for episodes with blank or still images")
    stats_key: str | None = Field(
        None, description="robots with the same key and control mode share statistics and stem"
    )
    license: str | None = Field(None, description="license of the recordings, with its source")
    provenance: dict[str, str] = Field(default_factory=dict, description="key of this file -> its source")
    notes: str | None = Field(None, description="notes for other users")

    @field_validator("id")
    @classmethod
    def _id_is_a_name(cls, value: str) -> str:
        if not ID_PATTERN.fullmatch(value) or ".." in value:
            raise ValueError("must be 1 to 100 of a-z 0-9 _ - . and begin with a letter or digit")
        return value

    @field_validator("frequency_hz", mode="before")
    @classmethod
    def _rate_is_a_number(cls, value: Any) -> Any:
        if isinstance(value, str) and value != "unknown":  # else one fault for each kind of value
            try:
                return float(value)
            except ValueError:
                raise ValueError("must be a number of Hz without a unit, or unknown") from None
        return value

    @field_validator("frequency_hz")
    @classmethod
    def _rate_positive(cls, value: float | str | None) -> float | str | None:
        if isinstance(value, float) and not 0 < value <= 100_000:
            raise ValueError("must lie between 0 and 100000 Hz")
        return value

    @field_validator("cameras")
    @classmethod
    def _names_differ(cls, value: tuple[Camera, ...]) -> tuple[Camera, ...]:
        names = [camera.name for camera in value]
        if len(set(names)) != len(names):
            raise ValueError(f"two cameras have the same name: {', '.join(names)}")
        return value

    @field_validator("sync")
    @classmethod
    def _sync_fits(cls, value: Sync, info: ValidationInfo) -> Sync:
        names = [camera.name for camera in info.data.get("cameras", ())]
        if value.primary and names and value.primary not in names:
            raise ValueError(f"primary {value.primary!r} is not one of: {', '.join(names)}")
        return value

    @field_validator("source")
    @classmethod
    def _source_fits(cls, value: SourceSpec, info: ValidationInfo) -> SourceSpec:
        sync = info.data.get("sync")
        if sync and sync.action_shift and value.format in WITHOUT_STEPS:
            said = WITHOUT_STEPS[value.format]
            raise ValueError(f"{said} instead of steps, which sync.action_shift counts")
        if sync and sync.rate_hz and value.format in ONE_INDEX:
            raise ValueError(
                f"frames of format {value.format} are not resampled to sync.rate_hz, which is for bags and "
                "videos of hands; remove it: frequency_hz states the recording's rate, target_hz what the "
                "model sees"
            )
        return value

    # -- derived facts

    @property
    def action_dim(self) -> int:
        """Return A, the width of one action."""
        return self.action.dims

    @property
    def components(self) -> tuple[Component, ...]:
        """Return the components of the action, then those of the state."""
        return self.action.components + (self.state.components if self.state else ())

    @property
    def states_rate(self) -> bool:
        """Return whether the YAML states the rate of the grid."""
        return bool(self.sync.rate_hz) or isinstance(self.frequency_hz, float)

    @property
    def rate_hz(self) -> float:
        """Return the rate of the grid in Hz.

        Raises:
            RegistryError: the YAML does not state it.
        """
        if self.sync.rate_hz:
            return self.sync.rate_hz
        if isinstance(self.frequency_hz, float):
            return self.frequency_hz
        stated = self.provenance.get("frequency_hz", "not stated")
        fault = "is null" if self.source.format in ONE_INDEX else "is null, and so is sync.rate_hz"
        if self.frequency_hz:
            fault = f"is unknown ({stated})"
        raise RegistryError(
            f"embodiment {self.id}: frequency_hz",
            fault,
            f"set frequency_hz in a copy of the YAML (hma registry show {self.id} > {self.id}.yaml), "
            "or give hma convert --frequency-hz HZ",
        )

    def with_rate(self, hz: float) -> "Embodiment":
        """Return a copy whose unknown rate is `hz`; a shard set made with it states that rate.

        Raises:
            RegistryError: the YAML states another rate, or `hz` is not a valid rate.
        """
        where = f"embodiment {self.id}: frequency_hz"
        if self.frequency_hz not in ("unknown", hz):
            stated = "null" if self.frequency_hz is None else f"{self.frequency_hz:g}"
            fault = f"is {stated}, not {hz:g}"
            raise RegistryError(where, fault, "correct it in a copy of the YAML")
        provenance = self.provenance | {"frequency_hz": "given at the conversion"}
        return Embodiment.from_values(self.to_dict() | {"frequency_hz": hz, "provenance": provenance}, where)

    @property
    def stride(self) -> int:
        """Return the recorded steps per frame of the model's grid: max(1, rate / target rounded half up)."""
        return self.stride_override or max(1, math.floor(self.rate_hz / self.target_hz + 0.5))

    @property
    def effective_hz(self) -> float:
        """Return the rate of the model's frames in Hz."""
        return self.rate_hz / self.stride

    @property
    def chunk_dim(self) -> int:
        """Return K = stride * A, the width of an action chunk."""
        return self.stride * self.action_dim

    @property
    def primary_camera(self) -> Camera:
        """Return the camera whose frames are the grid."""
        return self.camera(self.sync.primary or self.cameras[0].name)

    def camera(self, name: str) -> Camera:
        """Return the camera of that name.

        Raises:
            RegistryError: there is none.
        """
        for camera in self.cameras:
            if camera.name == name:
                return camera
        known = ", ".join(camera.name for camera in self.cameras)
        raise RegistryError(f"embodiment {self.id}", f"has no camera {name!r}", f"its cameras: {known}")

    def with_cameras(self, names: Sequence[str]) -> Self:
        """Return a copy with these cameras alone, and with the one whose frames are the grid."""
        needed = {*names, self.sync.primary}
        if self.source.format not in ONE_INDEX:
            needed.add(self.primary_camera.name)
        kept = tuple(camera for camera in self.cameras if camera.name in needed)
        return self if kept == self.cameras else self.model_copy(update={"cameras": kept})

    @property
    def normalize_mask(self) -> "Bools":
        """Return (A,) bool, True where the model normalizes the value."""
        import numpy as np

        components = self.action.components
        return np.repeat([c.normalize for c in components], [c.dims for c in components])

    @cached_property
    def digest(self) -> str:
        """Return sixteen hex digits over the fields that decide the shards' content (no texts, no URI)."""
        content = self.model_dump(mode="json", exclude_defaults=True, include=_DECIDES)
        return short_sha256(json.dumps(content, sort_keys=True))

    # -- YAML

    def to_dict(self) -> dict[str, Any]:
        """Return plain values in the YAML's form, without those at their defaults."""
        return self.model_dump(mode="json", by_alias=True, exclude_defaults=True)

    def to_yaml(self) -> str:
        """Return YAML text from which the same embodiment can be loaded."""
        return write_yaml(self.to_dict())

    @classmethod
    def from_yaml(cls, text: str, where: str = "embodiment.yaml") -> "Embodiment":
        """Return the embodiment of a YAML text; see `load`."""
        return cls.from_values(parse_yaml(text, where), where)

    @classmethod
    def load(cls, path: StrPath) -> "Embodiment":
        """Return the embodiment of a YAML file.

        Args:
            path: str or path of the YAML.

        Raises:
            RegistryError: the file has problems; the error lists them all, each with YAML path, value and
                what is allowed.
        """
        file = as_path(path)
        return cls.from_values(read_yaml(file), str(file))

    @classmethod
    def from_values(cls, values: Any, where: str) -> "Embodiment":
        """Return the embodiment of a YAML's plain values; see `load`."""
        robot, found = judged(values)
        if robot is None:
            said, remedy = "; ".join(map(str, found)), "hma registry schema prints what is allowed"
            if all(": still TODO" in str(problem) for problem in found):
                said = f"still to be answered: {', '.join(path for path, _ in todos(values))}"
                remedy = "write answers in place of the TODOs in the file"
            raise RegistryError(where, said, remedy)
        return robot


def judged(values: Any) -> tuple[Embodiment | None, list[Problem]]:
    """Return the embodiment of a YAML's plain values, or None and all problems."""
    if not isinstance(values, dict):
        said = {"NoneType": "is empty", "list": "is a list"}.get(type(values).__name__, "is a single value")
        said = f"must be a mapping of keys to values, {said}"
        return None, [Problem("", said, allowed=", ".join(_keys(Embodiment)))]
    robot, questions = None, todos(values)
    found = [Problem(path, f"still {TODO}: {text}") for path, text in questions]
    try:
        robot = Embodiment.model_validate(values)
        found += _rate_problem(robot)
    except ValidationError as fault:
        asked = {path for path, _ in questions}
        for item in fault.errors(include_url=False):
            path = _yaml_path(item["loc"], values, missing=item["type"] == "missing")
            follows = item["type"] == "too_short" and item["input"]  # pydantic leaves out the wrong items
            if path not in asked and not follows:
                found.append(_problem(path, item, values))
    return None if found else robot, list(dict.fromkeys(found))


def _rate_problem(robot: Embodiment) -> list[Problem]:
    """Return what is wrong with a rate that is null: nothing where times and stride are known without it."""
    if robot.frequency_hz is not None or robot.sync.rate_hz:
        return []
    form, layout = robot.source.format, robot.source.layout or {}
    allowed = "the rate in Hz, or unknown"
    if form == "rlds" or (form == "hdf5" and "timestamps" not in layout):
        if form == "hdf5":
            allowed += ", or null with source.layout.timestamps and a stride"
        return [Problem("frequency_hz", f"is null, but {form} recordings keep no times", allowed=allowed)]
    if robot.stride_override:
        return []
    allowed += ", or null with a stride" + ("" if form in ONE_INDEX else " or sync.rate_hz")
    return [Problem("frequency_hz", "is null, so that no stride follows from it", allowed=allowed)]


def todos(values: Any, path: str = "") -> list[tuple[str, str]]:
    """Return (YAML path, question) of every value that still begins with TODO."""
    if isinstance(values, dict):
        inner = [(f"{path}.{key}" if path else str(key), value) for key, value in values.items()]
        return [item for key, value in inner for item in todos(value, key)]
    if isinstance(values, list):
        return [item for i, value in enumerate(values) for item in todos(value, f"{path}[{i}]")]
    if isinstance(values, str) and values.startswith(TODO):
        return [(path, values[len(TODO) :].lstrip(": "))]
    return []


def _yaml_path(location: tuple[int | str, ...], values: Any, missing: bool) -> str:
    """Return a location as a path in the YAML; pydantic also names branches of a union, which are no keys."""
    path, here = "", values
    for i, part in enumerate(location):
        if isinstance(here, dict) and (part in here or (missing and i == len(location) - 1)):
            path += f".{part}" if path else str(part)
            here = here.get(part)
        elif isinstance(here, list | tuple) and isinstance(part, int):
            path += f"[{part}]"
            here = here[part] if part < len(here) else None
    return path


def _problem(path: str, item: Any, values: dict[str, Any]) -> Problem:
    if item["type"] == "missing":
        return Problem(path, "is missing")
    if item["type"] == "extra_forbidden":
        return _unknown_key(path, values)
    shown: str | None = repr(item["input"])
    if isinstance(item["input"], dict):
        shown = None if item["type"] == "value_error" else "a mapping"
    if shown and len(shown) > 60:
        shown = shown[:57] + "..."
    if item["type"] == "literal_error":
        return Problem(path, "is not one of the words that are allowed", shown, item["ctx"]["expected"])
    inside = _KEYS_AT.get(re.sub(r"\[\d+\]", "", path)) if item["type"] == "model_type" else None
    return Problem(path, plain_fault(item), shown, ", ".join(_keys(inside)) if inside else None)


def _unknown_key(path: str, values: dict[str, Any]) -> Problem:
    parent, of = re.sub(r"\[\d+\]", "", path).rpartition(".")[0], ""
    known: type[BaseModel] = _KEYS_AT.get(parent, Embodiment)
    if parent == "source.layout":
        known, of = LAYOUTS[values["source"]["format"]], f" of format {values['source']['format']}"
    keys, key = _keys(known), path.rpartition(".")[2]
    places = [f"{place}.{key}" for place, model in _KEYS_AT.items() if key in _keys(model)]
    near = meant(_OTHER_WORDS.get(key.lower(), key), keys, 1) or meant(key, places, 1, cutoff=0)
    return Problem(path, f"unknown key{of}{near and f', {near}'}", allowed=", ".join(keys) or "none")


def _keys(model: type[BaseModel]) -> list[str]:
    return [field.alias or name for name, field in model.model_fields.items()]


_OTHER_WORDS = {  # keys as other projects name them -> ours
    "path": "uri", "url": "uri", "file": "uri", "folder": "uri", "type": "kind",
    "fps": "frequency_hz", "hz": "frequency_hz", "rate": "frequency_hz",
}  # fmt: skip
_KEYS_AT: dict[str, type[SpecModel]] = {
    "action": Action,
    "action.components": Component,
    "state": Vector,
    "state.components": Component,
    "cameras": Camera,
    "sync": Sync,
    "source": SourceSpec,
    "quality": Quality,
    "source.segments": Segments,
    "source.segments.start": Marker,
    "source.segments.stop": Marker,
}


def schema() -> dict[str, Any]:
    """Return the JSON Schema of a registry YAML, for editors."""
    dialect = {"$schema": "https://json-schema.org/draft/2020-12/schema"}
    return dialect | Embodiment.model_json_schema(by_alias=True)


# -- where embodiments are found


def find(name_or_path: StrPath, beside: StrPath | None = None) -> Embodiment:
    """Return the embodiment of that id, or of that YAML file.

    Args:
        name_or_path: id, or str or path of a YAML.
        beside: str or path of a checkpoint whose embodiments are searched too.

    Raises:
        RegistryError: there is none (the error names the nearest ids), or its YAML is not valid.
    """
    name_or_path = as_text(name_or_path)
    if name_or_path.endswith((".yaml", ".yml")) or os.sep in name_or_path:
        return Embodiment.load(name_or_path)
    folders = registry_folders(beside)
    for folder in folders:
        paths = [path for path in registry_files([folder]) if file_id(path) == name_or_path]
        if len(paths) > 1:
            raise RegistryError(paths[1], f"has the id of {paths[0]}", "remove or rename one")
        if paths:
            embodiment = Embodiment.load(paths[0])
            if embodiment.id == name_or_path:
                return embodiment
            raise RegistryError(paths[0], f"has id {embodiment.id!r}", "file name and id must be the same")
    if found := misplaced(as_path(name_or_path), "a YAML file"):
        raise RegistryError(name_or_path, *found)
    hint = meant(name_or_path, [file_id(path) for path in registry_files(folders)])
    raise RegistryError(
        f"embodiment {name_or_path!r}",
        f"is not in {', '.join(map(str, folders)) or 'any registry folder'}",
        f"{hint} give a YAML file's path, or set HMA_REGISTRY; hma registry list shows all",
    )
