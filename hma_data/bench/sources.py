"""Measure how fast each format becomes 256×256 pictures, by the steps of `hma convert` without the tokenizer.

The recordings are generated, one of each format and of realistic size. Their pictures are as hard for a codec
as real ones: textures at every scale, sensor noise, motion; their actions are seven smooth numbers a frame.

H height, W width, A action dims.
"""

import json
import os
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from concurrent.futures import ProcessPoolExecutor
from dataclasses import dataclass, field
from fractions import Fraction
from functools import partial
from multiprocessing import get_context
from pathlib import Path
from threading import Barrier
from typing import Any

import cv2
import numpy as np
from numpy.typing import NDArray

from hma_data.bench import Bench, make_robot, peak_rss_mib
from hma_data.cpu import ordinary_priority, usable_cores
from hma_data.episodes.images import Images
from hma_data.errors import HMAError, UsageError
from hma_data.registry.embodiment import Embodiment

SIZE, BATCH = 256, 32  # pixels of a side; frames requested at once
DEADLINE_S = 1800
A, HZ = 7, 30
VGA, SQUARE, HD = (480, 640), (256, 256), (720, 1280)
START_NS = 1_700_000_000_000_000_000
TASK = "move the blocks"
NOISE = 2.0  # standard deviation of the sensor's noise, of 255
QUALITY = 92  # of JPEG; gives 0.20 to 0.28 bytes a pixel; photographs give 0.11 to 0.26
_VIDEO_DEFINITION = "builtin_interfaces/Time timestamp\nstring frame_id\nuint8[] data\nstring format\n"
_TYPES = {
    "jpeg": "sensor_msgs/msg/CompressedImage",
    "raw": "sensor_msgs/msg/Image",
    "h264": "foxglove_msgs/msg/CompressedVideo",
}

Writer = Callable[[Path, int, int, int], Path]  # (folder, episodes, length, seed) -> the recording's path


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
    extra: dict[str, Any] = field(default_factory=dict)

    def embodiment(self) -> Embodiment:
        """Return the embodiment that reads it."""
        name = f"bench_{self.name.replace('-', '_')}"
        values = {"stride": self.stride, **self.extra}
        return make_robot(name, self.format, self.action, self.camera, HZ, A, **values)


# -- measuring


