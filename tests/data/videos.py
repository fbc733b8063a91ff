"""Videos and LeRobotDatasets made for tests: each frame shows its number as a shade of grey."""

import json
from collections.abc import Callable, Sequence
from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

HEIGHT, WIDTH = 64, 96
TICKS = 20  # of a frame period
STEP = 4  # shades between neighbours, more than any codec here is off by
CODECS = {"h264": ("libx264", {"crf": "4"}), "av1": ("libsvtav1", {"crf": "10", "preset": "12"})}


def picture(number: int) -> np.ndarray:
    """(H, W, 3) uint8 whose brightness says `number`; a corner is marked so that turns show."""
    frame = np.full((HEIGHT, WIDTH, 3), 8 + STEP * (number % 58), np.uint8)
    frame[:16, :16] = 255
    return frame


def number_of(frame: np.ndarray) -> int:
    return round((float(np.median(frame)) - 8) / STEP)


def encode(
    path: Path,
    numbers: Sequence[int],
    codec: str = "h264",
    fps: int = 10,
    gop: int = 8,
    b_frames: int = 2,
    draw: Callable[[int], np.ndarray] = picture,
    stamps: Sequence[float] | None = None,
) -> Path:
    """A video of those pictures at `path`; `stamps` are times in frame periods, by default 0, 1, 2, …"""
    name, options = CODECS[codec]
    path.parent.mkdir(parents=True, exist_ok=True)
    # With B-frames an edit list would hide the delay of the first frame; without them it is what states it.
    late = {"use_editlist": "0", "avoid_negative_ts": "make_non_negative"}
    with av.open(str(path), "w", options=late if stamps is not None and b_frames else {}) as container:
        stream = container.add_stream(name, rate=fps, options=options)
        stream.width, stream.height, stream.pix_fmt = WIDTH, HEIGHT, "yuv420p"
        stream.codec_context.gop_size = gop
        if codec == "h264":
            stream.codec_context.max_b_frames = b_frames
        stream.codec_context.time_base = Fraction(1, fps * TICKS)
        for i, number in enumerate(numbers):
            frame = av.VideoFrame.from_ndarray(draw(number), format="rgb24")
            frame.pts = round(TICKS * (i if stamps is None else stamps[i]))
            frame.time_base = Fraction(1, fps * TICKS)
            container.mux(stream.encode(frame))
        container.mux(stream.encode(None))
    return path


def turn(path: Path, matrix: tuple[int, int, int, int] = (0, 1, -1, 0)) -> Path:
    """Make an MP4 say that its camera was held upright, or another way: decoders turn its pictures.

    Of the matrix, the first two numbers are where a step to the right leads, the others a step down.
    """
    whole = path.read_bytes()
    unit = (1 << 16).to_bytes(4, "big")
    level = unit + bytes(12) + unit  # of the display matrix
    a, b, c, d = ((number << 16).to_bytes(4, "big", signed=True) for number in matrix)
    at = whole.index(level, whole.index(b"tkhd"))
    path.write_bytes(whole[:at] + a + b + bytes(4) + c + d + whole[at + 20 :])
    return path


CAMERA = "observation.images.cam"
STILL = "observation.images.still"
TASKS = ("push the block", "lift the block")


def actions_of(episode: int, length: int) -> np.ndarray:
    return np.stack([np.full(length, episode), np.arange(length)], axis=1).astype(np.float32)


def _info(version: str, fps: int, lengths: Sequence[int], codec: str) -> dict[str, Any]:
    chunk = "chunk-{episode_chunk:03d}"
    paths = {
        "data_path": f"data/{chunk}/episode_{{episode_index:06d}}.parquet",
        "video_path": f"videos/{chunk}/{{video_key}}/episode_{{episode_index:06d}}.mp4",
    }
    if version == "v3.0":
        paths = {
            "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
            "video_path": "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4",
        }
    shape = [HEIGHT, WIDTH, 3]
    sides = ["height", "width", "channels"]
    scalars = ("frame_index", "episode_index", "index", "task_index")
    features: dict[str, Any] = {
        "action": {"dtype": "float32", "shape": [2], "names": {"motors": ["which", "row"]}},
        "observation.state": {"dtype": "float32", "shape": [2], "names": [["which", "row"]]},
        CAMERA: {"dtype": "video", "shape": shape, "names": sides, "info": {"video.codec": codec}},
        STILL: {"dtype": "image", "shape": shape, "names": sides},
        "timestamp": {"dtype": "float32", "shape": [1], "names": None},
        "next.success": {"dtype": "bool", "shape": [1], "names": None},
    } | {name: {"dtype": "int64", "shape": [1], "names": None} for name in scalars}
    return {
        "codebase_version": version,
        "robot_type": "testbot",
        "total_episodes": len(lengths),
        "total_frames": sum(lengths),
        "total_tasks": len(TASKS),
        "chunks_size": 1000,
        "fps": fps,
        "splits": {"train": f"0:{len(lengths)}"},
        **paths,
        "features": features,
    }


