"""An embodiment: one robot as one dataset recorded it, stated by one YAML of the registry.

The YAML drives everything else: which keys a converter reads, the stride, the width of stem
and head, what is published under which name. Nothing is guessed; what is unknown says so.

A action dims, K = stride * A values of an action chunk.
"""

import hashlib
import json
import math
import os
import re
from collections.abc import Iterator
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal, Self

from pydantic import (
    AfterValidator,
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    ValidationError,
    field_validator,
    model_validator,
)

from hma_data.errors import RegistryError
from hma_data.shipped import shipped
from hma_data.yaml_io import parse_yaml, read_yaml, write_yaml

if TYPE_CHECKING:
    import numpy as np
    from numpy.typing import NDArray

ID_PATTERN = re.compile(r"[a-z0-9][a-z0-9_.-]{0,99}")
TODO = "TODO"

Space = Literal[
    "joint_position", "joint_velocity", "joint_delta", "eef_pose", "eef_delta", "base_velocity",
    "hand_2d", "hand_3d", "mixed",
]  # fmt: skip
Representation = Literal[
    "euler_xyz", "quaternion_xyzw", "quaternion_wxyz", "axis_angle", "rotation_6d", "rotation_matrix"
]
Gripper = Literal["open_is_high", "open_is_low", "opening_is_high", "closing_is_high"]
Method = Literal["nearest", "hold", "interpolate"]
Format = Literal["rlds", "hdf5", "rosbag", "lerobot", "hands"]


