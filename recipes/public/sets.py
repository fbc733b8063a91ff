"""Train and score a world model on a public Push-T set, with the windows and metrics of its published models.

A set (gpc.py, dino_wm.py, iws.py) says how it is downloaded, repacked and scored. One command goes from the
download to the figures, and continues where it was:

    python -m recipes.public.gpc OUT [--from FOLDER] [--lpips FILE#SHA256] [key=value …]

It leaves OUT/download, OUT/recording, OUT/shards, OUT/run and OUT/figures.json. Words with = change the
training, whose defaults are for a GPU.

T frames of a window, S pixels a side.
"""

import argparse
import json
import shutil
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from decimal import Decimal
from itertools import batched
from pathlib import Path
from typing import Any
from urllib.request import urlopen

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import gaussian_filter

from hma_data.console import print_table, progress
from hma_data.conversion.job import convert
from hma_data.conversion.plan import Settings
from hma_data.errors import SourceError, StorageAwayError, UsageError
from hma_data.registry.embodiment import find
from hma_data.shards.manifest import MANIFEST
from hma_data.shards.reader import ShardSet
from hma_data.storage.files import atomic_path, file_sha256, write_atomic
from hma_model.evaluation.intervals import ends_of, interval
from hma_model.evaluation.perceptual import Networks, open_networks
from hma_model.training.loop import train
from hma_model.training.recipe import load_recipe
from hma_model.training.runtime import choose_device
from hma_model.worlds.world import World, load_world
from recipes.public.rollouts import Images, Recording, continued

TOKENIZER = "raw-128"
RECIPE = "unet_tiny"
TRAINING = ("model.levels=[48, 96, 192]", "batch_size=64", "steps=40000", "checkpoint_every=2000")
BATCH = 16  # windows that are rolled out together
GAUSSIAN_SIGMA, GAUSSIAN_RADIUS = 1.5, 5  # of the SSIM with an 11×11 window
BASELINE = "first frames, then the last of them repeated"

Figures = dict[str, float]
Chosen = list[tuple[int, int]]  # episode and first frame of each window


@dataclass(frozen=True)
class Protocol:
    """What is compared, and how: a published project's evaluation.

    Attributes:
        frames, context: of a window, and those of them that the model is given.
        size: pixels a side at which frames are compared.
        choose: lengths of the episodes → the windows, for a stride.
        figures: true and predicted frames (T, S, S, 3) → the figures of a window.
        finish: means over windows → the figures as they are published.
        scored_from: the first frame that counts.
        published: name of a model → its figures, each with its source.
        notes: what else one must know to compare.
    """

    frames: int
    context: int
    size: int
    choose: Callable[[Sequence[int], int], Chosen]
    figures: Callable[[Images, Images], Figures]
    scored_from: int
    finish: Callable[[Figures], Figures] = dict
    published: dict[str, Figures] = field(default_factory=dict)
    notes: tuple[str, ...] = ()


@dataclass(frozen=True)
class PublicSet:
    """A set.

    Attributes:
        robot: its id in the registry.
        download: downloads the published files into a folder.
        prepare: downloaded folder, folder to write to → recordings to train on, and to score.
        scored: what the scored recording is: "train" where it is the one trained on, else "val".
    """

    robot: str
    download: Callable[[Path, argparse.Namespace], None]
    prepare: Callable[[Path, Path], tuple[Path, Path]]
    protocol: Protocol
    scored: str = "val"


# -- metrics


def gaussian_ssim(true: Images, made: Images, span: float = 255.0) -> NDArray[np.float64]:
    """Return the structural similarity (T,) with an 11×11 Gaussian window, of frames (T, S, S, 3).

    Wang et al. 2004, with windows inside the image alone; the constants are shares of `span`.
    """
    x, y = true.astype(np.float64), made.astype(np.float64)
    mean_x, mean_y = _blurred(x), _blurred(y)
    variances = _blurred(x * x) - mean_x**2 + _blurred(y * y) - mean_y**2
    covariance = _blurred(x * y) - mean_x * mean_y
    c1, c2 = (0.01 * span) ** 2, (0.03 * span) ** 2
    above = (2 * mean_x * mean_y + c1) * (2 * covariance + c2)
    found: NDArray[np.float64] = (above / ((mean_x**2 + mean_y**2 + c1) * (variances + c2))).mean((1, 2, 3))
    return found


