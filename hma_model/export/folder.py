"""Write a folder that holds a model, its robots, frames to start from, and a page that drives them.

    manifest.json            what is in the folder; written last
    step.onnx                one frame of any robot
    page-step.onnx           for the page: the same without its image
    page-image.onnx          for the page: the image of a frame, on a processor
    page-image-gpu.onnx      and on a GPU
    robots/ID/stem.onnx      what commands of a robot mean to the step
    robots/ID/frames.npy     (starts, P, …) known frames, as the step takes them
    robots/ID/chunks.npy     (starts, P - 1, K) commands between them; NaN where they are unknown
    robots/ID/start-0.png    the last known frame of each start
    robots/ID/replays.npy    (starts, R - 1, K) recorded commands from there on, if there is a simulator
    robots/ID/replay-0.webp  R true images under them, in rows, of each start, or
    robots/ID/table.png      the background of the page's own simulator
    index.html, *.js, *.css  the page; ort/ if its runtime was copied

P frames of a start, K = stride * action dim.
"""

import re
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from hma_data import __version__
from hma_data.episodes.images import opencv
from hma_data.episodes.sheets import png_bytes
from hma_data.errors import OutputError
from hma_data.lab.family.bodies import Body
from hma_data.storage.files import new_folder, read_json, to_json, write_atomic
from hma_data.tokenizers.base import Tokenizer
from hma_model.export import require_onnx
from hma_model.export.files import facts, write_graph, write_part
from hma_model.export.graphs import Port, StemGraph, StepGraph, require_exportable
from hma_model.export.page import page_names, require_runtime, write_page
from hma_model.export.starts import Start, round_weights, take_starts
from hma_model.export.truth import body_values
from hma_model.network.model import HMA
from hma_model.play.holding import UNKNOWN, holdings
from hma_model.play.pads import describe
from hma_model.worlds.scenes import Drivable
from hma_model.worlds.world import World

FORMAT, FORMAT_VERSION = "hma-export", 1
MANIFEST, STEP, ROBOTS = "manifest.json", "step.onnx", "robots"
ROBOT_FILE = re.compile(r"stem\.onnx|(frames|chunks|replays)\.npy|(start-\d+|table)\.png|replay-\d+\.webp")
PARTS = ("page-step.onnx", "page-image.onnx", "page-image-gpu.onnx")
COLUMNS = 10  # true images in a row of a picture
QUALITY = 90  # of WebP


def export_folder(
    model: HMA,
    tokenizer: Tokenizer,
    robots: Sequence[Drivable],
    out: Path,
    *,
    name: str,
    starts: int = 3,
    unmask_steps: int = 2,
    half: bool = True,
    runtime: Path | None = None,
    report: Callable[[str], None] = lambda said: None,
) -> dict[str, Any]:
    """Export a model; return the manifest.

    Args:
        model: in eval mode, on the CPU. Its weights are rounded in place if they are exported in float16.
        tokenizer: the model's, on the CPU; likewise.
        robots: those to export, one for each embodiment.
        out: the folder; an older export there is replaced.
        name: of the model, shown on the page.
        starts: scenes of each robot to begin from.
        unmask_steps: passes in which a frame is decoded.
        half: store weights in float16 if that costs little.
        runtime: the npm package onnxruntime-web as installed; None for a CDN.
        report: is told what is done next.

    Raises:
        CheckpointError: no graph can be written of such a model.
        MissingDependencyError: the extra `export` is not installed.
        OutputError: `out` holds something else, or cannot be written.
        UsageError: `runtime` is not that package.
    """
    require_onnx()
    require_exportable(model, tokenizer)
    _require_own(out)
    if runtime is not None:
        require_runtime(runtime)
    world = World(model, tokenizer)
    taken = {robot.embodiment.id: take_starts(world, robot, starts) for robot in robots}
    loss, halved = round_weights(model, tokenizer, taken) if half else (None, False)
    with _written(out) as folder:
        report("step.onnx, which all robots share")
        step = StepGraph(model, tokenizer, unmask_steps).eval()
        manifest: dict[str, Any] = {
            "format": FORMAT,
            "format_version": FORMAT_VERSION,
            "library": f"hma-toolkit {__version__}",
            "model": name,
            "trunk_sha256": model.source.trunk_sha256 if model.source else None,
            "tokenizer": tokenizer.spec.to_json(),
            "image": list(world.image_shape),
            "weights": "float16" if halved else "float32",
            "float16_loss_db": loss,
            "step": write_graph(folder / STEP, step, step.inputs, step.outputs),
            "page": _write_parts(folder, step),
            "state": [vars(port) for port in step.state],
            "draws": [vars(port) for port in step.draws if port.law],
            "temperature": world.decoding.temperature if model.config.discrete else None,
            "robots": [],
        }
        known = holdings(model.source) if model.source else {}
        for robot in sorted(robots, key=lambda one: known.get(one.embodiment.id, UNKNOWN).rank):
            report(robot.embodiment.id)
            held = known.get(robot.embodiment.id, UNKNOWN)
            about = describe(robot) | {"holds": held.words, "follows": held.follows is not False}
            about |= _meter(world, robot.embodiment.id, unmask_steps)
            manifest["robots"].append(about | _write_robot(folder, model, robot, taken[robot.embodiment.id]))
        manifest["runtime"] = write_page(folder, runtime)
        write_atomic(folder / MANIFEST, to_json(manifest))
    return manifest