def _no_bool(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError("must be a number, not true or false")
    return value


def _no_minus_zero(value: float) -> float:
    return value + 0.0  # -0.0 equals 0.0 but prints and hashes apart


Number = Annotated[
    float, BeforeValidator(_no_bool), Field(allow_inf_nan=False), AfterValidator(_no_minus_zero)
]
Count = Annotated[int, BeforeValidator(_no_bool)]


class _Model(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=False, arbitrary_types_allowed=False)


class Component(_Model):
    """A piece of the action (or state) vector.

    `sign` and `offset` change values (value * sign + offset); `range` and `representation`
    state conventions and change nothing.
    """

    key: str = Field(min_length=1, description="where the values are: a path or a topic field, by format")
    dims: Count = Field(ge=1, le=4096, description="how many values it gives")
    slice: tuple[Count, Count] | None = Field(None, description="[from, to) of the vector found at key")
    names: tuple[str, ...] | None = Field(
        None, description="one a value; selects by name where messages have names"
    )
    unit: str | None = None
    normalize: bool = True
    sign: Number | tuple[Number, ...] = 1.0
    offset: Number | tuple[Number, ...] = 0.0
    range: tuple[Number, Number] | None = None
    representation: Representation | None = None
    gripper: Gripper | None = Field(
        None, description="which way it opens; opening_ and closing_is_high are of commands that move it a bit"
    )
    stamp: Literal["header", "receive"] | None = None

    @model_validator(mode="after")
    def _widths(self) -> Self:
        if self.slice and not 0 <= self.slice[0] < self.slice[1]:
            raise ValueError(f"slice {list(self.slice)} must be [from, to) with 0 <= from < to")
        if self.slice and self.slice[1] - self.slice[0] != self.dims:
            raise ValueError(
                f"slice {list(self.slice)} has {self.slice[1] - self.slice[0]} values, dims says {self.dims}"
            )
        if self.names and len(self.names) != self.dims:
            raise ValueError(f"{len(self.names)} names for {self.dims} dims")
        for label in ("sign", "offset"):
            value = getattr(self, label)
            if isinstance(value, tuple) and len(value) != self.dims:
                raise ValueError(f"{label} has {len(value)} values for {self.dims} dims")
        if self.range and self.range[0] >= self.range[1]:
            raise ValueError(f"range {list(self.range)} must rise")
        return self


class Vector(_Model):
    """The components of an action or state, in the vector's order."""

    components: tuple[Component, ...] = Field(min_length=1)

    @property
    def dims(self) -> int:
        """Width of the whole vector."""
        return sum(component.dims for component in self.components)

    def names(self) -> list[str]:
        """A name for each value; made from the key where the YAML gives none."""
        return [
            name
            for part in self.components
            for name in (part.names or [f"{part.key}.{i}" for i in range(part.dims)])
        ]


class Action(Vector):
    """What the robot is told to do at each step."""

    space: Space


class Camera(_Model):
    """A camera stream and how its pictures are brought to a square."""

    name: str = Field(min_length=1, pattern=r"^[A-Za-z0-9_.-]+$")
    key: str = Field(min_length=1)
    size: tuple[Count, Count] | None = Field(
        None, description="[height, width] of the recorded picture in pixels; states a fact, changes nothing"
    )
    color: Literal["rgb", "bgr"] = "rgb"
    resize: Literal["short_side_crop", "letterbox", "stretch"] = "short_side_crop"
    rotate: Literal[0, 90, 180, 270] = Field(0, description="degrees clockwise")
    crop: tuple[Count, Count, Count, Count] | None = Field(
        None, description="[x, y, width, height] in source pixels"
    )
    stamp: Literal["header", "receive"] | None = None

    @field_validator("size")
    @classmethod
    def _size_positive(cls, size: tuple[int, int] | None) -> tuple[int, int] | None:
        if size and min(size) < 1:
            raise ValueError(f"size {list(size)} must be [height >= 1, width >= 1]")
        return size

    @field_validator("crop")
    @classmethod
    def _crop_positive(cls, crop: tuple[int, int, int, int] | None) -> tuple[int, int, int, int] | None:
        if crop and (min(crop[:2]) < 0 or min(crop[2:]) < 1):
            raise ValueError(f"crop {list(crop)} must be [x >= 0, y >= 0, width >= 1, height >= 1]")
        return crop


class Sync(_Model):
    """How streams of different rates meet: on the primary camera's frames, or on a fixed grid."""

    primary: str | None = Field(None, description="the camera whose frames are the grid; default the first")
    rate_hz: Number | None = Field(
        None, gt=0, le=100_000, description="a fixed grid instead of a camera's frames"
    )
    images: Method = "nearest"
    actions: Method = "hold"
    states: Method = "interpolate"
    max_skew_ms: Number | None = Field(None, gt=0, description="an episode moved by more is refused")
    stamp: Literal["header", "receive"] = "header"


class SourceSpec(_Model):
    """Where the recordings are and how they are laid out."""

    format: Format
    uri: str | None = None
    split: str | None = Field(None, description="the source's own split to read")
    episodes: Count | None = Field(None, ge=1, description="how many there are, as published")
    instruction: str | None = Field(None, description="key of the language instruction")
    layout: dict[str, str] | None = Field(None, description="by format: keys of a generic layout")


class Embodiment(_Model):
    """A robot as one dataset recorded it. Frozen; made from YAML by `load` or `find`."""

    id: str
    description: str = ""
    robot: str | None = None
    kind: Literal["real", "simulation", "human"]
    frequency_hz: Number | Literal["unknown"] | None = Field(
        description="control rate of the recording; null only with per-recording timestamps"
    )
    target_hz: Number = Field(2.0, ge=0.001, le=100_000)
    stride_override: Count | None = Field(None, alias="stride", ge=1)
    action: Action
    state: Vector | None = None
    cameras: tuple[Camera, ...] = Field(min_length=1)
    sync: Sync = Sync()
    source: SourceSpec
    stats_key: str | None = None
    license: str | None = None
    provenance: dict[str, str] = Field(default_factory=dict)
    notes: str | None = None

    @field_validator("id")
    @classmethod
    def _id_is_a_name(cls, value: str) -> str:
        if not ID_PATTERN.fullmatch(value) or ".." in value:
            raise ValueError("an id is 1 to 100 of a-z 0-9 _ - . beginning with a letter or digit")
        return value

    @field_validator("frequency_hz")
    @classmethod
    def _rate_positive(cls, value: float | str | None) -> float | str | None:
        if isinstance(value, float) and not 0 < value <= 100_000:
            raise ValueError("must lie between 0 and 100000 Hz")
        return value

    @model_validator(mode="after")
    def _names_agree(self) -> Self:
        names = [camera.name for camera in self.cameras]
        if len(set(names)) != len(names):
            raise ValueError(f"cameras have one name twice: {', '.join(names)}")
        if self.sync.primary and self.sync.primary not in names:
            raise ValueError(
                f"sync.primary {self.sync.primary!r} is not a camera; cameras: {', '.join(names)}"
            )
        return self

    # -- derived facts

    @property
    def action_dim(self) -> int:
        """A, the width of one action."""
        return self.action.dims

    @property
    def rate_hz(self) -> float:
        """Rate of the grid in Hz.

        Raises:
            RegistryError: nobody has stated it.
        """
        if self.sync.rate_hz:
            return self.sync.rate_hz
        if isinstance(self.frequency_hz, float):
            return self.frequency_hz
        raise RegistryError(
            f"embodiment {self.id}: frequency_hz",
            f"is {'unknown' if self.frequency_hz == 'unknown' else 'null'}, so no stride can be derived",
            "set frequency_hz to the recording's control rate in the YAML"
            + ("" if self.frequency_hz == "unknown" else ", or state stride"),
        )

    @property
    def stride(self) -> int:
        """Recorded steps a frame of the model's grid: max(1, round half up of rate / target)."""
        if self.stride_override:
            return self.stride_override
        return max(1, math.floor(self.rate_hz / self.target_hz + 0.5))

    @property
    def effective_hz(self) -> float:
        """Rate of the model's frames."""
        return self.rate_hz / self.stride

    @property
    def chunk_dim(self) -> int:
        """K = stride * A, the width of an action chunk."""
        return self.stride * self.action_dim

    @property
    def primary_camera(self) -> Camera:
        """The camera whose frames are the grid."""
        return self.camera(self.sync.primary or self.cameras[0].name)

    def camera(self, name: str) -> Camera:
        """The camera of that name.

        Raises:
            RegistryError: there is none.
        """
        for camera in self.cameras:
            if camera.name == name:
                return camera
        known = ", ".join(camera.name for camera in self.cameras)
        raise RegistryError(f"embodiment {self.id}", f"has no camera {name!r}", f"its cameras: {known}")

    @property
    def normalize_mask(self) -> "NDArray[np.bool_]":
        """(A,) bool, True where the model normalizes the value."""
        import numpy as np

        return np.array([part.normalize for part in self.action.components for _ in range(part.dims)])

    @cached_property
    def digest(self) -> str:
        """Sixteen hex digits over what decides the shards' content (not texts, nor the place of the data)."""
        content = self.model_dump(
            mode="json", exclude={"description", "robot", "license", "provenance", "notes", "stats_key"}
        )
        content["source"] = {key: content["source"][key] for key in ("format", "instruction", "layout")}
        for name in ("target_hz", "stride_override"):  # they act when windows are drawn, not in the shards
            content.pop(name)
        for camera in content["cameras"]:
            camera.pop("size")
        return hashlib.sha256(json.dumps(content, sort_keys=True).encode()).hexdigest()[:16]

    # -- YAML

    def to_dict(self) -> dict[str, Any]:
        """Plain values in the YAML's form, without what was left at its default."""
        return self.model_dump(mode="json", by_alias=True, exclude_defaults=True)

    def to_yaml(self) -> str:
        """The YAML that gives this embodiment back."""
        return write_yaml(self.to_dict())

    @classmethod
    def from_yaml(cls, text: str, where: str = "embodiment.yaml") -> "Embodiment":
        """See `load`."""
        return cls.from_values(parse_yaml(text, where), where)

    @classmethod
    def load(cls, path: str | Path) -> "Embodiment":
        """The embodiment of a YAML file.

        Raises:
            RegistryError: all the file's problems, each with YAML path, value and what is allowed.
        """
        return cls.from_values(read_yaml(Path(path)), str(path))

    @classmethod
    def from_values(cls, values: Any, where: str) -> "Embodiment":
        """See `load`."""
        found = problems(values)
        if found:
            raise RegistryError(where, "; ".join(found), "hma registry schema prints what is allowed")
        return cls.model_validate(values)


def problems(values: Any) -> list[str]:
    """Everything wrong with the plain values of a YAML, one line each; empty when it is valid."""
    if not isinstance(values, dict):
        return [f"must be a mapping, is {type(values).__name__}"]
    found = [f"{path}: still {TODO}: {text}" for path, text in todos(values)]
    try:
        Embodiment.model_validate(values)
    except ValidationError as fault:
        open_paths = {path for path, _ in todos(values)}
        for item in fault.errors(include_url=False):
            path = _yaml_path(item["loc"], values, missing=item["type"] == "missing")
            if path not in open_paths and not _follows_from_another(item):
                found.append(_problem(path, item))
    return list(dict.fromkeys(found))


def todos(values: Any, path: str = "") -> list[tuple[str, str]]:
    """Every value that still begins with TODO: (YAML path, the question)."""
    if isinstance(values, dict):
        return [
            item
            for key, value in values.items()
            for item in todos(value, f"{path}.{key}" if path else str(key))
        ]
    if isinstance(values, list):
        return [item for i, value in enumerate(values) for item in todos(value, f"{path}[{i}]")]
    if isinstance(values, str) and values.startswith(TODO):
        return [(path, values[len(TODO) :].lstrip(": "))]
    return []


def _yaml_path(location: tuple[int | str, ...], values: Any, missing: bool) -> str:
    """The place as the YAML has it; pydantic also names the branch of a union, which is no key."""
    path, here = "", values
    for i, part in enumerate(location):
        if isinstance(here, dict) and (part in here or (missing and i == len(location) - 1)):
            path += f".{part}" if path else str(part)
            here = here.get(part)
        elif isinstance(here, list | tuple) and isinstance(part, int):
            path += f"[{part}]"
            here = here[part] if part < len(here) else None
    return path


def _follows_from_another(item: Any) -> bool:
    """A list whose items are all wrong is also too short, says pydantic."""
    return item["type"] == "too_short" and bool(item["input"])


def _problem(path: str, item: Any) -> str:
    value = item.get("input")
    message = item["msg"].removeprefix("Value error, ")
    if item["type"] == "missing":
        return f"{path}: is missing"
    if item["type"] == "extra_forbidden":
        from difflib import get_close_matches

        key = path.rsplit(".", 1)[-1]
        near = get_close_matches(key, _known_keys(), n=1)
        return f"{path}: unknown key" + (f", did you mean {near[0]!r}?" if near else "")
    shown = repr(value)
    shown = shown if len(shown) <= 60 else shown[:57] + "..."
    return f"{path or 'the file'}: {message}" + ("" if isinstance(value, dict) else f" (is {shown})")


def _known_keys() -> list[str]:
    models: list[type[_Model]] = [Embodiment, Action, Vector, Component, Camera, Sync, SourceSpec]
    return [field.alias or name for model in models for name, field in model.model_fields.items()]


def schema() -> dict[str, Any]:
    """JSON Schema of a registry YAML, for editors."""
    return {
        "$schema": "https://json-schema.org/draft/2020-12/schema",
        **Embodiment.model_json_schema(by_alias=True),
    }


# -- where embodiments are found


def registry_folders(beside: Path | None = None) -> list[Path]:
    """Folders searched for an id, first wins: ./registry, $HMA_REGISTRY, beside a checkpoint, shipped."""
    folders = [Path("registry")]
    folders += [Path(entry) for entry in os.environ.get("HMA_REGISTRY", "").split(os.pathsep) if entry]
    if beside:
        folders.append(beside / "embodiments")
    folders.append(shipped("registry"))
    return list(dict.fromkeys(folder.resolve() for folder in folders if folder.is_dir()))


def registry_files(folders: list[Path] | None = None) -> Iterator[Path]:
    """Every YAML of the registry, in search order."""
    for folder in registry_folders() if folders is None else folders:
        yield from sorted(path for path in folder.rglob("*.y*ml") if path.suffix in (".yaml", ".yml"))


def find(name_or_path: str, beside: Path | None = None) -> Embodiment:
    """The embodiment of that id, or of that YAML file.

    Raises:
        RegistryError: there is none, with the nearest ids; or its YAML is not valid.
    """
    if name_or_path.endswith((".yaml", ".yml")) or os.sep in name_or_path:
        return Embodiment.load(name_or_path)
    folders = registry_folders(beside)
    for folder in folders:
        paths = [path for path in registry_files([folder]) if _file_id(path) == name_or_path]
        if len(paths) > 1:
            raise RegistryError(paths[1], f"has the id of {paths[0]}", "remove or rename one")
        if paths:
            embodiment = Embodiment.load(paths[0])
            if embodiment.id != name_or_path:
                raise RegistryError(
                    paths[0], f"has id {embodiment.id!r}", "file name and id must be the same"
                )
            return embodiment
    from difflib import get_close_matches

    near = get_close_matches(name_or_path, [_file_id(path) for path in registry_files(folders)], n=3)
    hint = f"did you mean {', '.join(near)}? " if near else ""
    raise RegistryError(
        f"embodiment {name_or_path!r}",
        f"is not in {', '.join(map(str, folders)) or 'any registry folder'}",
        f"{hint}give a YAML file's path, or set HMA_REGISTRY; hma registry list shows all",
    )


def _file_id(path: Path) -> str:
    """The id a registry file is found by; a checkpoint keeps each in a folder of its own."""
    return path.parent.name if path.stem == "embodiment" else path.stem
