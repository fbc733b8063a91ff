"""Define the parts of a registry YAML: components of a vector, cameras, clocks, the source of the data.

They are frozen and validated when made; `hma_data.registry.embodiment` puts them together.
"""

import re
from itertools import accumulate, pairwise
from typing import Annotated, Any, Literal, Self

from pydantic import (
    BaseModel,
    BeforeValidator,
    ConfigDict,
    Field,
    FiniteFloat,
    ValidationInfo,
    field_validator,
    model_validator,
)
from pydantic_core import PydanticCustomError

from hma_data.registry import FORMATS, MORE_FORMATS, known_formats

Space = Literal[
    "joint_position", "joint_velocity", "joint_delta", "joint_torque", "eef_pose", "eef_delta",
    "base_velocity", "hand_2d", "hand_3d", "mixed",
]  # fmt: skip
Representation = Literal[
    "euler_xyz", "quaternion_xyzw", "quaternion_wxyz", "axis_angle", "rotation_6d", "rotation_matrix"
]
Gripper = Literal["open_is_high", "open_is_low", "opening_is_high", "closing_is_high"]
Method = Literal["nearest", "hold", "interpolate"]
Stamp = Literal["header", "receive"]
Verdict = Literal["refuse", "flag"]
Pattern = Annotated[str, Field(min_length=1)]


def _no_bool(value: Any) -> Any:
    if isinstance(value, bool):
        raise ValueError("must be a number, not true or false")
    return value


Number = Annotated[float, BeforeValidator(_no_bool), Field(allow_inf_nan=False)]
Count = Annotated[int, BeforeValidator(_no_bool)]
Positive = Annotated[Count, Field(ge=1)]
Start = Annotated[Count, Field(ge=0)]


def _known_format(value: Any) -> Any:
    if not isinstance(value, str) or (value not in FORMATS and value not in known_formats()):
        allowed = f"{', '.join(map(repr, known_formats()))}; {MORE_FORMATS}"
        raise PydanticCustomError("literal_error", "must be a known format", {"expected": allowed})
    return value


def _list_formats(schema: dict[str, Any]) -> None:
    schema["enum"] = known_formats()


Format = Annotated[str, BeforeValidator(_known_format), Field(json_schema_extra=_list_formats)]


class SpecModel(BaseModel):
    """The base class of all parts: unknown keys are errors, and objects are frozen."""

    model_config = ConfigDict(extra="forbid", frozen=True, strict=False, arbitrary_types_allowed=False)


class Component(SpecModel):
    """A named part of the action or state vector.

    `sign` and `offset` change values (value * sign + offset); `range` and `representation`
    state conventions and change nothing.
    """

    key: str = Field(min_length=1, description="location in the recording: a path or a topic field")
    dims: Count = Field(ge=1, le=4096, description="the number of values")
    slice: tuple[Start, Count] | None = Field(None, description="[from, to) of the vector found at key")
    names: tuple[str, ...] | None = Field(
        None, description="one name for each value; messages with names are read by these names"
    )
    unit: str | None = Field(None, description="unit of the values, such as m or rad; for plots")
    normalize: bool = Field(True, description="false keeps raw values, such as of an open/close gripper")
    sign: Number | tuple[Number, ...] = Field(1.0, description="factor: one value, or one per dim")
    offset: Number | tuple[Number, ...] = Field(
        0.0, description="added after `sign`: one value, or one per dim"
    )
    range: tuple[Number, Number] | None = Field(
        None, description="[low, high] of the values, for information"
    )
    representation: Representation | None = Field(None, description="how an angle or rotation is represented")
    gripper: Gripper | None = Field(
        None,
        description="meaning of a high value; opening_ and closing_is_high are for relative actions",
    )
    stamp: Stamp | None = Field(None, description="overrides `sync.stamp`")

    @field_validator("slice", "names", "sign", "offset")
    @classmethod
    def _as_many_as_dims(cls, value: Any, info: ValidationInfo) -> Any:
        dims = info.data.get("dims")  # missing where it has a problem of its own
        if not isinstance(value, tuple) or dims is None:
            return value
        width = value[1] - value[0] if info.field_name == "slice" else len(value)
        if width != dims:
            raise ValueError(f"has {width} values, but dims is {dims}")
        return value

    @field_validator("range")
    @classmethod
    def _rising(cls, value: tuple[float, float] | None) -> tuple[float, float] | None:
        if value and value[0] >= value[1]:
            raise ValueError("must be [low, high] with low < high")
        return value


