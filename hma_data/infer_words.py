"""What the words in a key's name say: command or measurement, gripper or base, noise."""

import re
from collections.abc import Iterable

from hma_data.sources.base import KeyInfo

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
    feedback result event events environment noise
    time
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
    positions pos gripper odom odometry encoder encoders xyz
""")
MOTION = _set("velocity velocities vel vels qvel jvel twist")
PLACE = _set("position positions pos pose poses qpos angle angles")
BASE = _set("base displacement torso waist head body chassis wheel wheels")
ROTATION = _set("rotation rot quat quaternion orientation euler rpy axis angular")
JOINT = _set("joint joints qpos")
CARTESIAN = _set("cartesian eef ee tcp end")
GIVEN = _set("go start src box delta")  # poses that are given, not measured
SIDES = _set("left right l r")
_GRIPPER = _set("gripper grippers grip closedness close closed open finger fingers")
_WHOLE_STATE = re.compile(r"(robot_)?(state|proprio|proprioception|obs)|qpos|agent_pos")
_OBSERVED = re.compile(r"(^|[/.])(obs|observations?)([/.]|$)", re.IGNORECASE)
_NEXT = re.compile(r"(^|[/.])next([_./]|$)", re.IGNORECASE)


def words(key: str) -> list[str]:
    """The lower-case words of a key, without digits: robot0_eefPos -> robot, eef, pos."""
    return re.findall(r"[a-z]+", re.sub(r"(?<=[a-z0-9])(?=[A-Z])", " ", key).lower())


def snake(key: str) -> str:
    """Its words joined by underscores."""
    return "_".join(words(key))


def last(key: str) -> str:
    """What follows the last separator."""
    return re.split(r"[/.]", key)[-1]


def natural(text: str) -> list[tuple[int, str]]:
    """Sort key that puts image before image_2 before image_10."""
    return [(int(part), "") if part.isdecimal() else (-1, part) for part in re.split(r"(\d+)", text)]


def shown(keys: Iterable[str], most: int = 12) -> str:
    """Keys in one line, the first of many."""
    listed = [" ".join(key.split())[:120] for key in keys]
    return ", ".join(listed[:most]) + (f" and {len(listed) - most} more" if len(listed) > most else "")


def dims(key: KeyInfo) -> int:
    """Values a sample; 0 where it is none that a component could hold."""
    count = 1
    for side in key.shape:
        count *= max(side, 0)
    return count if key.key and count <= MAX_DIMS else 0


def is_next(key: str) -> bool:
    """Whether it is of the step after: robomimic's next_obs, LeRobot's next.reward."""
    return bool(_NEXT.search(key))


def is_observed(key: str) -> bool:
    """Whether it lies under observations."""
    return bool(_OBSERVED.search(key))


def is_gripper(key: str) -> bool:
    """Whether its name says that it opens and closes."""
    said = set(words(key))
    return bool(said & _GRIPPER or ("effector" in said and "end" not in said))


def is_whole_state(key: str) -> bool:
    """Whether its name says that it is all of the robot's state."""
    return bool(_WHOLE_STATE.fullmatch(snake(last(key))))


def strength(said: Iterable[str]) -> int:
    """How clearly words say that it is a command; 0 for not at all."""
    said = set(said)
    return next((rank for rank, names in _COMMANDS if said & names), 0)


def vectors(keys: Iterable[KeyInfo]) -> list[KeyInfo]:
    """Keys of numbers that could be part of an action or a state."""
    numbers = [key for key in keys if key.kind == "vector" and dims(key) and not is_next(key.key)]
    return [
        key
        for key in numbers
        if not NOISE & set(words(key.key)) and snake(key.key)[-4:] not in ("_cos", "_sin")
    ]
