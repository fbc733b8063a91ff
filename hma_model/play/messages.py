"""Define the messages of a page, and the bytes of a frame.

A page sends JSON of at most MAX_MESSAGE_BYTES. The server sends JSON, and binary messages with a frame:

    2 bytes   length of the header, big-endian
    header    JSON: serial, frame, psnr, still, ms, rate, input, action, parted, bytes of the model's JPEG
    JPEG      the model's image, then the true one if it is known
"""

import json
import struct
from functools import partial
from typing import Annotated, Any, Literal

from pydantic import AfterValidator, BaseModel, ConfigDict, Field, TypeAdapter, ValidationError

from hma_data.errors import UsageError
from hma_model.play.session import Frame

MAX_MESSAGE_BYTES = 8192
Value = Annotated[float, Field(ge=-1e30, le=1e30)]  # finite, also as float32
Number = Annotated[int, Field(ge=0, le=1_000_000)]


class _Message(BaseModel):
    model_config = ConfigDict(extra="forbid", frozen=True, strict=True)


class OpenMessage(_Message):
    """Open a session of a robot."""

    do: Literal["open"]
    robot: str = Field(max_length=200)
    scene: Number = 0


class ResumeMessage(_Message):
    """Go on with a session after a reload."""

    do: Literal["resume"]
    session: str = Field(max_length=64)


class DriveMessage(_Message):
    """Hold an action (A,) from now on; `input` numbers it."""

    do: Literal["drive"]
    action: list[Value] = Field(max_length=256)
    input: int = Field(ge=0)


class SeenMessage(_Message):
    """A frame has been shown."""

    do: Literal["seen"]
    serial: int = Field(ge=0)


class StepMessage(_Message):
    """Make a single frame, or restart the model from the true last frames."""

    do: Literal["step", "sync"]


class SwitchMessage(_Message):
    """Run or pause, as fast as possible or at the robot's rate, by the recorded actions or the page's."""

    do: Literal["run", "fast", "replay"]
    on: bool


class SceneMessage(_Message):
    """Begin a scene, or the same anew."""

    do: Literal["scene"]
    number: Number


class SampleMessage(_Message):
    """Change how frames are decoded; every other field is one of `Decoding`."""

    do: Literal["sample"]
    unmask_steps: int = Field(ge=1, le=16)
    temperature: Annotated[float, Field(ge=0, le=2), AfterValidator(partial(round, ndigits=1))]
    order: Literal["random", "confidence"]


Message = (
    OpenMessage | ResumeMessage | DriveMessage | SeenMessage
    | StepMessage | SwitchMessage | SceneMessage | SampleMessage
)  # fmt: skip
_MESSAGES: TypeAdapter[Message] = TypeAdapter(Annotated[Message, Field(discriminator="do")])


def parse(text: str) -> Message:
    """Return the message of a page.

    Raises:
        UsageError: it is none of the messages; the text says why.
    """
    try:
        return _MESSAGES.validate_json(text)
    except ValidationError as fault:
        first = fault.errors(include_url=False, include_input=False)[0]
        where = ".".join(map(str, first["loc"])) or "message"
        raise UsageError(where, first["msg"]) from fault


def frame_bytes(frame: Frame, facts: dict[str, Any], serial: int) -> bytes:
    """Return a frame as the server sends it."""
    about = {
        "serial": serial,
        "frame": frame.number,
        "psnr": frame.psnr,
        "still": frame.still,
        "model": len(frame.model),
    }
    header = json.dumps(about | facts).encode()
    return struct.pack(">H", len(header)) + header + frame.model + (frame.true or b"")