def run(settings: dict[str, Any]) -> list[dict[str, Any]]:
    """Return one result for each format and number of processes.

    Raises:
        UsageError: there is no such format.
    """
    wanted = list(CASES) if settings["formats"] == ["all"] else settings["formats"]
    for name in wanted:
        if name not in CASES:
            known = f"known: {', '.join(CASES)}"
            raise UsageError("bench sources", f"the format {name!r} does not exist", known)
    episodes = max(1, min(settings["episodes"], settings["frames"]))
    length = max(2, settings["frames"] // episodes)
    results: list[dict[str, Any]] = []
    os.environ.setdefault("SVT_LOG", "1")  # otherwise the AV1 encoder prints its settings
    for name in wanted:
        with tempfile.TemporaryDirectory(prefix="hma-bench-") as folder:
            uri = CASES[name].write(Path(folder), episodes, length, settings["seed"])
            size = sum(path.stat().st_size for path in Path(folder).rglob("*") if path.is_file())
            for processes in dict.fromkeys((1, min(usable_cores(), episodes))):
                about = {"format": name, "processes": processes, "stride": CASES[name].stride}
                figures = measure(name, str(uri), processes)
                figures["recorded_bytes_per_frame"] = round(size / (episodes * length))
                results.append(about | figures)
    return results


def measure(name: str, uri: str, processes: int) -> dict[str, Any]:
    """Return frames per second of wall time and of CPU time, and the most memory that one process held.

    Every process opens the source for itself and takes its episodes: read, align, decode, resize.
    Timing starts when every process has read one frame, so imports do not count.
    """
    context = get_context("spawn")
    with context.Manager() as manager, ProcessPoolExecutor(processes, context) as pool:
        start = manager.Barrier(processes)  # each process waits for the others, so that none takes two tasks
        jobs = [pool.submit(_work, name, uri, share, processes, start) for share in range(processes)]
        found = [job.result() for job in jobs]
    frames = sum(one["frames"] for one in found)
    wall = max(one["stop"] for one in found) - min(one["start"] for one in found)
    return {
        "frames": frames,
        "frames_per_second": round(frames / wall, 1),
        "frames_per_cpu_second": round(frames / sum(one["cpu"] for one in found), 1),
        "peak_rss_mib": max(one["peak_rss_mib"] for one in found),
    }


def _work(name: str, uri: str, share: int, shares: int, start: Barrier) -> dict[str, Any]:
    """Read every `shares`th episode from the `share`th on, and return the figures."""
    from hma_data.sources.base import open_source

    cv2.setNumThreads(1)
    robot = CASES[name].embodiment()
    try:
        source = open_source(robot.source.format)
        names = [ref.id for ref in source.index(uri, robot)]
        _episode(source, uri, names[share % len(names)], robot, limit=1)
    except HMAError:
        start.abort()  # the others need not wait
        raise
    start.wait(DEADLINE_S)
    began, cpu = time.monotonic(), time.process_time()
    frames = sum(_episode(source, uri, one, robot) for one in names[share::shares])
    stop, used = time.monotonic(), time.process_time() - cpu
    return {"frames": frames, "start": began, "stop": stop, "cpu": used, "peak_rss_mib": peak_rss_mib()}


def _episode(source: Any, uri: str, name: str, robot: Any, limit: int | None = None) -> int:
    """Bring one episode to pictures of the tokenizer's size; return the number of frames."""
    from hma_data.episodes.align import to_clip
    from hma_data.episodes.images import prepared

    clip = to_clip(source.read(uri, name, robot), robot)
    grid = np.arange(0, len(clip), robot.stride)[:limit]
    camera = robot.primary_camera
    for at in range(0, len(grid), BATCH):
        indices = clip.frame_indices[camera.name][grid[at : at + BATCH]]
        prepared(clip.episode.streams[camera.name], indices, camera, SIZE)
    return len(grid)


# -- pictures and actions


def scene(height: int, width: int, frames: int, seed: int) -> Iterator[Images]:
    """Yield (H, W, 3) pictures of a still camera; two textured things move in front of it."""
    draw = np.random.default_rng(seed)
    back = _texture(draw, height, width)
    size = height // 3
    things = [_texture(draw, size, size) for _ in range(2)]
    for i in range(frames):
        picture = back.copy()
        for n, thing in enumerate(things):
            phase = 2 * np.pi * (i / (60 + 25 * n) + 0.37 * n)
            y = int((height - size) * (0.5 + 0.45 * np.sin(phase)))
            x = int((width - size) * (0.5 + 0.45 * np.cos(0.7 * phase)))
            picture[y : y + size, x : x + size] = thing
        noise = draw.normal(scale=NOISE, size=(height, width, 1)).astype(np.float32)
        yield np.clip(picture + noise, 0, 255).astype(np.uint8)


def _texture(draw: np.random.Generator, height: int, width: int) -> NDArray[np.float32]:
    """Return (height, width, 3) with power at every scale, less at finer scales, mostly of one hue."""
    total = np.zeros((height, width, 3), np.float32)
    cells, strength = 3, 60.0
    while cells < min(height, width):
        grey = draw.normal(size=(cells, cells, 1)) + 0.25 * draw.normal(size=(cells, cells, 3))
        coarse = (strength * grey).astype(np.float32)
        total += cv2.resize(coarse, (width, height), interpolation=cv2.INTER_CUBIC)
        cells, strength = cells * 2, strength * 0.55
    return np.clip(total + np.array([138, 126, 112], np.float32), 0, 255)


def actions(length: int, seed: int) -> NDArray[np.float32]:
    """Return (length, A) actions that change at every frame."""
    phase = np.arange(length)[:, None] / 20 + np.random.default_rng(seed).uniform(0, 6, A)
    return np.sin(phase).astype(np.float32)


def _encoded(pictures: Iterator[Images], codec: str) -> list[bytes]:
    """Encode pictures as JPEG or PNG files."""
    options = [cv2.IMWRITE_JPEG_QUALITY, QUALITY] if codec == "jpeg" else []
    ending = ".jpg" if codec == "jpeg" else ".png"
    return [cv2.imencode(ending, picture[..., ::-1], options)[1].tobytes() for picture in pictures]


def _packets(pictures: Iterator[Images]) -> Iterator[bytes]:
    """Yield frames of H.264 with start codes, without B-frames, as recorders put them into messages."""
    import av

    context: Any = av.CodecContext.create("libx264", "w")
    context.height, context.width, context.pix_fmt = *VGA, "yuv420p"
    context.time_base, context.framerate = Fraction(1, HZ), Fraction(HZ)
    context.gop_size, context.max_b_frames = HZ, 0
    context.options = {"preset": "veryfast", "tune": "zerolatency", "crf": "23"}
    for number, picture in enumerate(pictures):
        frame = av.VideoFrame.from_ndarray(picture, format="rgb24")
        frame.pts = number
        yield from (bytes(packet) for packet in context.encode(frame))
    yield from (bytes(packet) for packet in context.encode(None))


def _video(path: Path, size: tuple[int, int], pictures: Iterator[Images], encoder: str, gop: int) -> None:
    import av

    options = {"libsvtav1": {"preset": "10", "crf": "30"}, "libx264": {"preset": "veryfast", "crf": "23"}}
    path.parent.mkdir(parents=True, exist_ok=True)
    with ordinary_priority(), av.open(str(path), "w") as container:
        stream: Any = container.add_stream(encoder, rate=HZ, options=options[encoder])
        stream.height, stream.width, stream.pix_fmt = *size, "yuv420p"
        stream.codec_context.gop_size = gop
        for picture in pictures:
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, format="rgb24")))
        container.mux(stream.encode(None))