def _blurred(values: NDArray[np.float64]) -> NDArray[np.float64]:
    inner = slice(GAUSSIAN_RADIUS, -GAUSSIAN_RADIUS)
    blurred = gaussian_filter(values, GAUSSIAN_SIGMA, radius=GAUSSIAN_RADIUS, axes=(1, 2))
    found: NDArray[np.float64] = blurred[:, inner, inner]
    return found


def squared_error(true: Images, made: Images) -> float:
    """Return the mean squared error of frames whose values go from 0 to 1."""
    return float(np.square((true.astype(np.float64) - made) / 255).mean())


def every_window(lengths: Sequence[int], span: int) -> Chosen:
    """Return every window of `span` recorded frames, episode by episode."""
    return [(number, start) for number, most in enumerate(lengths) for start in range(most - span + 1)]


# -- the steps


def run(chosen: PublicSet) -> None:
    """Download, convert, train and score, as the command line says."""
    parser = argparse.ArgumentParser(description=f"Train and score a model on {chosen.robot}")
    parser.add_argument("out", type=Path)
    parser.add_argument(
        "--from", dest="source", type=Path, help="folder of the published files, as downloaded"
    )
    parser.add_argument("--model", help="score this checkpoint, do not train")
    parser.add_argument("--tokenizer", default=TOKENIZER)
    parser.add_argument("--recipe", default=RECIPE)
    parser.add_argument("--workers", type=int, default=2, help="processes of the conversion")
    parser.add_argument("--episodes", type=int, help="take only so many episodes")
    parser.add_argument("--windows", type=int, help="score only so many windows")
    parser.add_argument("--lpips", help="FILE#SHA256, as of hma evaluate")
    parser.add_argument("--device", default="auto")
    parser.add_argument("overrides", nargs="*", metavar="key=value")
    given = parser.parse_intermixed_args()
    given.out.mkdir(parents=True, exist_ok=True)
    rows = figures(chosen, given)
    write_atomic(given.out / "figures.json", json.dumps(rows, indent=1))
    show(chosen, rows)


def figures(chosen: PublicSet, given: argparse.Namespace) -> list[dict[str, Any]]:
    """Return a row for each model, baseline and published model."""
    networks = open_networks(given.lpips)
    source = given.source or given.out / "download"
    if given.source is None:
        chosen.download(source, given)
    learned, scored = chosen.prepare(source, given.out / "recording")
    robot, shards = find(chosen.robot), given.out / "shards"
    model = given.model
    if model is None:
        if not (shards / MANIFEST).is_file():
            settings = Settings(frames="strided", limit=given.episodes)
            convert(robot, learned, given.tokenizer, shards, settings=settings, workers=given.workers)
        model = given.out / "run"
        words = [*TRAINING, f"device={given.device}", *given.overrides, f"data=[{shards}]"]
        train(load_recipe(given.recipe, words), out=model)
    world = load_world(model, device=str(choose_device(given.device)))
    recording = Recording(scored, robot)
    rows = score(chosen.protocol, world, recording, given, networks, chosen.scored)
    if chosen.scored == "train" and (shards / MANIFEST).is_file():
        held = [row["id"] for row in ShardSet(shards).episodes.to_pylist() if row["split"] == "val"]
        if held:
            rows += score(chosen.protocol, world, Recording(scored, robot, held), given, networks, "val")
    return rows + [{"model": name} | found for name, found in chosen.protocol.published.items()]


