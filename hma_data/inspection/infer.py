"""Write the YAML of a new robot from one of its recordings.

The YAML holds what the recording states. What the recording cannot know is written as `TODO: question`, and
`hma registry validate` lists these questions until they are answered. `infer_choices` (for bags,
`infer_topics`) decides which keys are taken.
"""

import math
import re
import statistics
from collections import Counter
from collections.abc import Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, get_args

import yaml

from hma_data.episodes.movement import Framing, framing
from hma_data.episodes.offset import Offset
from hma_data.errors import SourceError, UsageError
from hma_data.inspection import infer_topics
from hma_data.inspection.infer_choices import (
    RH20T_GUESSES,
    STEP_GUESSES,
    Choice,
    Guess,
    camera_names,
    cameras,
    dims,
    instruction,
    is_gripper,
    likely,
    shown,
    states,
    strength,
    vectors,
    words,
)
from hma_data.registry.catalog import entries
from hma_data.registry.components import Camera, Space
from hma_data.registry.embodiment import ID_PATTERN, ONE_INDEX, TODO, Embodiment, find
from hma_data.sources.base import Inspection, KeyInfo, open_source
from hma_data.sources.common.checks import Finding
from hma_data.sources.detect import detect, require_utf8
from hma_data.sources.hdf5.videos import is_video
from hma_data.storage.paths import StrPath

MAX_FLOW_CHARS = 110
MAX_HZ = 100_000  # of a rate in a YAML
TARGET_HZ = 2  # of the paper
FRAMES_PER_EPISODE = 24  # that a model should see
ACTION_GUESSES: dict[str, tuple[Guess, ...]] = {
    "rosbag": (infer_topics.commanding_topics, infer_topics.measured_topics, likely),
    "rh20t": RH20T_GUESSES,
}  # of the other formats: STEP_GUESSES
RATE_TOLERANCE = 5e-4  # relative error of a measured rate; the doubt from jittering stamps is added


class _Dumper(yaml.SafeDumper):
    """A writer of YAML in which lists of words, components and cameras are on one line each."""

    def ignore_aliases(self, data: Any) -> bool:
        return True

    def increase_indent(self, flow: bool = False, indentless: bool = False) -> None:
        """Indent the items of a list below its key."""
        super().increase_indent(flow, False)


def _mapping(dumper: _Dumper, value: dict[str, Any]) -> yaml.Node:
    node = dumper.represent_dict(value.items())
    parts = [item for each in value.values() for item in (each if isinstance(each, list) else [each])]
    node.flow_style = _on_one_line(value, parts)
    return node


def _list(dumper: _Dumper, value: list[Any]) -> yaml.Node:
    return dumper.represent_sequence("tag:yaml.org,2002:seq", value, flow_style=_on_one_line(value, value))


def _on_one_line(value: Any, parts: Iterable[Any]) -> bool:
    return not any(isinstance(part, dict) for part in parts) and len(repr(value)) < MAX_FLOW_CHARS


_Dumper.add_representer(dict, _mapping)
_Dumper.add_representer(list, _list)


def _yaml_text(values: dict[str, Any]) -> str:
    # A question stays on one line, so that an editor or a script can answer it there.
    return yaml.dump(values, Dumper=_Dumper, allow_unicode=True, width=float("inf"), sort_keys=False)


def infer(uri: StrPath, embodiment_id: str) -> str:
    """Return the YAML of an embodiment that reads `uri`.

    Args:
        uri: str or path of the recording, or its URI.
        embodiment_id: of the new embodiment.

    Raises:
        UsageError: `embodiment_id` is not an id.
        SourceError: the recording cannot be read, has a name that is not UTF-8, or has no camera or nothing
            that could be an action.
    """
    if not ID_PATTERN.fullmatch(embodiment_id) or ".." in embodiment_id:
        raise UsageError(
            "--id", f"{embodiment_id!r} is not an id", "use a-z 0-9 _ - . and begin with a letter or digit"
        )
    require_utf8(uri)
    return from_inspection(open_source(detect(uri)).inspect(uri), embodiment_id)


