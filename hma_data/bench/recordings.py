"""Write recordings of realistic size for `hma bench sources`, one of each format, and their YAML.

A writer takes (folder, episodes, length, seed) and returns the recording's path. Pictures are those of
`hma_data.bench.scenes`; the actions are seven smooth numbers a frame.
"""

import json
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from fractions import Fraction
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data.bench.scenes import encoded, scene
from hma_data.episodes.images import Images
from hma_data.priority import ordinary_priority
from hma_data.registry.embodiment import Embodiment

A, HZ = 7, 30
VGA, SQUARE, HD = (480, 640), (256, 256), (720, 1280)
START_NS = 1_700_000_000_000_000_000
TASK = "move the blocks"
_VIDEO_DEFINITION = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
_TYPES = {
    "jpeg": "sensor_msgs/msg/CompressedImage",
    "raw": "sensor_msgs/msg/Image",
    "h264": "foxglove_msgs/msg/CompressedVideo",
}

Writer = Callable[[Path, int, int, int], Path]


@dataclass(frozen=True)
class Case:
    """A recording to measure.

    Attributes:
        name: the format, and how pictures are stored.
        format: format of the source.
        size: (height, width) of the pictures.
        write: function that makes the recording.
        action, camera: keys of the embodiment.
        stride: stride between the frames that are read; 1 for all frames.
        extra: further top-level keys of the YAML.
    """

    name: str
    format: str
    size: tuple[int, int]
    write: Writer
    action: str
    camera: str
    stride: int = 1
    extra: dict[str, Any] | None = None

    def embodiment(self) -> Embodiment:
        """Return the embodiment that reads it."""
        values: dict[str, Any] = {
            "id": f"bench_{self.name.replace('-', '_')}",
            "kind": "simulation",
            "frequency_hz": HZ,
            "stride": self.stride,
            "action": {"space": "eef_delta", "components": [{"key": self.action, "dims": A}]},
            "cameras": [{"name": "main", "key": self.camera}],
            "source": {"format": self.format},
        }
        return Embodiment.from_values(values | (self.extra or {}), self.name)


def actions(length: int, seed: int) -> NDArray[np.float32]:
    """Return (length, A) actions that change at every frame."""
    phase = np.arange(length)[:, None] / 20 + np.random.default_rng(seed).uniform(0, 6, A)
    return np.sin(phase).astype(np.float32)


def _rlds(size: tuple[int, int], codec: str) -> Writer:
    def write(folder: Path, episodes: int, length: int, seed: int) -> Path:
        from hma_data.lab.writers import RldsEpisode, write_rlds

        def made() -> Iterator[RldsEpisode]:
            for i in range(episodes):
                files = encoded(scene(*size, length, seed + i), codec)
                yield RldsEpisode({"observation/image": files}, {"action": actions(length, i)}, TASK)

        write_rlds(folder / "rlds", "bench", {"observation/image": size}, codec, made())
        return folder / "rlds"

    return write


def _hdf5(size: tuple[int, int], kept: str) -> Writer:
    def write(folder: Path, episodes: int, length: int, seed: int) -> Path:
        import h5py

        path = folder / "demos.hdf5"
        with h5py.File(path, "w") as file:
            for i in range(episodes):
                group = file.create_group(f"data/demo_{i}")
                group["actions"] = actions(length, i)
                pictures = scene(*size, length, seed + i)
                if kept == "jpeg":
                    files = encoded(pictures, "jpeg")
                    widest = max(map(len, files))  # padded to one width, as in ALOHA's recorder
                    padded = [np.frombuffer(data.ljust(widest, b"\0"), np.uint8) for data in files]
                    group.create_dataset("obs/image", data=np.stack(padded), chunks=(1, widest))
                    continue
                packing = {"compression": "gzip", "compression_opts": 4} if kept == "gzip" else {}
                shape = (length, *size, 3)
                rows = group.create_dataset("obs/image", shape, np.uint8, chunks=(1, *size, 3), **packing)
                for row, picture in enumerate(pictures):
                    rows[row] = picture
        return path

    return write


def _bags(kind: str, kept: str) -> Writer:
    """Return a writer of one bag an episode; `kind` is ros1, mcap or sqlite3."""

    def write(folder: Path, episodes: int, length: int, seed: int) -> Path:
        for i in range(episodes):
            pictures = scene(*VGA, length, seed + i)
            packed = packets(pictures, "libx264") if kept == "h264" else _stored(pictures, kept)
            _bag(folder / f"run_{i:03d}{'.bag' if kind == 'ros1' else ''}", kind, kept, packed, length, i)
        return folder

    return write


def _stored(pictures: Iterator[Images], kept: str) -> Iterator[bytes]:
    yield from encoded(pictures, "jpeg") if kept == "jpeg" else (picture.tobytes() for picture in pictures)


