"""Write recorded episodes of a third-party simulator in the format of the robot's embodiment.

The keys are those of the embodiment. Every format also gets the task in words, what the simulator calls a
success, and how the episode was made: its seed, number, style and copy.

T frames, H×W pixels, A values of a command, S of the robot's state, O of the objects' places.
"""

from collections.abc import Iterable, Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.lab.writers import (
    Demo,
    LeRobotEpisode,
    Message,
    RldsEpisode,
    ros_value,
    write_hdf5,
    write_lerobot,
    write_mcap,
    write_rlds,
)
from hma_data.registry.embodiment import Embodiment

EPOCH_NS = 1_700_000_000_000_000_000  # start of the first bag's stamps; episodes are a minute apart


@dataclass(frozen=True)
class Recorded:
    """One episode of T frames."""

    number: int
    copy: int  # 0 for the original, k for its copy under k times the noise
    seed: int
    style: str  # scripted, noised or random; of a copy, that of the original
    task: str  # in words
    pictures: NDArray[np.uint8]  # (T, H, W, 3) RGB
    states: NDArray[np.float64]  # (T, S), seen with the picture
    objects: NDArray[np.float64]  # (T, O), seen with the picture
    commands: NDArray[np.float32]  # (T, A), in force from the picture to the next
    done: NDArray[np.bool_]  # (T,), whether the simulator calls it a success after the command

    @classmethod
    def load(cls, path: Path) -> "Recorded":
        """Read an episode that was stored with numpy's savez."""
        with np.load(path) as stored:
            return cls(**{key: values if values.ndim else values.item() for key, values in stored.items()})

    @property
    def success(self) -> bool:
        """Return whether the simulator called it a success at some frame."""
        return bool(self.done.any())

    @property
    def facts(self) -> dict[str, str | int]:
        """Return how the episode was made; `copy_of` only for a copy."""
        facts: dict[str, str | int] = {"style": self.style, "seed": self.seed, "episode": self.number}
        return facts | ({"copy_of": self.number, "perturbed": self.copy} if self.copy else {})


def as_hdf5(path: Path, embodiment: Embodiment, episodes: Iterable[Recorded]) -> None:
    """Write one file in robomimic's layout; the objects' places are `obs/objects`."""
    assert embodiment.state
    image, state = (
        key.removeprefix("obs/") for key in (embodiment.cameras[0].key, embodiment.state.components[0].key)
    )

    def demos() -> Iterator[Demo]:
        for episode in episodes:
            yield Demo(
                actions=episode.commands,
                observations={image: episode.pictures, state: episode.states, "objects": episode.objects},
                states=np.concatenate([episode.states, episode.objects], axis=1),
                rewards=episode.done.astype(np.float64),
                success=episode.success,
                facts=episode.facts | {"language_instruction": episode.task},
            )

    kwargs = {"control_freq": embodiment.rate_hz}
    write_hdf5(path, demos(), {"env_name": embodiment.id, "type": 2, "env_kwargs": kwargs})


def as_rlds(path: Path, embodiment: Embodiment, episodes: Iterable[Recorded]) -> None:
    """Write a TFDS folder with PNG pictures; success and facts are `episode_metadata`."""
    camera = embodiment.cameras[0]
    assert camera.size and embodiment.state
    action, state = embodiment.action.components[0].key, embodiment.state.components[0].key

    def steps() -> Iterator[RldsEpisode]:
        for episode in episodes:
            vectors = {
                action: episode.commands,
                state: episode.states.astype(np.float32),
                "observation/objects": episode.objects.astype(np.float32),
            }
            facts = {"success": episode.success, **episode.facts}
            yield RldsEpisode({camera.key: list(map(_png, episode.pictures))}, vectors, episode.task, facts)

    write_rlds(path, embodiment.id, {camera.key: camera.size}, "png", steps())