def from_inspection(found: Inspection, embodiment_id: str) -> str:
    """Return the YAML of an embodiment from an inspection; see `infer`."""
    if found.format == "hands":  # videos hold nothing that could be an action
        values = find("hand_video").to_dict() | {"id": embodiment_id}
        head = "A copy of hand_video, which reads any video of two hands: use it as it is, or change this one"
        beside = [f"# {one}\n" for one in found.findings if "next to them are" in one.message]
        return f"# {head}\n{''.join(beside)}{_yaml_text(values)}"
    values = _Draft(found).values(embodiment_id)
    head = f"# Inferred from source.uri; answer every {TODO}, then: hma registry validate FILE\n"
    known = _in_registry(found, values)
    return head + (f"# {known}\n" if known else "") + _yaml_text(values)


def proposal(found: Inspection) -> tuple[str, dict[str, float], dict[str, Offset]]:
    """Return what a recording lacks for `infer`, and what is known of the action that `infer` takes.

    Returns:
        "has no colour camera" and the like, empty where nothing lacks; by topic how many seconds the action
        ends before the first frame; by topic how it lies between the images of the camera that is the clock.
    """
    if found.format == "hands":  # videos need no action
        return "", {}, {}
    try:
        draft = _Draft(found)
    except SourceError as fault:
        return fault.fault.partition(";")[0], {}, {}
    topics = infer_topics.about(draft.action.keys)
    return "", {one.name: one.held_s for one in topics if one.held_s is not None}, draft.offsets