class Vector(SpecModel):
    """The components of an action or state, in the vector's order."""

    components: tuple[Component, ...] = Field(min_length=1, description="parts, in the vector's order")

    @property
    def dims(self) -> int:
        """Return the width of the whole vector."""
        return sum(component.dims for component in self.components)

    def spans(self) -> list[tuple[Component, slice]]:
        """Return each component with the place of its values in the vector."""
        edges = pairwise(accumulate((component.dims for component in self.components), initial=0))
        return [(component, slice(*edge)) for component, edge in zip(self.components, edges, strict=True)]

    def names(self) -> list[str]:
        """Return a name for each value, made from the key where the YAML gives none."""
        return [
            name
            for component in self.components
            for name in (component.names or [f"{component.key}.{i}" for i in range(component.dims)])
        ]


class Action(Vector):
    """The action vector at each step."""

    space: Space = Field(description="the control space")


class Camera(SpecModel):
    """A camera stream and its image preprocessing."""

    name: str = Field(
        min_length=1, pattern=r"^[A-Za-z0-9_.-]+$", description="name in shards and on the command line"
    )
    key: str = Field(min_length=1, description="location of the images in the recording")
    size: tuple[Positive, Positive] | None = Field(
        None, description="[height, width] of recorded images in pixels, for information"
    )
    color: Literal["rgb", "bgr"] = Field("rgb", description="order of the channels as recorded")
    resize: Literal["short_side_crop", "letterbox", "stretch"] = Field(
        "short_side_crop", description="how an image becomes the tokenizer's square"
    )
    rotate: Literal[0, 90, 180, 270] = Field(0, description="degrees clockwise")
    flip: Literal["vertical", "horizontal"] | None = Field(
        None, description="applied before rotate; vertical: rows are stored from bottom to top"
    )
    crop: tuple[Start, Start, Positive, Positive] | None = Field(
        None, description="[x, y, width, height] in pixels, after flip and rotate"
    )
    stamp: Stamp | None = Field(None, description="overrides `sync.stamp`")
    levels: tuple[Number, Number] | None = Field(
        None, description="[black, white] of a bag's 16-bit grey images: the values mapped to 0 and 255"
    )

    @model_validator(mode="after")
    def _levels_rise(self) -> Self:
        if self.levels and self.levels[0] >= self.levels[1]:
            raise ValueError(f"levels {list(self.levels)} must be [black, white] with black < white")
        return self


class Sync(SpecModel):
    """The grid for streams of different rates: the primary camera's frames, or a fixed rate."""

    primary: str | None = Field(
        None, description="the camera whose frames are the grid; the first by default"
    )
    rate_hz: Number | None = Field(
        None, gt=0, le=100_000, description="a fixed grid instead of a camera's frames; for bags and videos"
    )
    images: Method = Field("nearest", description="alignment of images to the grid")
    actions: Method = Field("hold", description="alignment of actions to the grid")
    states: Method = Field("interpolate", description="alignment of states to the grid")
    max_skew_ms: Number | None = Field(None, gt=0, description="maximum time between a sample and its frame")
    tolerance_ms: Number | None = Field(
        None, gt=0, description="with hold: an action up to this long after a frame belongs to that frame"
    )
    beyond: Literal["refuse", "mask"] = Field(
        "refuse",
        description="above max_skew_ms: refuse the episode, or mask numbers; images always refuse it",
    )
    action_shift: Count = Field(
        0,
        ge=-100,
        le=100,
        description="in steps: the action of frame t is recorded at t + action_shift; not for bags, RH20T",
    )
    stamp: Stamp = Field("header", description="which timestamp of a message to use")

    @field_validator("beyond")
    @classmethod
    def _mask_needs_a_limit(cls, value: str, info: ValidationInfo) -> str:
        if value == "mask" and info.data.get("max_skew_ms", 0) is None:
            raise ValueError("mask needs sync.max_skew_ms")
        return value

    @model_validator(mode="after")
    def _held(self) -> Self:
        if self.tolerance_ms and self.actions != "hold":
            raise ValueError(f"tolerance_ms is for actions: hold, not for {self.actions}")
        return self