# -- recordings


def _rlds(size: tuple[int, int], codec: str, folder: Path, episodes: int, length: int, seed: int) -> Path:
    from hma_data.lab.writers import RldsEpisode, write_rlds

    def made() -> Iterator[RldsEpisode]:
        for i in range(episodes):
            files = _encoded(scene(*size, length, seed + i), codec)
            yield RldsEpisode({"observation/image": files}, {"action": actions(length, i)}, TASK)

    write_rlds(folder / "rlds", "bench", {"observation/image": size}, codec, made())
    return folder / "rlds"


def _hdf5(size: tuple[int, int], kept: str, folder: Path, episodes: int, length: int, seed: int) -> Path:
    import h5py

    path = folder / "demos.hdf5"
    packing = {"compression": "gzip", "compression_opts": 4} if kept == "gzip" else {}
    with h5py.File(path, "w") as file:
        for i in range(episodes):
            group = file.create_group(f"data/demo_{i}")
            group["actions"] = actions(length, i)
            pictures = scene(*size, length, seed + i)
            if kept == "jpeg":
                files = _encoded(pictures, "jpeg")
                widest = max(map(len, files))  # padded to one width, as in ALOHA's recorder
                padded = [np.frombuffer(data.ljust(widest, b"\0"), np.uint8) for data in files]
                group.create_dataset("obs/image", data=np.stack(padded), chunks=(1, widest))
                continue
            shape = (length, *size, 3)
            rows = group.create_dataset("obs/image", shape, np.uint8, chunks=(1, *size, 3), **packing)
            for row, picture in enumerate(pictures):
                rows[row] = picture
    return path


def _bags(kind: str, kept: str, folder: Path, episodes: int, length: int, seed: int) -> Path:
    """Write one bag an episode; `kind` is ros1, mcap or sqlite3."""
    from rosbags.rosbag1 import Writer as Ros1Writer
    from rosbags.rosbag2 import StoragePlugin
    from rosbags.rosbag2 import Writer as Ros2Writer
    from rosbags.typesys import Stores, get_types_from_msg, get_typestore

    ros1 = kind == "ros1"
    store = get_typestore(Stores.ROS1_NOETIC if ros1 else Stores.ROS2_HUMBLE)
    store.register(get_types_from_msg(_VIDEO_DEFINITION, _TYPES["h264"]))
    serialize = store.serialize_ros1 if ros1 else store.serialize_cdr
    command = "sensor_msgs/msg/JointState"
    numbered = {"seq": 0} if ros1 else {}
    form: dict[str, Any] = {"format": kept}
    if kept == "raw":
        height, width = VGA
        shape = {"height": height, "width": width, "step": 3 * width}
        form = {**shape, "encoding": "rgb8", "is_bigendian": 0}
    stored: dict[str, Callable[[Iterator[Images]], Iterable[bytes]]] = {
        "h264": _packets,
        "jpeg": partial(_encoded, codec="jpeg"),
        "raw": partial(map, np.ndarray.tobytes),
    }
    for episode in range(episodes):
        path = folder / f"run_{episode:03d}{'.bag' if ros1 else ''}"
        plugin = None if ros1 else StoragePlugin[kind.upper()]
        bag: Any = Ros1Writer(path) if ros1 else Ros2Writer(path, version=9, storage_plugin=plugin)
        with bag:
            camera = bag.add_connection("/camera", _TYPES[kept], typestore=store)
            arm = bag.add_connection("/command", command, typestore=store)
            pictures = stored[kept](scene(*VGA, length, seed + episode))
            for i, (data, values) in enumerate(zip(pictures, actions(length, episode), strict=True)):
                at = START_NS + i * 10**9 // HZ
                stamp = store.types["builtin_interfaces/msg/Time"](*divmod(at, 10**9))
                header = store.types["std_msgs/msg/Header"](stamp=stamp, frame_id="main", **numbered)
                none, position = np.empty(0), values.astype(np.float64)
                joints = store.types[command](header, [f"joint_{n}" for n in range(A)], position, none, none)
                bag.write(arm, at, serialize(joints, command))
                where = {"timestamp": stamp, "frame_id": "main"} if kept == "h264" else {"header": header}
                picture = store.types[_TYPES[kept]](**where, **form, data=np.frombuffer(data, np.uint8))
                bag.write(camera, at, serialize(picture, _TYPES[kept]))
    return folder


