"""Find which topics of a bag drive the robot and which measure it, and how far apart messages are."""

import re
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import replace
from operator import itemgetter

from hma_data.episodes.offset import Offset
from hma_data.inspection.infer_choices import (
    JOINT,
    MEASURED,
    MOTION,
    PLACE,
    SIDES,
    STATES,
    Choice,
    is_gripper,
    question,
    shown,
    stand_in,
    strength,
    words,
)
from hma_data.sources.bags.clocks import Clock, apart
from hma_data.sources.common.inspection import KeyInfo, TopicInfo

_COMMAND_TYPE = re.compile(r"(Twist|JointTrajectory|Command|Cmd|Ackermann|Joy)[A-Za-z]*$")
_NEVER = re.compile(r"(^|/)(rosout|parameter_events|clock|diagnostics|_action)(/|$)|_service_event$")
SLOWEST_HZ = 1.0  # a topic with a lower rate is no stream of actions or states
WEAK = 1  # strength of a topic called goal, control or joy; see `strength`
MARGIN = 1.5  # factor on the longest interval measured

Topic = tuple[KeyInfo, ...]


def _topics(found: Iterable[KeyInfo]) -> list[Topic]:
    """Return the vectors of each topic that is a stream or whose rate is unknown."""
    groups: dict[str, list[KeyInfo]] = defaultdict(list)
    for key in found:
        if key.topic and not _NEVER.search(key.topic.name) and (key.hz is None or runs(key)):
            groups[key.topic.name].append(key)
    return [tuple(group) for group in groups.values()]


def runs(key: KeyInfo) -> bool:
    """Check whether a key's topic is a stream, not an occasional message."""
    return key.hz is not None and key.hz >= SLOWEST_HZ


def commanding_topics(found: list[KeyInfo]) -> Choice:
    """Choose the topics that drive the robot: the clearest, its twin of the other arm, and grippers."""
    ranked = [(_rank(topic), topic) for topic in _topics(found)]
    commanding = sorted((pair for pair in ranked if pair[0][0] > 0), key=itemgetter(0), reverse=True)
    if not commanding:
        return Choice()
    best = commanding[0][1]
    chosen = [
        topic
        for _, topic in commanding
        if topic == best
        or _other_side(topic, best)
        or (is_gripper(_name(topic)) and not is_gripper(_name(best)))
    ]
    chosen.sort(key=lambda topic: (is_gripper(_name(topic)), _name(topic)))
    fields = [key for topic in chosen for key in _commanded_fields(topic)]
    keys = tuple(key for key in fields if not _rests(key, fields))
    still = shown(key.key for key in fields if key not in keys)
    asked = []
    if still:
        asked.append(f"{still} never changes in the sampled bag and is left out; does it change in others?")
    others = [topic[0] for _, topic in commanding if topic not in chosen]
    (clear, _, ticks, *_), _ = commanding[0]
    if clear <= WEAK or not ticks:
        others += [key for key in found if key not in keys and key not in others]
    if others or clear <= WEAK or not ticks:
        asked.insert(0, question(keys, others))
    return Choice(keys, " ".join(asked))


def measured_topics(found: list[KeyInfo]) -> Choice:
    """Choose the robot's own state as its action: one topic, or the same topic of both arms."""
    own = states(found, ())
    joints = [key for key in own if JOINT & set(words(key.key))] or list(own)
    if not joints:
        return Choice()
    first = joints[0]
    named = {_name((key,)): key for key in joints}  # one key a topic
    chosen = [key for key in named.values() if key == first or _other_side((key,), (first,))]
    asked = f"no topic holds commands; may {shown(key.key for key in chosen)}, as measured, be the action"
    return stand_in(chosen, found, asked, measured=False)


def _name(topic: Topic) -> str:
    return topic[0].topic.name if topic[0].topic else topic[0].key


def _path(key: KeyInfo) -> str:
    """Return the part of a key after the topic."""
    return key.key[len(key.topic.name) :] if key.topic else key.key


def _rank(topic: Topic) -> tuple[int, bool, bool, float, int]:
    """Return (strength as an action, whether it is an arm's, whether its rate is known, rate, messages).

    Strength 0 is no action. Of equally strong topics, a gripper is behind its arm.
    """
    said, first = set(words(_name(topic))), topic[0]
    inside = {word for key in topic for word in words(_path(key))}
    clear = strength(said)
    if clear < 3 and said & MEASURED:
        clear = 0
    if "desired" in inside:
        clear = max(clear, 4)
    elif _COMMAND_TYPE.search(first.topic.type if first.topic else "") and not said & MEASURED:
        clear = max(clear, 2)
    is_arm = not is_gripper(_name(topic))
    return clear, is_arm, first.hz is not None, first.hz or 0.0, first.count or 0


def _other_side(topic: Topic, best: Topic) -> bool:
    """Check whether a topic is the same as `best`, but of the other arm."""
    names = [re.findall(r"[a-z]+|\d+", _name(item).lower()) for item in (topic, best)]
    sides = [SIDES & set(name) for name in names]
    rests = [[word for word in name if word not in SIDES] for name in names]
    return topic != best and rests[0] == rests[1] and bool(sides[0] and sides[1]) and sides[0] != sides[1]