def _write_parts(folder: Path, step: StepGraph) -> dict[str, Any]:
    """Write the graphs of the page, which makes an image while it computes the next frame."""
    image, *others = step.outputs
    of_step, of_image, on_gpu = (folder / part for part in PARTS)
    return {
        "step": write_part(folder / STEP, of_step, [port.name for port in step.inputs], others),
        "image": write_part(folder / STEP, of_image, ["next_frame"], [image], winograd=True),
        "gpu_image": write_part(folder / STEP, on_gpu, ["next_frame"], [image]),
    }


def _meter(world: World, robot: str, unmask_steps: int) -> dict[str, Any]:
    """Return what the page needs to tell how unsure the model is of a robot, or why it does not."""
    meter, reason = world.meter(robot, unmask_steps=unmask_steps)
    if meter is not None and not world.model.config.discrete:  # `hma play` draws a frame twice for it
        return {"meter": None, "unmetered": "this page measures no uncertainty of latents: hma play does"}
    if meter is None or not meter.better:
        return {"meter": None, "unmetered": reason if meter is None else meter.verdict}
    return {"meter": asdict(meter) | {"verdict": meter.verdict}, "unmetered": ""}


@contextmanager
def _written(out: Path) -> Iterator[Path]:
    try:
        with new_folder(out) as folder:
            yield folder
    except OSError as fault:
        said = f"cannot be written: {fault.strerror or fault}"
        raise OutputError(out, said, "free space or choose another --out") from fault


def _require_own(out: Path) -> None:
    if not out.exists() or (out.is_dir() and not any(out.iterdir())):
        return
    if not (out / MANIFEST).is_file() or read_json(out / MANIFEST).get("format") != FORMAT:
        raise OutputError(out, "holds something else than an export", "choose another --out")
    ours = {MANIFEST, STEP, *PARTS} | page_names()
    found = (item.relative_to(out) for item in out.rglob("*") if item.is_symlink() or not item.is_dir())
    foreign = sorted(str(name) for name in found if name.parts[0] not in ours and not _is_of_robot(name))
    if foreign:
        fault = f"holds files that are not of the export: {', '.join(foreign[:3])}"
        raise OutputError(out, fault, "it would be replaced: move them out, or choose another --out")


def _is_of_robot(name: Path) -> bool:
    return len(name.parts) == 3 and name.parts[0] == ROBOTS and bool(ROBOT_FILE.fullmatch(name.name))


def _write_robot(folder: Path, model: HMA, robot: Drivable, starts: Sequence[Start]) -> dict[str, Any]:
    """Write the files of a robot; return what the manifest says of them."""
    name = robot.embodiment.id
    home = folder / ROBOTS / name
    home.mkdir(parents=True)
    chunks = Port("chunks", (2, model.embodiments[name].chunk_dim), "float32")
    stem = write_graph(home / "stem.onnx", StemGraph(model, name).eval(), [chunks], ["actions"])
    frames = np.stack([start.frames for start in starts])
    if model.config.discrete:
        frames = frames.astype(np.int32)
    elif model.config.pixels:
        frames = frames.astype(np.uint8)
    _save(home / "frames.npy", frames)
    _save(home / "chunks.npy", np.stack([start.chunks for start in starts]))
    pictures = []
    for number, start in enumerate(starts):
        pictures.append(f"robots/{name}/start-{number}.png")
        write_atomic(folder / pictures[-1], png_bytes(start.image))
    return {
        "stem": stem | {"file": f"robots/{name}/stem.onnx"},
        "frames": f"robots/{name}/frames.npy",
        "chunks": f"robots/{name}/chunks.npy",
        "pictures": pictures,
        "held": [start.action.tolist() for start in starts],
        "replays": write_replays(home, starts),
        "simulator": _write_simulator(home, starts),
    }


def write_replays(home: Path, starts: Sequence[Start]) -> dict[str, Any] | None:
    """Write recorded commands, and true images if the page cannot draw them; return their entry."""
    replays = [start.replay for start in starts if start.replay is not None]
    if not replays:
        return None
    _save(home / "replays.npy", np.stack(replays))
    place, strips = f"robots/{home.name}", []
    for number, start in enumerate(starts):
        if start.true is not None:
            path = home / f"replay-{number}.webp"
            write_atomic(path, _webp(start.true))
            strips.append(facts(path) | {"file": f"{place}/{path.name}"})
    return {"chunks": f"{place}/replays.npy", "strips": strips, "columns": COLUMNS}


def _write_simulator(home: Path, starts: Sequence[Start]) -> dict[str, Any] | None:
    """Write what the page simulates the robot with; return what the manifest says of it."""
    tables = [start.table for start in starts if start.table is not None]
    if not tables:
        return None
    body = Body.of(home.name)
    write_atomic(home / "table.png", png_bytes(body.canvas))
    return {"body": body_values(body), "canvas": f"robots/{home.name}/table.png", "tables": tables}


def _webp(images: NDArray[np.uint8]) -> bytes:
    """Return images (R, H, W, 3) in rows of COLUMNS as one picture, which is a sixth of theirs as PNG."""
    cv2 = opencv()
    count, height, width, _ = images.shape
    cells = np.zeros((-(-count // COLUMNS) * COLUMNS, height, width, 3), np.uint8)
    cells[:count] = images
    strip = cells.reshape(-1, COLUMNS, height, width, 3).swapaxes(1, 2).reshape(-1, COLUMNS * width, 3)
    settings = [cv2.IMWRITE_WEBP_QUALITY, QUALITY]
    return cv2.imencode(".webp", cv2.cvtColor(strip, cv2.COLOR_RGB2BGR), settings)[1].tobytes()


def _save(path: Path, values: NDArray[Any]) -> None:
    np.save(path, np.ascontiguousarray(values), allow_pickle=False)
