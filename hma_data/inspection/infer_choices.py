"""Choose which keys of a recording are cameras, actions, states and words, by their names and shapes.

The words in a key's name say whether it is an action or a measurement, a gripper or a base, or noise. Where
they do not decide, the choice carries a question, which becomes a TODO in the YAML. `STEP_GUESSES` lists, in
order, how the action of a recording made of steps is found; `infer_topics` has the guesses for bags.
"""

import math
import re
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from hma_data.sources.common.inspection import KeyInfo
from hma_data.sources.common.places import natural
from hma_data.sources.hdf5.videos import FILE, is_video

MAX_DIMS = 4096  # of a component


def _set(text: str) -> frozenset[str]:
    return frozenset(text.split())


NOISE = _set("""
    reward rewards return returns discount done dones terminal terminate success is embedding embeddings
    language instruction text image images img depth mask masks segmentation flow timestamp timestamps stamp
    stamps index idx id episode seq layout covariance calibration intrinsic intrinsics extrinsic extrinsics
    camera cameras info matrix width height distortion imu battery temperature wrench force forces torque
    torques effort efforts contact contacts tactile object objects obj cube obstacle bbox bounds attention
    feature features latent latents rosout diagnostics clock log parameter tf marker markers map scan cloud
    pointcloud color colour pad padding next acceleration accelerations acc error errors duration status
    feedback result event events environment noise time version crc checksum tick mode reserve reserved
    counter heartbeat kp kd stiffness damping tau
""")
_COMMANDS = (
    (5, _set("action actions command commands commanded cmd cmds cmdvel")),
    (4, _set("desired target targets setpoint setpoints")),
    (3, _set("leader leaders master teleop gello")),
    (1, _set("goal control controls reference ref joy spacemouse actuation actuations")),
)
MEASURED = _set("actual measured current feedback state states observed odom odometry")
STATES = _set("""
    state states joint joints jointstates qpos proprio proprioception pose eef ee tcp effector tool position
    positions pos endpose gripper odom odometry encoder encoders xyz
""")
MOTION = _set("velocity velocities vel vels qvel jvel twist dq qd")
PLACE = _set("position positions pos pose poses qpos angle angles q")
BASE = _set("base displacement torso waist head body chassis wheel wheels")
ROTATION = _set("rotation rot quat quaternion orientation euler rpy axis angular")
JOINT = _set("joint joints qpos")
CARTESIAN = _set("cartesian eef ee tcp end")
GIVEN_WORDS = _set("go start src box delta")  # poses that are given, not measured
SIDES = _set("left right l r")
_GRIPPER = _set("gripper grippers grip closedness close closed open finger fingers")
_WHOLE_STATE = re.compile(r"(robot_)?(state|proprio|proprioception|obs)|qpos|agent_pos")
_OTHER_NUMBERS = re.compile(r"_(cos|sin|currents|current_values?)$")  # amperes, of AgiBot's joints
_OBSERVED = re.compile(r"(^|[/.])(obs|observations?)([/.]|$)", re.IGNORECASE)
_NEXT = re.compile(r"(^|[/.])next([_./]|$)", re.IGNORECASE)


