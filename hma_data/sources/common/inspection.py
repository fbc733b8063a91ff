"""Define the result of inspecting a recording: its keys, with what was measured of them, and findings."""

from dataclasses import asdict, dataclass, field
from typing import Any

from hma_data.episodes.offset import Offset
from hma_data.sources.common.checks import Finding


@dataclass(frozen=True)
class Timing:
    """The timing of a topic by the times of receipt; see TopicInfo and KeyInfo."""

    hz: float | None = None
    jitter_ms: float | None = None
    gap_ms: float | None = None
    offsets: tuple[Offset, ...] = ()


@dataclass(frozen=True)
class TopicInfo:
    """The topic of a bag that holds a key, as measured from its messages.

    Attributes:
        name: of the topic.
        type: of its messages.
        gap_ms: the longest interval between two of them in which a camera saw something; of a camera, the
            longest interval; None for fewer than two.
        delay_ms: median from header stamp to receipt; None where messages carry no time.
        drift_ms: by how much the delay grows over the recording.
        goes_back: whether the clock of the header stamps was set back.
        receipt_goes_back: whether the recorder's clock was set back.
        held_s: from its last message to the first frame, where that comes later; None elsewhere.
        by_receipt: its timing by the times of receipt.
        offsets: how the messages lie between the images of each camera; of topics with numbers only.
    """

    name: str
    type: str
    gap_ms: float | None = None
    delay_ms: float | None = None
    drift_ms: float = 0.0
    goes_back: bool = False
    receipt_goes_back: bool = False
    held_s: float | None = None
    by_receipt: Timing = field(default_factory=Timing)
    offsets: tuple[Offset, ...] = ()


@dataclass(frozen=True)
class KeyInfo:
    """One key of a recording, as `hma inspect` lists it.

    Attributes:
        key: as an embodiment's YAML would name it.
        kind: camera, vector, text or other.
        shape: of one sample; images are (H, W, 3), or (H, W, 1) where they are recorded in grey.
        dtype: of the values as they are decoded.
        hz: measured or stated rate; None when unknown.
        names: of the values, where the recording has them.
        codec: of images: jpeg, png, raw, av1, h264.
        count: samples seen (of one episode, or of the whole recording when it is a topic).
        jitter_ms: standard deviation of the intervals.
        topic: the topic that holds the key; of bags only.
        constant: whether a vector never changes in the sampled episodes.
        still: indices of the values of a vector that never change in the sampled episodes.
        low, high: smallest and largest finite number in the sampled episodes; of images in mono16, their
            values before they are scaled.
        swapped: whether red and blue are swapped in the images: sure, no; None where it is unknown.
        moves_in: the box [x, y, width, height] that holds what moves in the sampled images; None where
            nothing is known to move.
        skew_ms: p50, p95 and max distance from the first camera's frames, for a stream with its own clock.
        encoding: of a bag's images, as their messages state it: rgb8, mono8, mono16.
    """

    key: str
    kind: str
    shape: tuple[int, ...]
    dtype: str
    hz: float | None = None
    names: tuple[str, ...] | None = None
    codec: str | None = None
    count: int | None = None
    jitter_ms: float | None = None
    topic: TopicInfo | None = None
    constant: bool = False
    still: tuple[int, ...] = ()
    low: float | None = None
    high: float | None = None
    skew_ms: tuple[float, float, float] | None = None
    swapped: str | None = None
    moves_in: tuple[int, int, int, int] | None = None
    encoding: str | None = None


@dataclass(frozen=True)
class Inspection:
    """The contents of a recording, found without an embodiment.

    Attributes:
        format: as `open_source` takes it.
        episodes: how many.
        frames: of all episodes together; None when counting them would need a full read.
        lengths: of the first episodes (at most 1,000).
        keys: each key once.
        robot: the robot's name in the recording.
        facts: other facts about the recording, by name.
        looked_at: how many episodes were sampled for their values and images.
        findings: what the checks found, in the order of the checks.
        checks: names of the checks that could be made; a check without a finding passed.
    """

    format: str
    uri: str
    episodes: int
    keys: tuple[KeyInfo, ...]
    frames: int | None = None
    lengths: tuple[int, ...] = ()
    hz: float | None = None
    robot: str | None = None
    facts: dict[str, str] = field(default_factory=dict)
    looked_at: int = 0
    findings: tuple[Finding, ...] = ()
    checks: tuple[str, ...] = ()

    @property
    def problems(self) -> tuple[str, ...]:
        """Return the findings that are errors or warnings, one sentence each."""
        return tuple(str(finding) for finding in self.findings if finding.severity != "info")

    def to_json(self) -> dict[str, Any]:
        """Return plain values for `--json`."""
        return asdict(self) | {"problems": list(self.problems)}