def as_lerobot(path: Path, embodiment: Embodiment, episodes: Iterable[Recorded]) -> None:
    """Write a LeRobotDataset; its metadata has no place for how an episode was made."""
    key = embodiment.cameras[0].key
    rows = (
        LeRobotEpisode(
            {key: episode.pictures},
            episode.commands,
            episode.states.astype(np.float32),
            episode.task,
            {
                "observation.environment_state": episode.objects.astype(np.float32),
                "next.success": episode.done[:, None],
            },
        )
        for episode in episodes
    )
    write_lerobot(path, embodiment, rows)


def as_bags(path: Path, embodiment: Embodiment, episodes: Iterable[Recorded]) -> None:
    """Write a folder of MCAP files, one an episode, for an arm that is moved by steps of its hand.

    The camera's topic is the embodiment's. /servo/command has the steps x, y, z, /gripper/command the last
    value, /joint_states the state and /objects the places. A command is stamped 2 to 8 ms after its picture,
    when a controller would have computed it.
    """
    path.mkdir()
    for episode in episodes:
        rng = np.random.default_rng((episode.seed, episode.number, episode.copy))
        start, period = EPOCH_NS + episode.number * 60_000_000_000, round(1e9 / embodiment.rate_hz)
        messages = [
            message
            for row in range(len(episode.commands))
            for message in _messages(embodiment, episode, row, start + row * period, rng)
        ]
        facts = {key: str(value) for key, value in episode.facts.items()}
        facts |= {
            "robot": embodiment.id,
            "success": str(episode.success).lower(),
            "instruction": episode.task,
        }
        name = f"episode_{episode.number:04d}" + (f"_copy_{episode.copy}" if episode.copy else "")
        write_mcap(path / f"{name}.mcap", messages, facts)


def _messages(
    embodiment: Embodiment, episode: Recorded, row: int, stamp: int, rng: np.random.Generator
) -> Iterator[Message]:
    """Yield the messages of one row; each is received up to 2 ms after its stamp, pictures 12 to 20 ms."""
    command, computed = episode.commands[row].tolist(), stamp + int(rng.integers(2_000_000, 8_000_000))
    vector = "geometry_msgs/msg/Vector3"
    linear, turn = ros_value(vector, *command[:3]), ros_value(vector, 0.0, 0.0, 0.0)
    picture = {"format": "png", "data": np.frombuffer(_png(episode.pictures[row]), np.uint8)}
    image, twist = "sensor_msgs/msg/CompressedImage", "geometry_msgs/msg/TwistStamped"
    moved = {"twist": ros_value("geometry_msgs/msg/Twist", linear=linear, angular=turn)}
    assert embodiment.state
    names = list(embodiment.state.names())
    places = [f"object_{axis}" for axis in range(episode.objects.shape[1])]

    def joints(topic: str, at: int, names: list[str], values: Any) -> Message:
        fields = {"name": names, "position": np.asarray(values, np.float64)}
        fields |= {"velocity": np.empty(0), "effort": np.empty(0)}
        received = at + int(rng.integers(500_000, 2_000_000))
        return Message(topic, at, received, "sensor_msgs/msg/JointState", "base", fields)

    shown = stamp + int(rng.integers(12_000_000, 20_000_000))
    yield Message(embodiment.cameras[0].key, stamp, shown, image, "camera", picture)
    yield joints("/joint_states", stamp, names, episode.states[row])
    yield joints("/objects", stamp, places, episode.objects[row])
    received = computed + int(rng.integers(500_000, 2_000_000))
    yield Message("/servo/command", computed, received, twist, "base", moved)
    yield joints("/gripper/command", computed, ["gripper"], command[3:])


def _png(picture: NDArray[np.uint8]) -> bytes:
    import cv2

    _, data = cv2.imencode(".png", picture[..., ::-1])
    return bytes(data)


WRITERS = {
    "hdf5": (as_hdf5, ".hdf5"),
    "rlds": (as_rlds, ""),
    "lerobot": (as_lerobot, ""),
    "rosbag": (as_bags, ""),
}