def _commanded_fields(topic: Topic) -> list[KeyInfo]:
    """Return the fields of a topic that are the action: desired values, and of these positions, if any."""
    desired = [key for key in topic if {"desired", "reference"} & set(words(_path(key)))]
    fields = desired or list(topic)
    # Whole numbers beside others are modes, counters and checksums.
    moving = [key for key in fields if not key.dtype.startswith(("int", "uint")) or is_gripper(key.key)]
    return _positions(moving or fields)


def _rests(key: KeyInfo, fields: list[KeyInfo]) -> bool:
    """Check whether a field never changes while others of its message do; the halves of a Twist stay."""
    beside = [one for one in fields if _name((one,)) == _name((key,)) and not one.constant]
    return key.constant and bool(beside) and not key.key.endswith((".linear", ".angular"))


def _positions(fields: list[KeyInfo]) -> list[KeyInfo]:
    """Remove velocities where the same message has positions."""
    where = [key for key in fields if PLACE & set(words(_path(key)))]
    return [key for key in fields if not MOTION & set(words(_path(key)))] if where else fields


def states(found: list[KeyInfo], taken: Iterable[KeyInfo]) -> tuple[KeyInfo, ...]:
    """Return what topics measure of the robot: joints and poses, not velocities or actions."""
    used = {_name((key,)) for key in taken}
    own = [topic for topic in _topics(found) if _name(topic) not in used and not _rank(topic)[0]]
    keys: list[KeyInfo] = []
    for topic in own:
        fields = [key for key in topic if not {"desired", "reference", "error"} & set(words(_path(key)))]
        fields = [key for key in _positions(fields) if not MOTION & set(words(key.key))]
        keys += [key for key in fields if STATES & set(words(key.key))]
    return tuple(key for key in keys if key.hz is not None)


# -- clocks


def about(keys: Iterable[KeyInfo]) -> list[TopicInfo]:
    """Return the topics of those keys, each once."""
    return list(dict.fromkeys(key.topic for key in keys if key.topic))


def why_by_receipt(keys: Sequence[KeyInfo]) -> str:
    """Return why receipt may time all these topics, for the user to confirm; empty where header stamps do.

    The first key is the primary camera's.
    """
    used = about(keys)
    if not used or any(topic.receipt_goes_back for topic in used):
        return ""  # receipt cannot replace the header stamps
    if back := [topic.name for topic in used if topic.goes_back]:
        # Receipt joins the runs before and after; `segments` would keep them apart.
        return f"header stamps of {shown(back)} go back in time"
    period_s = 1 / keys[0].hz if keys[0].hz else 0.0
    for topic in used[1:]:
        if reason := apart(_clock(used[0]), _clock(topic), period_s):
            return reason
    return ""


def _clock(topic: TopicInfo) -> Clock:
    by_header = topic.delay_ms is not None
    return Clock(topic.name, by_header, (topic.delay_ms or 0.0) / 1e3, topic.drift_ms / 1e3)


def timed_by_receipt(key: KeyInfo) -> KeyInfo:
    """Return a key with the timing of its topic by receipt in place of that by header stamps."""
    if key.topic is None:
        return key
    timing = key.topic.by_receipt
    topic = replace(key.topic, gap_ms=timing.gap_ms, offsets=timing.offsets)
    return replace(key, hz=timing.hz, jitter_ms=timing.jitter_ms, topic=topic)


def offsets(actions: Iterable[KeyInfo], camera: KeyInfo) -> dict[str, Offset]:
    """Return by topic how the actions lie between the frames of that camera."""
    name = camera.topic.name if camera.topic else ""
    return {topic.name: one for topic in about(actions) for one in topic.offsets if one.camera == name}


def told(found: dict[str, Offset]) -> list[str]:
    """Return one line for each topic, or for all of them where they say the same."""
    lines = {name: str(offset) for name, offset in found.items()}
    if len(set(lines.values())) == 1:
        return [*lines.values()][:1]
    return [f"{name}: {line}" for name, line in lines.items()]


def max_skew_ms(
    cameras: Iterable[KeyInfo], actions: Iterable[KeyInfo], states: Iterable[KeyInfo]
) -> int | None:
    """Return how many ms values may be moved: the longest interval measured, with a margin; None without any.

    A held action may be as old as one interval. A nearest or interpolated value is off by half of one.
    """
    held = [topic.gap_ms for topic in about(actions)]
    near = [topic.gap_ms for topic in about([*cameras, *states])]
    gaps = [gap for gap in held if gap and gap > 0] + [gap / 2 for gap in near if gap and gap > 0]
    if not gaps or not max(gaps) < 1e9:
        return None
    wanted = max(gaps) * MARGIN - 0.01  # differences of large stamps give 40.0001 for 40 ms
    step = 5 if wanted < 100 else 50 if wanted < 1000 else 500
    return max(int(-(-wanted // step) * step), step)