def _lerobot(encoder: str, folder: Path, episodes: int, length: int, seed: int) -> Path:
    """Write a LeRobotDataset v2.1, one video an episode."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    root = folder / "lerobot"
    (root / "meta").mkdir(parents=True)
    (root / "data/chunk-000").mkdir(parents=True)
    scalar = {"dtype": "int64", "shape": [1], "names": None}
    features = {
        "action": {"dtype": "float32", "shape": [A], "names": None},
        _MAIN: {"dtype": "video", "shape": [*VGA, 3], "names": None},
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
        video = root / f"videos/chunk-000/{_MAIN}/episode_{i:06d}.mp4"
        _video(video, VGA, scene(*VGA, length, seed + i), encoder, 2)
    return root


def _hands(folder: Path, episodes: int, length: int, seed: int) -> Path:
    """Write videos with a table of both hands' landmarks."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    rows = []
    for i in range(episodes):
        _video(folder / f"clip_{i:03d}.mp4", HD, scene(*HD, length, seed + i), "libx264", 8 * HZ)
        places = 0.5 + 0.3 * actions(length, i)[:, :2]
        for frame in range(length):
            for side, offset in (("left", 0.0), ("right", 0.05)):
                marks = np.tile(places[frame] + offset, 21).tolist()
                rows.append({"video": f"clip_{i:03d}", "frame": frame, "side": side, "landmarks": marks})
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
_IMAGE, _MAIN, _JOINTS = "observation/image", "observation.images.main", "/command.position"
_FREE = {"frequency_hz": None}
_AV1, _H264 = partial(_lerobot, "libsvtav1"), partial(_lerobot, "libx264")

CASES = {
    case.name: case
    for case in (
        Case("rlds-jpeg-256", "rlds", SQUARE, partial(_rlds, SQUARE, "jpeg"), "action", _IMAGE),
        Case("rlds-jpeg-640x480", "rlds", VGA, partial(_rlds, VGA, "jpeg"), "action", _IMAGE),
        Case("rlds-png-256", "rlds", SQUARE, partial(_rlds, SQUARE, "png"), "action", _IMAGE),
        Case("hdf5-raw-256", "hdf5", SQUARE, partial(_hdf5, SQUARE, "raw"), "actions", "obs/image"),
        Case("hdf5-gzip-256", "hdf5", SQUARE, partial(_hdf5, SQUARE, "gzip"), "actions", "obs/image"),
        Case("hdf5-jpeg-640x480", "hdf5", VGA, partial(_hdf5, VGA, "jpeg"), "actions", "obs/image"),
        *(
            Case(f"{name}-640x480", "rosbag", VGA, partial(_bags, *how), _JOINTS, "/camera", 1, _FREE)
            for name, how in {
                "mcap-jpeg": ("mcap", "jpeg"),
                "mcap-raw": ("mcap", "raw"),
                "ros1-jpeg": ("ros1", "jpeg"),
                "db3-jpeg": ("sqlite3", "jpeg"),
                "mcap-h264": ("mcap", "h264"),
            }.items()
        ),
        Case("lerobot-av1-640x480", "lerobot", VGA, _AV1, "action", _MAIN),
        Case("lerobot-av1-strided", "lerobot", VGA, _AV1, "action", _MAIN, 5),
        Case("lerobot-h264-640x480", "lerobot", VGA, _H264, "action", _MAIN),
        Case("lerobot-h264-strided", "lerobot", VGA, _H264, "action", _MAIN, 5),
        Case("hands-h264-1280x720", "hands", HD, _hands, "left/center", "video", 1, _HANDS),
    )
}


BENCH = Bench(
    "recordings of every format to 256×256 RGB, with one process and with all cores",
    {"formats": ["all"], "frames": 600, "episodes": 6, "seed": 0},
    run,
)