class Marker(SpecModel):
    """Messages of a bag that begin or end an episode.

    With `equals`, only messages at which the value becomes `equals` count; without it, every message does.
    """

    key: str = Field(min_length=1, description="/topic or /topic.field.path")
    equals: bool | Number | str | None = Field(None, description="only when the value becomes this")

    @model_validator(mode="after")
    def _field_of_topic(self) -> Self:
        if not self.key.startswith("/"):
            raise ValueError(f"key {self.key!r} must begin with a topic, /topic or /topic.field.path")
        if self.equals is not None and "." not in self.key:
            raise ValueError(f"equals needs a field, but {self.key} names only a topic")
        return self


class Segments(SpecModel):
    """The conditions that divide one bag into several episodes; several may be given together."""

    gap_s: Number | None = Field(
        None, gt=0, description="seconds; a longer pause of the primary camera starts a new episode"
    )
    start: Marker | None = Field(None, description="begins an episode and ends the current one")
    stop: Marker | None = Field(None, description="ends an episode; without start, the next begins there")

    @model_validator(mode="after")
    def _something(self) -> Self:
        if self.gap_s is None and self.start is None and self.stop is None:
            raise ValueError("is empty: give gap_s, start or stop")
        return self


def _as_text(value: Any) -> Any:
    """Return numbers, true and false as text: a YAML may write them with or without quotes."""
    if isinstance(value, bool):
        return str(value).lower()
    return str(value) if isinstance(value, int | float) else value


def _by_format(schema: dict[str, Any]) -> None:
    schema["allOf"] = keys_schema()
    schema["properties"]["layout"] = {"description": schema["properties"]["layout"]["description"]}


# -- the keys of `source.layout`, which depend on the format


class SourceLayout(BaseModel):
    """The base class of all layouts, itself the layout of a format without keys."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Hdf5Layout(SourceLayout):
    """The place of an HDF5 file's episodes, and what the numbers of its pictures mean."""

    episodes: str | None = Field(
        None, description="pattern of the episode groups; / for one file per episode"
    )
    timestamps: str | None = Field(
        None, description="key of the timestamps (s, ms, µs or ns), if the rate varies"
    )
    axes: Literal["THWC", "TCHW"] | None = Field(
        None, description="axes of images, if the shape is ambiguous"
    )
    pixels: Literal["0-1", "0-255", "0-65535"] | None = Field(
        None, description="range of images that are not uint8"
    )
    last_observation: Literal["drop"] | None = Field(
        None, description="drop: omit the observation after the last action"
    )
    metadata: str | None = Field(
        None, description="JSON file next to each file; its values replace {names} in a camera's key"
    )
    frames_missing: int = Field(
        0, ge=0, description="maximum number of rows at the end without a video frame; they are dropped"
    )


class LeRobotLayout(SourceLayout):
    """The way in which the rows of a LeRobotDataset find their pictures."""

    pairing: Literal["time", "index"] | None = Field(
        None,
        description="default: by timestamp, if the video fits its episodes; time: by timestamp, "
        "without that check; index: row i has frame i",
    )


def _width_and_height(value: Any) -> Any:
    if isinstance(value, str):
        sides = re.fullmatch(r"([1-9]\d*)x([1-9]\d*)", value)
        if not sides:
            raise ValueError("give WIDTHxHEIGHT, such as 1920x1080")
        return int(sides[1]), int(sides[2])
    return value


Size = Annotated[
    tuple[int, int] | None,
    BeforeValidator(_width_and_height, json_schema_input_type=str),
]