def _table(episode: int, length: int, offset: int, fps: int, fixed: bool) -> pa.Table:
    """The rows of one episode; vectors as fixed-size or as free lists, as both are met."""
    values = actions_of(episode, length)
    kind = pa.list_(pa.float32(), 2) if fixed else pa.list_(pa.float32())
    stills = [cv2.imencode(".png", picture(10 * episode + i)[..., ::-1])[1].tobytes() for i in range(length)]
    number = np.arange(length, dtype=np.int64)
    return pa.table(
        {
            "action": pa.array(values.tolist(), kind),
            "observation.state": pa.array((values * 2).tolist(), kind),
            STILL: pa.array([{"bytes": data, "path": None} for data in stills]),
            "timestamp": pa.array((number / fps).astype(np.float32)),
            "next.success": pa.array((number == length - 1) & (episode % 2 == 0)),
            "frame_index": pa.array(number),
            "episode_index": pa.array(np.full(length, episode)),
            "index": pa.array(number + offset),
            "task_index": pa.array(np.full(length, episode % 2)),
        }
    )


def _write(path: Path, text: str) -> None:
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(text)


def make_v2(
    folder: Path,
    lengths: Sequence[int] = (12, 9, 15),
    version: str = "v2.1",
    codec: str = "h264",
    fps: int = 10,
) -> Path:
    """A LeRobotDataset with a parquet and a video an episode; frame i of episode e shows 10 e + i."""
    _write(folder / "meta/info.json", json.dumps(_info(version, fps, lengths, codec)))
    tasks = [{"task_index": i, "task": task} for i, task in enumerate(TASKS)]
    _write(folder / "meta/tasks.jsonl", "".join(json.dumps(row) + "\n" for row in tasks))
    rows = [{"episode_index": e, "tasks": [TASKS[e % 2]], "length": n} for e, n in enumerate(lengths)]
    _write(folder / "meta/episodes.jsonl", "".join(json.dumps(row) + "\n" for row in rows))
    for episode, length in enumerate(lengths):
        place = folder / f"data/chunk-000/episode_{episode:06d}.parquet"
        place.parent.mkdir(parents=True, exist_ok=True)
        offset = sum(lengths[:episode])
        pq.write_table(_table(episode, length, offset, fps, episode % 2 == 0), place, row_group_size=5)
        video = folder / f"videos/chunk-000/{CAMERA}/episode_{episode:06d}.mp4"
        encode(video, range(10 * episode, 10 * episode + length), codec, fps)
    return folder


def make_v3(folder: Path, lengths: Sequence[int] = (12, 9, 15), codec: str = "h264", fps: int = 10) -> Path:
    """The same content as `make_v2`, all episodes in one parquet and one video."""
    _write(folder / "meta/info.json", json.dumps(_info("v3.0", fps, lengths, codec)))
    tasks = pa.table({"task_index": list(range(len(TASKS))), "__index_level_0__": list(TASKS)})
    pandas = {"index_columns": ["__index_level_0__"], "columns": [], "column_indexes": []}
    pq.write_table(
        tasks.replace_schema_metadata({"pandas": json.dumps(pandas)}), folder / "meta/tasks.parquet"
    )
    starts = np.cumsum([0, *lengths])
    rows = [
        {
            "episode_index": e,
            "tasks": [TASKS[e % 2]],
            "length": n,
            "data/chunk_index": 0,
            "data/file_index": 0,
            "dataset_from_index": int(starts[e]),
            "dataset_to_index": int(starts[e + 1]),
            f"videos/{CAMERA}/chunk_index": 0,
            f"videos/{CAMERA}/file_index": 0,
            f"videos/{CAMERA}/from_timestamp": starts[e] / fps,
            f"videos/{CAMERA}/to_timestamp": starts[e + 1] / fps,
            "stats/action/mean": [0.0, 0.0],
            "meta/episodes/chunk_index": 0,
            "meta/episodes/file_index": 0,
        }
        for e, n in enumerate(lengths)
    ]
    files = {"meta/episodes": pa.Table.from_pylist(rows)}
    tables = [_table(e, n, int(starts[e]), fps, True) for e, n in enumerate(lengths)]
    files["data"] = pa.concat_tables(tables)
    for name, table in files.items():
        place = folder / name / "chunk-000/file-000.parquet"
        place.parent.mkdir(parents=True, exist_ok=True)
        pq.write_table(table, place, row_group_size=10)
    shown = [10 * e + i for e, n in enumerate(lengths) for i in range(n)]
    encode(folder / f"videos/{CAMERA}/chunk-000/file-000.mp4", shown, codec, fps)
    return folder


def in_order(path: Path) -> np.ndarray:
    with av.open(str(path)) as container:
        return np.stack([frame.to_ndarray(format="rgb24") for frame in container.decode(video=0)])