def target_hz(hz: float | None, lengths: Sequence[int]) -> float | int:
    """Return the rate for a model: the paper's, or as much more as episodes of few frames at `hz` need."""
    if not hz or not lengths:
        return TARGET_HZ
    slowest = max(1, math.floor(hz / TARGET_HZ + 0.5))
    stride = max(1, min(slowest, int(statistics.median(lengths) // FRAMES_PER_EPISODE)))
    rate = round(hz / stride, 3)
    return TARGET_HZ if stride == slowest else int(rate) if rate == int(rate) else rate


def _in_registry(found: Inspection, values: dict[str, Any]) -> str:
    """Return one line that names the embodiments which may be this robot; empty where there are none.

    They have the recording's URI; or its format, its action keys with as many values, and cameras that are
    all recorded. Where some of them name the values as the recording does, the others are left out.
    """
    components = values["action"]["components"]
    recorded, width = {key.key for key in found.keys}, sum(part["dims"] for part in components)
    at, alike, named = [], [], []
    for entry in entries():
        if not entry.facts or entry.facts["format"] != found.format:
            continue
        if entry.facts["uri"] and _place(entry.facts["uri"]) == _place(found.uri):
            at.append(entry.facts["id"])
        elif entry.facts["action_dim"] == width:
            robot = Embodiment.load(entry.path)
            parts = robot.to_dict()["action"]["components"]
            if _widths(parts) == _widths(components) and {one.key for one in robot.cameras} <= recorded:
                alike.append(robot.id)
                if _names(parts) == _names(components):
                    named.append(robot.id)
    ids = at or named or alike
    if not ids:
        return ""
    what = "for this recording:" if at else "with these keys and dims; is it this robot?"
    return f"The registry has {shown(ids, 3)} {what} hma registry show {ids[0]}"


def _place(uri: str) -> str:
    return uri.rstrip("/") if "://" in uri else str(Path(uri).resolve())


def _widths(components: Iterable[dict[str, Any]]) -> Counter[str]:
    """Return the number of values by key: one key may be cut into several components."""
    return Counter(part["key"] for part in components for _ in range(part["dims"]))


def _names(components: Iterable[dict[str, Any]]) -> list[str]:
    return [name for part in components for name in part.get("names", ())]


class _Draft:
    """The keys taken from one inspection, and the YAML made of them.

    Raises:
        SourceError: there is no camera, or nothing that could be an action.
    """

    def __init__(self, found: Inspection) -> None:
        self.found = found
        self.bag = found.format == "rosbag"
        if self.bag:  # what was measured by a clock that was set back says nothing
            keys = [_by_a_running_clock(key) for key in found.keys]
            self.found = found = replace(found, keys=tuple(keys))
        self.timed = found.format not in ONE_INDEX  # each key has its own times
        self.seen, self.looks = _showing(cameras(found.keys), found.findings)
        if not self.seen.keys:
            raise _lacks(found, "has no colour camera", [key for key in found.keys if key.kind == "camera"])
        numbers = vectors(found.keys)
        pools = [numbers]
        if not self.timed:  # HDF5 has other arrays too: take those with one row per frame
            lengths = [key.count for key in self.seen.keys]
            length = max(set(lengths), key=lengths.count)
            near = [length, (length or 0) - 1]  # there may be an observation after the last action
            alike = near[:1]
            if is_video(self.seen.keys[0].key):  # or a video may lack its last frame
                alike = near = [*near, (length or 0) + 1]
            self.seen = replace(self.seen, keys=tuple(key for key in self.seen.keys if key.count in alike))
            pools = [[key for key in numbers if key.count == count] for count in near]
        if self.bag:
            running = tuple(key for key in self.seen.keys if infer_topics.runs(key))
            self.seen = replace(self.seen, keys=running or self.seen.keys)
        rh20t = found.format == "rh20t"  # the names of its tables, not of their values, tell what they hold
        tables = [key for key in found.keys if key.kind == "vector"]
        guesses = ACTION_GUESSES.get(found.format, STEP_GUESSES)
        choices = (guess(pool) for guess in guesses for pool in ([tables] if rh20t else pools))
        self.action = next((choice for choice in choices if choice.keys), Choice())
        self.uneven = self._uneven()
        if "frames_missing" in self.uneven:
            pools = [pool for pool in pools if self.action.keys[0] in pool]
        chosen_states = infer_topics.states if self.bag else states
        self.states = chosen_states(pools[0], () if rh20t else self.action.keys)
        if not self.action.keys:
            raise _lacks(found, "has nothing that could be an action", self.seen.keys)
        self.by_receipt = infer_topics.why_by_receipt([*self.seen.keys, *self.action.keys, *self.states])
        if self.by_receipt:  # what is proposed is measured by the clock that is proposed
            received = infer_topics.timed_by_receipt
            self.seen = replace(self.seen, keys=tuple(map(received, self.seen.keys)))
            self.action = replace(self.action, keys=tuple(map(received, self.action.keys)))
            self.states = tuple(map(received, self.states))
        hz = self.seen.keys[0].hz if self.bag else found.hz
        self.hz = hz if hz is not None and 0 < hz <= MAX_HZ else None
        self.used = [*self.seen.keys, *self.action.keys, *self.states]
        self.offsets = infer_topics.offsets(self.action.keys, self.seen.keys[0])

    def values(self, embodiment_id: str) -> dict[str, Any]:
        """Return the YAML's plain values, in the order of the registry's YAMLs."""
        found, facts = self.found, self.found.facts
        name = facts.get("dataset") or found.uri.rstrip("/").rsplit("/", 1)[-1]
        spaces = get_args(Space)
        values: dict[str, Any] = {
            "id": embodiment_id,
            "description": f"{found.robot or 'robot'} as recorded in {name}",
            "robot": found.robot or f"{TODO}: which robot is it?",
            "kind": "simulation" if facts.get("simulator") else f"{TODO}: real, simulation or human?",
            "frequency_hz": self._rate() or f"{TODO}: at how many Hz were actions recorded?",
            "target_hz": target_hz(self._rate(), found.lengths),
            **({"stride": 1} if self._short_at_any_rate() else {}),
            "action": {
                "space": f"{TODO}: one of {', '.join(spaces[:-1])} or {spaces[-1]}?",
                "components": _told_apart([self._component(key) for key in self._commands()]),
            },
        }
        if self.states:
            states = [_named(key, key.names) for key in self.states]
            values["state"] = {"components": _told_apart(states)}
        values["cameras"] = self._cameras()
        if self.bag:
            values["sync"] = self._sync(values["cameras"][0]["name"])
        elif self.action.measured and not self.timed:
            values["sync"] = {"action_shift": 1}
        source = {"format": found.format, "uri": found.uri, "episodes": max(found.episodes, 1)}
        said = self._instruction()
        source |= {"instruction": said} if said else {}
        layout = {key: facts[key] for key in ("timestamps", "pixels", "pairing") if facts.get(key)}
        layout |= self.uneven
        source |= {"layout": layout} if layout else {}
        values |= {"source": source, "provenance": self._provenance()}
        taken = {key.key for key in self.used} | {said, ""}
        left = [key for key in found.keys if key.key not in taken and key.kind != "text"]
        unused = shown([key.key for key in left if not key.key.endswith(".layout.data_offset")], 20)
        return values | ({"notes": f"recorded and not used: {unused}"} if unused else {})

    def _rate(self) -> float | int | None:
        """Return the rate: 29.97 stays; 9.97 becomes 10 where the stamps jitter so much that it may be 10."""
        if self.hz is None:
            return None
        camera = self.seen.keys[0]
        doubt = 0.0  # relative error of the median interval of jittering stamps
        if self.timed and camera.jitter_ms and camera.count:
            doubt = 2.5 * camera.jitter_ms * self.hz / 1e3 / math.sqrt(camera.count)
        whole = round(self.hz)
        tolerance = RATE_TOLERANCE + (min(doubt, 0.02) if doubt == doubt else 0.0)
        return whole if whole and abs(self.hz / whole - 1) < tolerance else round(self.hz, 3) or None

    def _short_at_any_rate(self) -> bool:
        """Check whether nobody knows the rate yet, and episodes are so short that every frame is needed."""
        lengths = self.found.lengths
        return not self._rate() and bool(lengths) and statistics.median(lengths) < 2 * FRAMES_PER_EPISODE

    def _uneven(self) -> dict[str, Any]:
        """Return the keys of the layout for a frame after the last action, or missing at a video's end."""
        rows = [key.count for key in self.action.keys if key.count and not self.timed]
        more = [key.count - rows[0] for key in self.seen.keys if rows and key.count]
        drop = {"last_observation": "drop"} if max(more, default=0) > 0 else {}
        return drop | ({"frames_missing": -min(more)} if min(more, default=0) < 0 else {})

    def _commands(self) -> list[KeyInfo]:
        """Return the keys of the action as the YAML names them: of RH20T, those of the next sample."""
        keys = list(self.action.keys)
        if self.found.format == "rh20t" and self.action.measured:
            return [replace(key, key=f"{key.key}/next") for key in keys]
        return keys

    def _component(self, key: KeyInfo) -> dict[str, Any]:
        component = _named(key, key.names)
        ends = key.low in (0, -1) and key.high == 1  # in bags a gripper may also be in metres, or 0 to 255
        switch = key.dtype == "bool" or (is_gripper(key.key) and (ends or not self.bag))
        return component | ({"normalize": False} if component["dims"] == 1 and switch else {})

    def _cameras(self) -> list[dict[str, Any]]:
        doubtful = "layout" in self.found.facts and "simulator" not in self.found.facts
        asked = {"color": f"{TODO}: rgb or bgr? arrays that went through OpenCV are often bgr"}
        known = {"sure": {"color": "bgr"}, "no": {}}
        return [
            {
                "name": name,
                "key": key.key,
                "size": list(map(int, key.shape[:2])),
                **_levels(key),
                **(framed.keys if (framed := _framing(key)) else {}),
                **known.get(key.swapped or "", asked if doubtful and not is_video(key.key) else {}),
            }
            for name, key in zip(camera_names(self.seen.keys), self.seen.keys, strict=True)
        ]

    def _sync(self, primary: str) -> dict[str, Any]:
        sync: dict[str, Any] = {
            "primary": primary,
            "images": "nearest",
            "actions": "hold",
            "states": "interpolate",
        }
        # with it, `hold` gives frames their actions
        stated = (one.tolerance_ms for one in self.offsets.values() if one.tolerance_ms)
        tolerance = min(stated, default=None)
        skew = infer_topics.max_skew_ms(self.seen.keys[1:], self.action.keys, self.states)
        sync |= {"tolerance_ms": tolerance} if tolerance else {}
        sync |= {"max_skew_ms": skew} if skew else {}
        return sync | ({"stamp": "receive"} if self.by_receipt else {})

    def _instruction(self) -> str | None:
        facts = self.found.facts
        if self.found.format == "lerobot":
            return "task" if facts.get("tasks", "0") != "0" else None
        outside = [
            key
            for key in facts.get("episode keys", "").split(", ")
            if re.search(r"(^|/)(natural_)?language_instruction$", key)
        ]
        return instruction(self.found.keys) or facts.get("instruction") or next(iter(outside), None)

    def _provenance(self) -> dict[str, str]:
        said = {"frequency_hz": self._rate_from() if self.hz else f"{TODO}: where is the rate stated?"}
        if target_hz(self._rate(), self.found.lengths) != TARGET_HZ or self._short_at_any_rate():
            length = f"{statistics.median(self.found.lengths):g} steps"
            said["stride" if self._short_at_any_rate() else "target_hz"] = (
                f"so that a model sees {FRAMES_PER_EPISODE} frames of an episode of {length}, if it has them"
            )
        unread = [  # perhaps it is the action
            f"{one.message}; {one.remedy}"
            for one in self.found.findings
            if one.check == "readable" and strength(words(one.key))
        ]
        if asked := [one for one in (self.action.question, *unread) if one]:
            said["action"] = f"{TODO}: {' '.join(asked)}"
        if padded := [one.message for one in self.found.findings if one.check == "padding"]:
            said["last_step"] = "; ".join(padded)
        if self.seen.question or self.looks:
            asked = [f"{TODO}: {self.seen.question}"] if self.seen.question else []
            said["cameras"] = "; ".join([*asked, *self.looks])
        framed = [(key.key, found) for key in self.seen.keys if (found := _framing(key))]
        if told := [
            f"{key}: {found.fault}; does {found.words} contain everything relevant?" for key, found in framed
        ]:
            said["crop"] = f"{TODO}: {' '.join(told)}"
        if levels := [key.key for key in self.seen.keys if key.encoding == "mono16"]:
            said["levels"] = f"from 0 to the largest value of as many bits as {shown(levels)} uses"
        if self.bag:
            if self.offsets:
                said["sync"] = "; ".join(infer_topics.told(self.offsets))
            topics = infer_topics.about(self.used)
            gaps = shown(f"{topic.name} {topic.gap_ms:.0f} ms" for topic in topics if topic.gap_ms)
            if gaps:
                factor = f"{infer_topics.MARGIN:g} times the longest interval held"
                said["max_skew_ms"] = f"{factor}; intervals, measured: {gaps}"
            if self.by_receipt:
                said["stamp"] = f"{TODO}: {self.by_receipt}; may streams be aligned by receive times?"
            primary = self.seen.keys[0].key
            if pauses := [one for one in self.found.findings if (one.check, one.key) == ("gaps", primary)]:
                said["segments"] = str(pauses[0])
        return said

    def _rate_from(self) -> str:
        if not self.bag:
            usual = (
                "fps of the recording's meta/info.json" if self.found.format == "lerobot" else "the recording"
            )
            return self.found.facts.get("rate") or usual
        camera = self.seen.keys[0]
        moved = [key for key in (*self.action.keys, *self.states) if key.hz]
        rates = dict.fromkeys(f"{key.topic.name if key.topic else key.key} {_hz(key)}" for key in moved)
        beside = f"; others: {shown(rates)}" if rates else ""
        return f"measured: {camera.key} {_hz(camera)}{beside}"


def _by_a_running_clock(key: KeyInfo) -> KeyInfo:
    topic = key.topic
    set_back = topic is not None and topic.goes_back and not topic.receipt_goes_back
    return infer_topics.timed_by_receipt(key) if set_back else key


def _showing(seen: Choice, findings: Iterable[Finding]) -> tuple[Choice, list[str]]:
    """Return the cameras without those that show one colour in every episode, and notes on what they show.

    Where all of them do, all are kept: the recording may be all that there is.
    """
    keys = {key.key for key in seen.keys}
    found = [one for one in findings if one.check in ("blank", "still", "colour") and one.key in keys]
    never = {
        one.key for one in found if one.check == "blank" and one.numbers["blank"] == one.numbers["episodes"]
    }
    out = never if never < keys else set()
    notes = [one.message + (", and is left out" if one.key in out else "") for one in found]
    return replace(seen, keys=tuple(key for key in seen.keys if key.key not in out)), notes


def _framing(key: KeyInfo) -> Framing | None:
    """Return what of the image the YAML should show a tokenizer, where that is not the middle square."""
    if key.moves_in is None:
        return None
    return framing(Camera(name="camera", key=key.key), key.moves_in, *key.shape[:2])


def _levels(key: KeyInfo) -> dict[str, Any]:
    """Return the levels of images in mono16: all values of 10, 12, 14 or 16 bits, whichever they need."""
    if key.encoding != "mono16":
        return {}
    bits = next(bits for bits in (10, 12, 14, 16) if (key.high or 0) < 1 << bits)
    return {"levels": [0, (1 << bits) - 1]}


def _hz(key: KeyInfo) -> str:
    jitter = f" with a jitter of {key.jitter_ms:.1f} ms" if key.jitter_ms is not None else ""
    return f"{key.hz:.4g} Hz{jitter}"


def _named(key: KeyInfo, names: tuple[str, ...] | None) -> dict[str, Any]:
    """Return a component, with names where there is one for each value, which tell a quaternion."""
    count = dims(key)
    told = names if names and len(names) == count == len(set(names)) else None
    found = {"key": key.key, "dims": count} | ({"names": list(told)} if told else {})
    return found | ({"representation": "quaternion_xyzw"} if told == ("x", "y", "z", "w") else {})


def _told_apart(components: list[dict[str, Any]]) -> list[dict[str, Any]]:
    """Put the last words of the key before names that two components have: linear_x, angular_x."""
    several = Counter(name for component in components for name in component.get("names", ()))
    shared = [one for one in components if any(several[name] > 1 for name in one.get("names", ()))]
    keys = [re.split(r"\W+", one["key"].strip("/")) for one in shared]
    words = next((n for n in range(1, 9) if len({tuple(key[-n:]) for key in keys}) == len(keys)), 0)
    for one, key in zip(shared, keys, strict=True):
        if words:
            one["names"] = ["_".join([*key[-words:], name]) for name in one["names"]]
    return components


def _lacks(found: Inspection, fault: str, images: Sequence[KeyInfo]) -> SourceError:
    rows = found.format == "hdf5"  # an action has as many rows as the camera
    others = [
        f"{key.key} ({key.count} rows)" if rows else key.key for key in found.keys if key.kind == "vector"
    ]
    seen = [f"{key.key} of {key.count} rows" if rows else f"{key.key} {key.shape}" for key in images]
    said = f"{fault}; images: {shown(seen, 4) or 'none'}; numbers: {shown(others) or 'none'}"
    remedy = "record cameras and the robot's actions or joint states together; hma inspect lists every key"
    unread = next((one for one in found.findings if one.check == "readable" and one.key), None)
    if unread:  # perhaps it is what lacks
        said, remedy = f"{said}; {unread.message}", unread.remedy or remedy
    return SourceError(shown([found.uri]), said, remedy)