class HandsLayout(SourceLayout):
    """The place of the labels of hand videos, and what a frame without a hand does.

    `missing: split` ends the run. `hold` keeps the hand's last position for at most `max_hold` frames, and
    then ends the run. `mask` continues the run: the values that need the hand are unknown; with `max_hold`
    they are held first, and unknown after that.
    """

    labels: Literal[
        "detector", "landmarks", "epic_kitchens_hand_objects", "ego4d_fho", "egoexo4d_hand_pose"
    ] = Field("detector", description="source of the hand positions")
    annotations: str | None = Field(
        None, description="file or folder of the labels, absolute, or in the videos' folder, the default"
    )
    models: str | None = Field(
        None, description="of the detector: folder of .tflite files or a .task bundle; else $HMA_HAND_MODELS"
    )
    missing: Literal["split", "hold", "mask"] = Field(
        "split", description="rule for a frame without a required hand"
    )
    max_hold: int | None = Field(
        None, ge=0, description="maximum number of consecutive labelled frames for which a position is held"
    )
    min_frames: int = Field(12, ge=0, description="minimum frames with hands in a run; others are dropped")
    min_score: FiniteFloat = Field(0.5, ge=0, description="labels with a lower score are ignored")
    max_gap_s: FiniteFloat = Field(
        3.0, ge=0, description="maximum gap between labels of a run, in seconds, for irregular labels"
    )
    pictures: Literal["labelled", "every"] = Field(
        "labelled", description="frames with a label, or every frame from the first to the last of a run"
    )
    first_frame: int | None = Field(
        None, ge=0, description="a video's first frame in the labels; by default 1 for EPIC-KITCHENS, else 0"
    )
    label_size: Size = Field(None, description="WIDTHxHEIGHT of the labelled images; default: the video's")
    camera: str = Field("cam01", description="Ego-Exo4D: which camera's labels and videos")
    mirrored: bool = Field(
        False, description="for mirrored images (front cameras): swaps the detector's left and right"
    )

    @property
    def frame_offset(self) -> int:
        """Return the number to subtract from a label's frame number to get the frame's index."""
        if self.first_frame is not None:
            return self.first_frame
        return int(self.labels == "epic_kitchens_hand_objects")


LAYOUTS: dict[str, type[SourceLayout]] = {
    "rlds": SourceLayout,
    "rosbag": SourceLayout,
    "hdf5": Hdf5Layout,
    "lerobot": LeRobotLayout,
    "rh20t": SourceLayout,
    "hands": HandsLayout,
}


def keys_schema() -> list[dict[str, Any]]:
    """Return the JSON Schema of `source`: one condition for each format, with the keys of its layout."""
    conditions = []
    for name, layout in LAYOUTS.items():
        properties = {}
        for key, field in layout.model_json_schema()["properties"].items() if layout.model_fields else ():
            kinds = [item for item in field.pop("anyOf", [field]) if item.get("type") != "null"]
            told = {"description": field["description"], **kinds[0]}
            if told.get("type") in ("integer", "number", "boolean"):
                told["type"] = [told["type"], "string"]
            told.pop("default", None)
            properties[key] = told
        allowed = {"properties": properties, "additionalProperties": False}
        conditions.append(
            {
                "if": {"properties": {"format": {"const": name}}, "required": ["format"]},
                "then": {
                    "properties": {"layout": {"anyOf": [{"type": "object", **allowed}, {"type": "null"}]}}
                },
            }
        )
    return conditions


class SourceSpec(SpecModel):
    """The location and layout of the recordings."""

    model_config = ConfigDict(json_schema_extra=_by_format)

    format: Format = Field(description="format of the recordings; rosbag is ROS 1, ROS 2 and MCAP")
    uri: str | None = Field(None, description="file, folder or URI of the recordings")
    split: str | None = Field(None, description="split of the source to read")
    episodes: Count | None = Field(None, ge=1, description="the published number of episodes")
    instruction: str | None = Field(None, description="key of the language instruction")
    layout: dict[str, Annotated[str, BeforeValidator(_as_text)]] | None = Field(
        None, description="layout of the data in a file; the keys depend on the format"
    )
    segments: Segments | None = Field(None, description="division of one bag into episodes")
    only: tuple[Pattern, ...] = Field(
        (), description="use only these episodes: ids, globs, or @FILE with one per line"
    )
    exclude: tuple[Pattern, ...] = Field(
        (), description="exclude these episodes: ids, globs, or @FILE with one per line"
    )

    @field_validator("layout")
    @classmethod
    def _keys_of_the_format(cls, value: dict[str, str] | None, info: ValidationInfo) -> Any:
        known = LAYOUTS.get(info.data.get("format", ""))
        if known and value:
            known.model_validate(value)
        return value

    @field_validator("segments")
    @classmethod
    def _of_bags(cls, value: Segments | None, info: ValidationInfo) -> Segments | None:
        if value and info.data.get("format", "rosbag") != "rosbag":
            raise ValueError(f"is for bags, not for {info.data['format']}")
        return value


class Quality(SpecModel):
    """The rules for blank, still and repeated images."""

    blank: Verdict = Field("refuse", description="a camera shows one colour throughout, such as black")
    still: Verdict = Field("flag", description="a camera shows one image throughout")
    repeated: Verdict = Field(
        "flag", description="more than repeated_share of a camera's images repeat the previous one"
    )
    repeated_share: Number = Field(0.5, ge=0, le=1, description="the share above which `repeated` counts")