def _bag(path: Path, kind: str, kept: str, packed: Iterator[bytes], length: int, seed: int) -> None:
    from rosbags.rosbag1 import Writer as Ros1Writer
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Ros2Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    store = get_typestore(Stores.ROS1_NOETIC if kind == "ros1" else Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(_VIDEO_DEFINITION, _TYPES["h264"]))
    opened: Any = (
        Ros1Writer(path)
        if kind == "ros1"
        else Ros2Writer(path, version=9, storage_plugin=StoragePlugin[kind.upper()])
    )
    command = "sensor_msgs/msg/JointState"
    serialize = store.serialize_ros1 if kind == "ros1" else store.serialize_cdr
    with opened as bag:
        camera = bag.add_connection("/camera", _TYPES[kept], typestore=store)
        arm = bag.add_connection("/command", command, typestore=store)
        for i, (data, values) in enumerate(zip(packed, actions(length, seed), strict=True)):
            at = START_NS + i * 10**9 // HZ
            bag.write(arm, at, serialize(_joints(store, at, values), command))
            picture = _picture(store, kept, at, np.frombuffer(data, np.uint8))
            bag.write(camera, at, serialize(picture, _TYPES[kept]))


def _header(store: Any, at: int) -> dict[str, Any]:
    stamp = store.types["builtin_interfaces/msg/Time"](sec=at // 10**9, nanosec=at % 10**9)
    kind = store.types["std_msgs/msg/Header"]
    numbered = {"seq": 0} if "seq" in kind.__dataclass_fields__ else {}  # ROS 1 has it
    return {"header": kind(stamp=stamp, frame_id="main", **numbered)}


def _joints(store: Any, at: int, values: NDArray[np.float32]) -> Any:
    names = [f"joint_{i}" for i in range(A)]
    empty = np.empty(0)
    fields = {"name": names, "position": values.astype(np.float64), "velocity": empty, "effort": empty}
    return store.types["sensor_msgs/msg/JointState"](**_header(store, at), **fields)


def _picture(store: Any, kept: str, at: int, data: NDArray[np.uint8]) -> Any:
    kind, (height, width) = store.types[_TYPES[kept]], VGA
    if kept == "h264":
        stamp = _header(store, at)["header"].stamp
        return kind(timestamp=stamp, frame_id="main", data=data, format="h264")
    if kept == "jpeg":
        return kind(**_header(store, at), format="jpeg", data=data)
    shape = {"height": height, "width": width, "step": 3 * width}
    return kind(**_header(store, at), **shape, encoding="rgb8", is_bigendian=0, data=data)


def packets(pictures: Iterator[Images], encoder: str, gop: int = HZ) -> Iterator[bytes]:
    """Yield frames of H.264 with start codes, without B-frames, as recorders put them into messages."""
    import av

    context: Any = None
    for number, picture in enumerate(pictures):
        if context is None:
            context = av.CodecContext.create(encoder, "w")
            context.height, context.width, context.pix_fmt = *picture.shape[:2], "yuv420p"
            context.time_base, context.framerate = Fraction(1, HZ), Fraction(HZ)
            context.gop_size, context.max_b_frames = gop, 0
            context.options = {"preset": "veryfast", "tune": "zerolatency", "crf": "23"}
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
        frame.pts = number
        yield from (bytes(packet) for packet in context.encode(frame))
    yield from (bytes(packet) for packet in context.encode(None)) if context else ()


def _video(path: Path, pictures: Iterator[Images], encoder: str, gop: int) -> None:
    import av

    options = {"libsvtav1": {"preset": "10", "crf": "30"}, "libx264": {"preset": "veryfast", "crf": "23"}}
    path.parent.mkdir(parents=True, exist_ok=True)
    stream: Any = None
    with ordinary_priority(), av.open(str(path), "w") as container:
        for picture in pictures:
            if stream is None:
                stream = container.add_stream(encoder, rate=HZ, options=options[encoder])
                stream.height, stream.width, stream.pix_fmt = *picture.shape[:2], "yuv420p"
                stream.codec_context.gop_size = gop
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))


