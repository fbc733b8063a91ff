"""Define the keys of `source.layout`, which depend on the format of the recording.

`LAYOUTS` is the one list of them: a YAML is checked against it, and its JSON Schema is made from it. All
values are kept as text. A format of an installed package checks its own keys.
"""

import re
from typing import Annotated, Any, Literal

from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, FiniteFloat


class SourceLayout(BaseModel):
    """The base class of all layouts, itself the layout of a format without keys."""

    model_config = ConfigDict(frozen=True, extra="forbid")


class Hdf5Layout(SourceLayout):
    """Where an HDF5 file has its episodes, and what the numbers of its pictures mean."""

    episodes: str | None = Field(
        None, description="pattern of the groups that are episodes; / for one file an episode"
    )
    timestamps: str | None = Field(None, description="key of the seconds, where the rate is not even")
    axes: Literal["THWC", "TCHW"] | None = Field(
        None, description="of pictures, where the shape leaves it open"
    )
    pixels: Literal["0-1", "0-255", "0-65535"] | None = Field(
        None, description="range of pictures that are not uint8"
    )
    last_observation: Literal["drop"] | None = Field(
        None, description="drop: the observation after the last action is left out"
    )


class LeRobotLayout(SourceLayout):
    """How the rows of a LeRobotDataset find their pictures."""

    pairing: Literal["time", "index"] = Field(
        "time", description="time: by the stamps; index: row i has picture i, whatever the film's stamps say"
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
    """Where the labels of hand videos are, and what a frame without a hand does.

    `missing: split` ends the run. `hold` keeps the hand's last position for at most `max_hold` frames, and
    then ends the run. `mask` continues the run: the values that need the hand are unknown; with `max_hold`
    they are held first, and unknown after that.
    """

    labels: Literal[
        "detector", "landmarks", "epic_kitchens_hand_objects", "ego4d_fho", "egoexo4d_hand_pose"
    ] = Field("detector", description="who says where the hands are")
    annotations: str | None = Field(
        None, description="file or folder of the labels, absolute or below the videos' folder, the default"
    )
    models: str | None = Field(
        None, description="of the detector: folder of .tflite files or a .task bundle; else $HMA_HAND_MODELS"
    )
    missing: Literal["split", "hold", "mask"] = Field(
        "split", description="what a frame without a needed hand does"
    )
    max_hold: int | None = Field(
        None, ge=0, description="most labelled frames in a row for which the last position is held"
    )
    min_frames: int = Field(12, ge=0, description="runs with fewer frames (with hands) are left out")
    min_score: FiniteFloat = Field(0.5, ge=0, description="labels with a lower score are ignored")
    max_gap_s: FiniteFloat = Field(
        3.0, ge=0, description="most seconds between labels of one run, where labels are irregular"
    )
    pictures: Literal["labelled", "every"] = Field(
        "labelled", description="frames with a label, or every frame from the first to the last of a run"
    )
    first_frame: int | None = Field(
        None, ge=0, description="a video's first frame in the labels; by default 1 for EPIC-KITCHENS, else 0"
    )
    label_size: Size = Field(
        None, description="WIDTHxHEIGHT of the pictures that were labelled; by default the video's"
    )
    camera: str = Field("cam01", description="Ego-Exo4D: which camera's labels and videos")
    mirrored: bool = Field(
        False, description="for mirrored pictures (front cameras): swaps the detector's left and right"
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
