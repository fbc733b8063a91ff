"""Export a model's rollouts in the file layout that WorldArena's evaluation reads.

    python -m recipes.public.worldarena CHECKPOINT RECORDING -e ROBOT --task push_t --out OUT

A task is a recording. For each of its episodes that is long enough:

    OUT/NAME_sort/TASK_episode_7.mp4             the model, from the first frames, with recorded actions
    OUT/NAME_1_sort/…, OUT/NAME_2_sort/…         the same with the actions of other episodes of the task
    OUT/gt_sort/TASK_episode_7.mp4               the recording, for JEPA similarity
    OUT/gt/TASK/…/…/video/episode_7.mp4, .png    the recording, and its first frame
    OUT/summary.json                             gt_path, image and prompt of each episode

The names are those of video_quality/README.md and preprocess_datasets_diversity.py of
tsinghua-fib-lab/WorldArena, where the task is the fifth part of gt_path from its end. Several tasks may share
OUT; summary.json lists them all. The leaderboard's own tasks are RoboTwin 2.0's Clean-50, ten test episodes
each.

T frames, S pixels a side.
"""

import argparse
import json
import shutil
from dataclasses import replace
from itertools import batched
from pathlib import Path
from typing import Any

from hma_data.console import progress, run_script
from hma_data.episodes.sheets import png_bytes, write_mp4
from hma_data.errors import UsageError
from hma_data.registry.embodiment import find
from hma_data.storage.files import write_atomic
from hma_model.training.runtime import choose_device
from hma_model.worlds.world import World, load_world
from recipes.public.rollouts import Images, Recording, Window, continued
from recipes.public.sets import BATCH

VARIANTS = ("", "_1", "_2")  # of a model's folder: recorded actions, and those of other episodes
BETWEEN = ("recorded", "recorded")  # folders between a task and its videos, which WorldArena's paths have
NO_INSTRUCTION = "{robot}: {task}"


def main() -> None:
    parser = argparse.ArgumentParser(description="Rollouts in WorldArena's file layout")
    parser.add_argument("checkpoint")
    parser.add_argument("recording", type=Path)
    parser.add_argument("-e", "--embodiment", required=True, help="id of the robot, or its YAML")
    parser.add_argument("--task", required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--name", default="hma", help="the model's, in the names of folders")
    parser.add_argument("--episodes", type=int, nargs="*", help="numbers; all by default")
    parser.add_argument("--frames", type=int, default=49, help="of a video, at the model's rate")
    parser.add_argument("--context", type=int, default=1, help="frames that the model is given")
    parser.add_argument("--size", type=int, default=256, help="pixels a side of the videos")
    parser.add_argument("--device", default="auto")
    given = parser.parse_args()
    world = load_world(given.checkpoint, device=str(choose_device(given.device)))
    print(f"{export(world, given)} episodes in {given.out}")


def export(world: World, given: argparse.Namespace) -> int:
    """Write the videos and summary.json; return the number of episodes.

    Raises:
        UsageError: a task or model is no name of a folder, no frame is given or predicted, or fewer than
            three episodes are long enough.
    """
    for option, name in (("--task", given.task), ("--name", given.name)):
        if not name or set(name) & set("/\\") or name.startswith("."):
            raise UsageError(option, f"{name!r} is no name of a folder", "give letters, digits and _")
    if not 0 < given.context < given.frames:
        said = f"is {given.context}, of {given.frames} --frames"
        raise UsageError("--context", said, "give 1 or more, and fewer than --frames")
    recording = Recording(given.recording, find(given.embodiment))
    span = (given.frames - 1) * recording.robot.stride + 1
    known = range(len(recording.ids))
    wanted = known if given.episodes is None else given.episodes
    chosen = [number for number in wanted if number in known and recording.lengths[number] >= span]
    if len(chosen) < len(VARIANTS):
        said = f"has {len(chosen)} of the chosen episodes with {span} frames; {len(VARIANTS)} are needed"
        raise UsageError(given.recording, said, "give more or longer episodes, or fewer --frames")
    listed = _listed(given.out / "summary.json")
    with progress("episodes", len(chosen), "episodes") as shown:
        for part in batched(range(len(chosen)), BATCH):
            for variant in range(len(VARIANTS)):
                windows = [_window(world, recording, chosen, place, variant, given) for place in part]
                made = continued(world, recording.robot.id, windows)
                for place, one, frames in zip(part, windows, made, strict=True):
                    name = f"episode_{chosen[place]}"
                    _film(given.out / f"{given.name}{VARIANTS[variant]}_sort", name, frames, recording, given)
                    if not variant:
                        row = _truth(recording, one, name, given)
                        listed[row["gt_path"]] = row
            shown(part[-1] + 1)
    write_atomic(given.out / "summary.json", json.dumps(list(listed.values()), indent=1))
    return len(chosen)


def _window(
    world: World, recording: Recording, chosen: list[int], place: int, variant: int, given: argparse.Namespace
) -> Window:
    """Return the window of an episode; for a variant with the actions of another one after the context."""
    take = (0, given.frames, given.context, given.size)
    own = recording.window(world, chosen[place], *take)
    if not variant:
        return own
    other = recording.window(world, chosen[(place + variant) % len(chosen)], *take)
    chunks = own.chunks.copy()
    chunks[given.context - 1 :] = other.chunks[given.context - 1 :]
    return replace(own, chunks=chunks)


def _truth(recording: Recording, one: Window, name: str, given: argparse.Namespace) -> dict[str, Any]:
    """Write an episode as recorded; return its row of summary.json."""
    folder = given.out / "gt" / given.task
    for part in (*BETWEEN, "video"):
        folder /= part
    path, image = folder / f"{name}.mp4", folder / f"{name}.png"
    flat = _film(given.out / "gt_sort", name, one.true, recording, given)
    folder.mkdir(parents=True, exist_ok=True)
    shutil.copyfile(flat, path)
    write_atomic(image, png_bytes(one.true[0]))
    said = recording.clip(one.episode).episode.instruction
    prompt = said or NO_INSTRUCTION.format(robot=recording.robot.robot, task=given.task.replace("_", " "))
    return {"gt_path": str(path.resolve()), "image": str(image.resolve()), "prompt": [prompt]}


def _film(folder: Path, name: str, frames: Images, recording: Recording, given: argparse.Namespace) -> Path:
    path = folder / f"{given.task}_{name}.mp4"
    write_mp4(path, frames, recording.robot.effective_hz)
    return path


def _listed(path: Path) -> dict[str, dict[str, Any]]:
    """Return the rows that summary.json has, by their gt_path."""
    if not path.is_file():
        return {}
    try:
        return {row["gt_path"]: row for row in json.loads(path.read_bytes())}
    except (ValueError, TypeError, KeyError) as fault:
        raise UsageError(path, "is no list of episodes", "remove it, or give another --out") from fault


if __name__ == "__main__":
    run_script(main)