def _lerobot(encoder: str, gop: int) -> Writer:
    """Return a writer of a LeRobotDataset v2.1, one video an episode."""

    def write(folder: Path, episodes: int, length: int, seed: int) -> Path:
        import pyarrow as pa
        import pyarrow.parquet as pq

        root = folder / "lerobot"
        (root / "meta").mkdir(parents=True)
        (root / "data/chunk-000").mkdir(parents=True)
        scalar = {"dtype": "int64", "shape": [1], "names": None}
        features = {
            "action": {"dtype": "float32", "shape": [A], "names": None},
            "observation.images.main": {"dtype": "video", "shape": [*VGA, 3], "names": None},
            "timestamp": {"dtype": "float32", "shape": [1], "names": None},
            **dict.fromkeys(("frame_index", "episode_index", "index", "task_index"), scalar),
        }
        info = {
            "codebase_version": "v2.1", "robot_type": "bench", "fps": HZ, "chunks_size": 1000,
            "total_episodes": episodes, "total_frames": episodes * length, "features": features,
            "data_path": "data/chunk-{episode_chunk:03d}/episode_{episode_index:06d}.parquet",
            "video_path": "videos/chunk-{episode_chunk:03d}/{video_key}/episode_{episode_index:06d}.mp4",
        }  # fmt: skip
        (root / "meta/info.json").write_text(json.dumps(info))
        (root / "meta/tasks.jsonl").write_text(json.dumps({"task_index": 0, "task": TASK}) + "\n")
        rows = [{"episode_index": i, "tasks": [TASK], "length": length} for i in range(episodes)]
        (root / "meta/episodes.jsonl").write_text("".join(json.dumps(row) + "\n" for row in rows))
        number = np.arange(length, dtype=np.int64)
        for i in range(episodes):
            columns = {
                "action": pa.array(list(actions(length, i)), pa.list_(pa.float32(), A)),
                "timestamp": (number / HZ).astype(np.float32),
                "frame_index": number,
                "episode_index": np.full(length, i),
                "index": number + i * length,
                "task_index": np.zeros(length, np.int64),
            }
            pq.write_table(pa.table(columns), root / f"data/chunk-000/episode_{i:06d}.parquet")
            video = root / f"videos/chunk-000/observation.images.main/episode_{i:06d}.mp4"
            _video(video, scene(*VGA, length, seed + i), encoder, gop)
        return root

    return write


def _hands(folder: Path, episodes: int, length: int, seed: int) -> Path:
    """Write videos with a table of both hands' landmarks."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows = []
    for i in range(episodes):
        _video(folder / f"clip_{i:03d}.mp4", scene(*HD, length, seed + i), "libx264", 8 * HZ)
        places = 0.5 + 0.3 * actions(length, i)[:, :2]
        for frame in range(length):
            for side in ("left", "right"):
                marks = np.tile(places[frame] + (0.05 if side == "right" else 0), 21)
                row = {"video": f"clip_{i:03d}", "frame": frame, "side": side, "landmarks": marks.tolist()}
                rows.append(row)
    pq.write_table(pa.Table.from_pylist(rows), folder / "hands.parquet")
    return folder


_HANDS = {
    "action": {
        "space": "hand_2d",
        "components": [{"key": f"{side}/center", "dims": 2} for side in ("left", "right")],
    },
    "kind": "human",
    "source": {"format": "hands", "layout": {"labels": "landmarks", "annotations": "hands.parquet"}},
}
_IMAGE, _MAIN = "observation/image", "observation.images.main"
_JOINTS = "/command.position"
_FREE = {"frequency_hz": None}

CASES = {
    case.name: case
    for case in (
        Case("rlds-jpeg-256", "rlds", SQUARE, _rlds(SQUARE, "jpeg"), "action", _IMAGE),
        Case("rlds-jpeg-640x480", "rlds", VGA, _rlds(VGA, "jpeg"), "action", _IMAGE),
        Case("rlds-png-256", "rlds", SQUARE, _rlds(SQUARE, "png"), "action", _IMAGE),
        Case("hdf5-raw-256", "hdf5", SQUARE, _hdf5(SQUARE, "raw"), "actions", "obs/image"),
        Case("hdf5-gzip-256", "hdf5", SQUARE, _hdf5(SQUARE, "gzip"), "actions", "obs/image"),
        Case("hdf5-jpeg-640x480", "hdf5", VGA, _hdf5(VGA, "jpeg"), "actions", "obs/image"),
        Case("mcap-jpeg-640x480", "rosbag", VGA, _bags("mcap", "jpeg"), _JOINTS, "/camera", 1, _FREE),
        Case("mcap-raw-640x480", "rosbag", VGA, _bags("mcap", "raw"), _JOINTS, "/camera", 1, _FREE),
        Case("ros1-jpeg-640x480", "rosbag", VGA, _bags("ros1", "jpeg"), _JOINTS, "/camera", 1, _FREE),
        Case("db3-jpeg-640x480", "rosbag", VGA, _bags("sqlite3", "jpeg"), _JOINTS, "/camera", 1, _FREE),
        Case("mcap-h264-640x480", "rosbag", VGA, _bags("mcap", "h264"), _JOINTS, "/camera", 1, _FREE),
        Case("lerobot-av1-640x480", "lerobot", VGA, _lerobot("libsvtav1", 2), "action", _MAIN),
        Case("lerobot-av1-strided", "lerobot", VGA, _lerobot("libsvtav1", 2), "action", _MAIN, 5),
        Case("lerobot-h264-640x480", "lerobot", VGA, _lerobot("libx264", 2), "action", _MAIN),
        Case("lerobot-h264-strided", "lerobot", VGA, _lerobot("libx264", 2), "action", _MAIN, 5),
        Case("hands-h264-1280x720", "hands", HD, _hands, "left/center", "video", 1, _HANDS),
    )
}