def words(key: str) -> list[str]:
    """Return the lower-case words of a key, without digits: robot0_eefPos -> robot, eef, pos."""
    return re.findall(r"[a-z]+", re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", key).lower())


def _snake(key: str) -> str:
    return "_".join(words(key))


def _last(key: str) -> str:
    return re.split(r"[/.]", key)[-1]


def shown(keys: Iterable[str], most: int = 12) -> str:
    """Return keys as one line of text; of more than `most`, the first ones and the number of the others."""
    listed = [" ".join(key.split())[:120] for key in keys]
    return ", ".join(listed[:most]) + (f" and {len(listed) - most} more" if len(listed) > most else "")


def dims(key: KeyInfo) -> int:
    """Return the number of values a sample; 0 where a component could not hold the key."""
    count = math.prod(key.shape)
    return count if key.key and min(key.shape, default=1) > 0 and count <= MAX_DIMS else 0


def _is_next(key: str) -> bool:  # robomimic's next_obs, LeRobot's next.reward
    return bool(_NEXT.search(key))


def _is_observed(key: str) -> bool:
    return bool(_OBSERVED.search(key))


def is_gripper(key: str) -> bool:
    """Check whether a key's name says that it is a gripper."""
    said = set(words(key))
    return bool(said & _GRIPPER or ("effector" in said and "end" not in said))


def _is_whole_state(key: str) -> bool:
    return bool(_WHOLE_STATE.fullmatch(_snake(_last(key))))


def strength(said: Iterable[str]) -> int:
    """Return how clearly words name an action; 0 for not at all."""
    said = set(said)
    return next((rank for rank, names in _COMMANDS if said & names), 0)


def vectors(keys: Iterable[KeyInfo]) -> list[KeyInfo]:
    """Return the keys of numbers that could be part of an action or a state."""
    numbers = [key for key in keys if key.kind == "vector" and dims(key) and not _is_next(key.key)]
    return [
        key
        for key in numbers
        if not NOISE & set(words(key.key)) and not _OTHER_NUMBERS.search(_snake(key.key))
    ]


MIN_SIDE, MAX_RATIO = 8, 8  # of a camera's image
MONO = ("mono8", "mono16")  # encodings that say: a grey camera
_NOT_CAMERA = re.compile(
    r"(^|_)(depth|disparity|masks?|seg|segmentation|semantic|instance|infra|infrared|ir|thermal|labels?|"
    r"normals?|flow|heatmap|features?|embedding|goal|tactile|gelsight)(_|$)"
)
_WRIST = re.compile(r"wrist|gripper|eye_?in_?hand|(^|[^a-z])(hand|eih)([^a-z]|$)", re.IGNORECASE)
_THIRD = re.compile(r"primary|main|static|agent|front|top|high|exterior|scene|third|head|over", re.IGNORECASE)
_TWIN = re.compile(r"/(compressed|theora|ffmpeg|h264|zstd)$")
_PICTURE = re.compile(
    r"compressed|images?|img|raw|colou?r|rgba?|obs|observations?|rect|video|data|theora|ffmpeg|pixels"
)
_INSTRUCTION = ("instruction", "instructions", "language", "task", "prompt", "goal", "command")


@dataclass(frozen=True)
class Choice:
    """Keys taken for one purpose, and the question to ask about them.

    Attributes:
        measured: True where the keys are no actions, but what was measured one step later.
    """

    keys: tuple[KeyInfo, ...] = ()
    question: str = ""
    measured: bool = False


# -- cameras


def cameras(keys: Iterable[KeyInfo]) -> Choice:
    """Choose the cameras, third-person before wrist: those in colour, then those whose messages say mono.

    Other grey ones are taken only where there are no such cameras, and with a question.
    """
    usable = [key for key in keys if _is_camera(key)]
    colour = _ordered(key for key in usable if key.shape[2] == 3)
    mono = _ordered(key for key in usable if key.shape[2] == 1 and key.encoding in MONO)
    grey = _ordered(key for key in usable if key.shape[2] == 1 and key.encoding not in MONO)
    asked = "only grey images are recorded; are these cameras, not depth or masks?"
    return Choice(colour + mono or grey, asked if grey and not colour + mono else "")


def _ordered(found: Iterable[KeyInfo]) -> tuple[KeyInfo, ...]:
    return tuple(sorted(_one_of_twins(list(found)), key=lambda key: (_rank(key.key), natural(key.key))))


def _is_camera(key: KeyInfo) -> bool:
    if key.kind != "camera" or len(key.shape) != 3 or key.shape[2] not in (1, 3) or not key.key:
        return False
    short, long = sorted(key.shape[:2])
    named_so = _NOT_CAMERA.search(_snake(key.key)) or _is_next(key.key)
    return short >= MIN_SIDE and long <= MAX_RATIO * short and not named_so


def _one_of_twins(found: list[KeyInfo]) -> list[KeyInfo]:
    """Keep one topic of each camera: raw or compressed, whichever has more messages; raw if about equal."""
    groups: dict[str, list[KeyInfo]] = defaultdict(list)
    for key in found:
        groups[_TWIN.sub("", key.key)].append(key)
    fullest = {name: max(key.count or 0 for key in group) for name, group in groups.items()}
    return [
        max(group, key=lambda key: ((key.count or 0) >= 0.9 * fullest[name], key.codec == "raw"))
        for name, group in groups.items()
    ]


def _rank(key: str) -> int:
    if _WRIST.search(key):
        return 2
    return 0 if _THIRD.search(key) or not _is_telling(_last(key)) else 1


def _is_telling(part: str) -> bool:
    """Check whether a part of a camera's key says more than that it is an image."""
    return any(not _PICTURE.fullmatch(word) for word in words(part))


def camera_names(found: Iterable[KeyInfo]) -> list[str]:
    """Return short, distinct names: from the last telling part of each key, the whole key, or a number."""
    keys = [key.key for key in found]
    wrists = [key for key in keys if _rank(key) == 2]
    for name in (_short_name, _plain):
        names = ["wrist" if [key] == wrists else name(key) for key in keys]
        if len(set(names)) == len(names):
            return names
    return [f"camera_{i}" for i in range(len(keys))]


def _short_name(key: str) -> str:
    if is_video(key):
        key = key.rpartition(".")[0].replace(FILE, "")
    telling = [part for part in re.split(r"[/.]", key) if _is_telling(part)]
    if not telling:
        number = re.search(r"\d", _last(key))
        return _plain(_last(key)) if number else "primary"
    said = [word for word in re.split(r"[_-]", telling[-1]) if not _PICTURE.fullmatch(word.lower())]
    return _plain("_".join(said).removeprefix("robot0_"))[:40]


def _plain(key: str) -> str:
    return re.sub(r"[^A-Za-z0-9_-]+", "_", key).strip("_-")[:100] or "camera"


# -- actions


def whole_action(found: list[KeyInfo]) -> Choice:
    """Choose the key that is called action; of several, the one nearest to the root."""
    outside = _not_observed(found)
    whole = [key for key in outside if _last(key.key).lower() in ("action", "actions")]
    if not whole:
        return Choice()
    chosen = min(whole, key=lambda key: len(re.split(r"[/.]", key.key)))
    beside = [key for key in outside if _is_beside(key, chosen)]
    return Choice((chosen,), question((chosen,), beside) if beside else "")


def action_group(found: list[KeyInfo]) -> Choice:
    """Choose the keys inside a group called action; leave out parts of the base that never move."""
    inside = re.compile(r"(actions?|action_dict)[/.]", re.IGNORECASE)
    group = [key for key in _not_observed(found) if inside.match(key.key)]
    group = [key for key in group if "robot_state" not in _snake(key.key)]
    moved = [key for key in group if not (key.constant and BASE & set(words(key.key)))]
    if not moved:
        return Choice(_ordered_parts(group))
    parts = _ordered_parts(moved)
    asked = []
    if others := [key for key in moved if key not in parts]:
        asked.append(question(parts, others))
    if still := shown(key.key for key in group if key not in moved):
        asked.append(
            f"{still} never changes in the sampled episode and is left out; does it change in others?"
        )
    return Choice(parts, " ".join(asked))


def named_otherwise(found: list[KeyInfo]) -> Choice:
    """Choose the keys whose names say action in other words: command, target, leader, control."""
    named: list[KeyInfo] = []
    for pool in (_not_observed(found), found):
        named = named or [key for key in pool if _command_strength(key) > 0]
    if not named:
        return Choice()
    strongest = max(map(_command_strength, named))
    chosen = [key for key in named if _command_strength(key) == strongest]
    if all(is_gripper(key.key) for key in chosen):  # some other key must move the arm
        chosen += [key for key in _not_observed(found) if MOTION & set(words(key.key))]
    parts = _ordered_parts(chosen)
    return Choice(parts, question(parts, [key for key in found if key not in parts]))


def _command_strength(key: KeyInfo) -> int:
    said = set(words(key.key))
    return 0 if said & MEASURED else strength(said)


def _not_observed(found: list[KeyInfo]) -> list[KeyInfo]:
    return [key for key in found if not _is_observed(key.key)]


def _is_beside(key: KeyInfo, chosen: KeyInfo) -> bool:
    """Check whether a key is another action: of base or gripper, or another encoding in the same group."""
    said = set(words(key.key))
    if key == chosen or not said & {"action", "actions"} or "dict" in said:
        return False
    group = chosen.key[: -len(_last(chosen.key))]
    same_group = bool(group) and key.key.startswith(group)
    return same_group or is_gripper(key.key) or bool(said & (BASE | SIDES))


def _ordered_parts(parts: Iterable[KeyInfo]) -> tuple[KeyInfo, ...]:
    """Return each quantity once: translations or joints, then rotations, base, and the gripper last."""
    return tuple(sorted(_each_once(list(parts)), key=_place))


def _each_once(parts: list[KeyInfo]) -> list[KeyInfo]:
    """Remove second encodings of one action: velocities beside positions, poses beside joints, the whole."""

    def what(key: KeyInfo) -> frozenset[str]:
        return frozenset(words(key.key)) - PLACE - MOTION

    parts = [key for key in parts if not _is_whole_of(key, parts)]
    placed = {what(key) for key in parts if PLACE & set(words(key.key))}
    parts = [key for key in parts if not (MOTION & set(words(key.key)) and what(key) in placed)]
    arms = [key for key in parts if not is_gripper(key.key)]
    poses = [key for key in arms if CARTESIAN & set(words(key.key))]
    if poses and any(JOINT & set(words(key.key)) for key in arms):
        parts = [key for key in parts if key not in poses]
    return parts


def _is_whole_of(key: KeyInfo, parts: list[KeyInfo]) -> bool:
    """Check whether a key repeats all others of its group: as many values, in the same range."""
    group = key.key[: -len(_last(key.key))]
    others = [one for one in parts if one != key and group and one.key.startswith(group)]
    ends = [end for one in others for end in (one.low, one.high) if end is not None]
    if len(others) < 2 or dims(key) != sum(map(dims, others)):
        return False
    return not ends or (key.low, key.high) == (min(ends), max(ends))


def _place(key: KeyInfo) -> int:
    said = set(words(_last(key.key)))
    if is_gripper(key.key):
        return 3
    if said & BASE:
        return 2
    return 1 if said & ROTATION else 0


def question(chosen: Iterable[KeyInfo], others: Iterable[KeyInfo]) -> str:
    """Return the question that `validate` reports for an action chosen among several keys."""
    more = shown(key.key for key in others)
    return f"is {shown(key.key for key in chosen)} the action{f'; also recorded: {more}' if more else ''}?"


# -- states and words


def states(found: list[KeyInfo], taken: Iterable[KeyInfo]) -> tuple[KeyInfo, ...]:
    """Choose the robot's own state: the key of the whole state, else every position of the robot."""
    taken = list(taken)
    named = [key for key in found if key not in taken and _is_state(key)]
    named = [key for key in named if _is_observed(key.key)] or named
    whole = [key for key in named if _is_whole_state(key.key)]
    if whole:
        return (whole[0],)
    names = {_snake(_last(key.key)) for key in named}
    repeated = ("ee_pos", "ee_ori") if "ee_states" in names else ()  # in LIBERO
    named = [key for key in named if _snake(_last(key.key)) not in repeated]
    # Outside the observations, `states` is the state of a simulator.
    own = [key for key in named if _is_observed(key.key) or _snake(_last(key.key)) != "states"]
    return tuple(sorted(own, key=_place))


def _is_state(key: KeyInfo) -> bool:
    said = set(words(key.key))
    grips = is_gripper(key.key)
    if not key.dtype.startswith("float") and not (grips and key.dtype == "bool"):
        return False
    if strength(said) or said & (MOTION | GIVEN_WORDS):
        return False
    return grips or bool(said & (STATES | ROTATION)) or _is_whole_state(key.key)


def stand_in(chosen: Sequence[KeyInfo], found: Iterable[KeyInfo], asked: str, measured: bool) -> Choice:
    """Return keys that no name calls an action, with the question whether they may stand for one."""
    others = shown(key.key for key in found if key not in chosen)
    return Choice(tuple(chosen), asked + (f", or which of {others} is it?" if others else "?"), measured)


def likely(found: list[KeyInfo]) -> Choice:
    """Choose what may be an action where no name says so: the robot's own position, else any float vector."""
    own = states(found, ())
    joints = [key for key in own if JOINT & set(words(key.key))]
    chosen = joints or own or [key for key in found if key.dtype.startswith("float")]
    if not chosen:
        return Choice()
    when = ", as measured a step later," if own else ""
    asked = f"no key is named like an action; may {shown([chosen[0].key])}{when} be the action"
    return stand_in(chosen[:1], found, asked, bool(own))


def next_poses(found: list[KeyInfo]) -> Choice:
    """Choose RH20T's pose and width of the next sample, which stand for an action."""
    chosen = tuple(key for key in found if key.key in ("tcp_base/tcp", "gripper/gripper_info"))
    asked = f"may {shown(key.key for key in chosen)} of the next sample be the action?"
    return Choice(chosen, asked if chosen else "", measured=True)


Guess = Callable[[list[KeyInfo]], Choice]
STEP_GUESSES: tuple[Guess, ...] = (whole_action, action_group, named_otherwise, likely)
RH20T_GUESSES: tuple[Guess, ...] = (next_poses, likely)


def instruction(keys: Iterable[KeyInfo]) -> str | None:
    """Return the key of the language instruction; None where there is none."""
    ranked = []
    for key in keys:
        said = words(key.key)
        rank = next((i for i, name in enumerate(_INSTRUCTION) if name in said), None)
        letters = _snake(_last(key.key)) == "instruction" and key.dtype.startswith("int")
        if key.key and rank is not None and (letters or key.kind == "text") and not _is_next(key.key):
            second = bool({"embedding", "id", "type", "structured"} & set(said))
            ranked.append((second, rank, len(key.key), key.key))
    return min(ranked)[3] if ranked else None