def score(
    protocol: Protocol,
    world: World,
    recording: Recording,
    given: argparse.Namespace,
    networks: Networks,
    split: str,
) -> list[dict[str, Any]]:
    """Return the figures of a model, and of its given frames repeated."""
    windows = protocol.choose(recording.lengths, recording.robot.stride)[: given.windows]
    if not windows:
        said = f"no episode has the {protocol.frames} frames of a window"
        raise UsageError(recording.place, said, "give longer episodes")
    found: dict[str, list[Figures]] = {"ours": [], BASELINE: []}
    with progress("windows", len(windows), "windows") as bar:
        for part in batched(windows, BATCH):
            seen = [
                recording.window(world, *one, protocol.frames, protocol.context, protocol.size)
                for one in part
            ]
            for one, made in zip(seen, continued(world, recording.robot.id, seen), strict=True):
                still = one.true.copy()
                still[protocol.context :] = one.true[protocol.context - 1]
                for name, frames in (("ours", made), (BASELINE, still)):
                    true, shown = one.true[protocol.scored_from :], frames[protocol.scored_from :]
                    own = protocol.figures(true, shown)
                    if networks.lpips:
                        own["lpips"] = float(networks.lpips_of(true, shown).mean())
                    found[name].append(own)
            bar(len(found["ours"]))
    episodes = [number for number, _ in windows]
    facts = {"split": split, "windows": len(windows), "episodes": len(set(episodes))}
    return [{"model": name} | facts | _summary(protocol, values, episodes) for name, values in found.items()]


def _summary(protocol: Protocol, values: list[Figures], episodes: list[int]) -> dict[str, Any]:
    """Return means over windows, and the 95 % intervals of those that are no function of another mean."""
    columns = {name: np.array([one[name] for one in values]) for name in values[0]}
    found: dict[str, Any] = protocol.finish({name: float(own.mean()) for name, own in columns.items()})
    for name, own in columns.items():
        found[f"{name}_95"] = ends_of(interval(own, 0, episodes))
    return found


def show(chosen: PublicSet, rows: list[dict[str, Any]]) -> None:
    """Print the figures and what one must know to compare them."""
    facts = ("model", "split", "windows", "episodes")
    names = list(dict.fromkeys(name for row in rows for name in row if not name.endswith("_95")))
    columns = [name for name in names if name in facts] + [name for name in names if name not in facts]
    print_table(columns, [[_cell(name, row.get(name)) for name in columns] for row in rows])
    for note in chosen.protocol.notes:
        print(note)


def _cell(name: str, value: Any) -> Any:
    if isinstance(value, float):
        return Decimal(f"{value:.2f}" if name.endswith("_db") else f"{value:.4f}")
    return "" if value is None else value


def hub_files(repository: str, patterns: Sequence[str], folder: Path) -> None:
    """Download files of a dataset of the Hugging Face Hub; those that are there are kept.

    Raises:
        StorageAwayError: the Hub does not give them.
    """
    from huggingface_hub import snapshot_download

    try:
        snapshot_download(repository, repo_type="dataset", allow_patterns=list(patterns), local_dir=folder)
    except Exception as fault:  # it raises several kinds
        said = f"cannot be downloaded: {type(fault).__name__}: {fault}"
        raise StorageAwayError(repository, said, "try again, or give its folder by --from") from fault


def checked_file(url: str, sha256: str, path: Path) -> None:
    """Download a file, and refuse it where its content is another one.

    Raises:
        StorageAwayError: the server does not answer.
        SourceError: the file has another SHA-256.
    """
    remedy = "try again, or download it by hand and give its folder by --from"
    try:
        answer = urlopen(url, timeout=60)
    except OSError as fault:
        raise StorageAwayError(url, f"cannot be downloaded: {fault}", remedy) from fault
    with answer, atomic_path(path) as part:
        with part.open("wb") as file:
            shutil.copyfileobj(answer, file)
        found = file_sha256(part)
        if found != sha256:
            raise SourceError(url, f"has the SHA-256 {found}, not {sha256}", remedy)
