"""Define the verb `hma try`: from a recording to a film of its robot in the model, by the other verbs.

Every step is one command of `hma`, printed and run in a process of its own. What a step has finished is kept,
so the same command continues.
"""

import json
import math
import re
import shlex
import subprocess
import sys
from contextlib import suppress
from pathlib import Path
from typing import Annotated, Any

from typer import Argument, Option

from hma_data.cli.options import choice_option, pairs, robot_option
from hma_data.console import CONTINUE, say
from hma_data.errors import EpisodeError, Interrupted, RegistryError, UsageError
from hma_model.cli.options import embedded_robots

BUNDLED = "embedded"  # the model to begin with: the one of the tokenizer
PHOTOGRAPHED, DRAWN = "fsq-lab", "palette-64"  # tokenizers of the bundled transformer and of the U-Net
FLAT = 0.65  # share of pixels with their left neighbour's colour: drawn from 0.88, photographs up to 0.55
LOOKED_AT = 8  # episodes that are tried, and images of the first that can be read
PROMPT, LONGEST_FILM = 2, 24  # frames that are given, and that are predicted at most
UNLIMITED_STEPS = 1_000_000  # the time ends the training


def try_recording(
    data: Annotated[str, Argument(help="A recording of your robot: file, folder or URI.")],
    embodiment: Annotated[
        str | None, robot_option("Robot, if its YAML exists: a registry id or a file.")
    ] = None,
    answer: Annotated[
        list[str] | None,
        Option(metavar="KEY=VALUE", help="Answer a question of the robot's YAML; repeatable."),
    ] = None,
    only: Annotated[list[str] | None, choice_option("Use only this episode")] = None,
    minutes: Annotated[float, Option(min=0.1, help="Minutes of training.")] = 5.0,
    out: Annotated[Path | None, Option(help="Output folder; default: hma-try-NAME.")] = None,
) -> None:
    """Finetune the bundled model on a recording: inspect, infer, convert, finetune, evaluate, report.

    In a terminal it asks what the recording does not state; elsewhere, use --answer. Run again to continue.

    Example: hma try ./demo.hdf5 --minutes 5 --answer action.space=joint_delta
    """
    from hma_data.sources.detect import require_there

    require_there(data)
    name = re.sub(r"[^a-z0-9_.-]+", "_", Path(data).stem.lower()).strip("_.-") or "my_robot"
    folder = out or Path(f"hma-try-{name}")
    if name in embedded_robots(""):  # the bundled model has another robot of this id
        name = f"my_{name}"
    shards, run, film = folder / "shards", folder / "run", folder / "film.mp4"
    done: list[list[str]] = []

    def step(*words: object, there: bool = False) -> None:
        done.append([str(word) for word in words])  # the page names what an earlier run has made too
        if not there:
            _run(done[-1])

    if embodiment is None:
        yaml = folder / "robot.yaml"
        step("inspect", data, "--fail-on", "never")
        step("registry", "infer", data, "--id", name, "--out", yaml, there=yaml.is_file())
        _answer(data, yaml, answer or [])
        embodiment = str(yaml)
    chosen = [word for name in only or () for word in ("--only", name)]
    tokenizer = _tokenizer(data, embodiment)
    step("convert", data, "-e", embodiment, "--tokenizer", tokenizer, *chosen, "--out", shards)
    time_limit = (f"seconds={round(60 * minutes)}", f"steps={UNLIMITED_STEPS}")
    again = ("--force",) if run.is_dir() else ()  # with more --minutes, a run goes on
    step("finetune", shards, "--from", BUNDLED, *time_limit, "--out", run, *again)
    split, most = _shown_split(shards)
    step("evaluate", run, shards, "--split", split, "--windows", 24, "--out", folder / "evaluation")
    frames = ("--split", split, "--prompt", PROMPT, "--frames", most)
    shown = film.is_file() and film.stat().st_mtime > (run / "checkpoints").stat().st_mtime
    step("generate", run, shards, *frames, "--unmask-steps", 8, "--out", film, there=shown)
    say(f"open {_write_page(folder, shards, film, done)}")


def _tokenizer(data: str, embodiment: str) -> str:
    """Return the tokenizer that suits the images of a recording; both are those of a bundled model."""
    import numpy as np

    from hma_data.episodes.align import to_clip
    from hma_data.episodes.images import prepared
    from hma_data.registry.embodiment import find
    from hma_data.sources.base import open_source
    from hma_data.tokenizers.base import get_tokenizer

    robot, colors = find(embodiment), get_tokenizer(DRAWN)
    source, camera, spec = open_source(robot.source.format), robot.primary_camera, colors.spec
    for episode in source.episode_ids(data)[:LOOKED_AT]:
        with suppress(EpisodeError):  # the conversion says what is wrong with it
            clip = to_clip(source.read(data, episode, robot), robot)
            rows = clip.frame_indices[camera.name][np.linspace(0, len(clip) - 1, LOOKED_AT).astype(int)]
            stream = clip.episode.streams[camera.name]
            images = prepared(stream, rows, camera, spec.image_size, spec.resize_filter)
            shown = colors.decode(colors.encode(images))
            same = (shown[:, :, 1:] == shown[:, :, :-1]).all(axis=-1).mean()
            return DRAWN if same > FLAT else PHOTOGRAPHED
    return PHOTOGRAPHED


def _run(words: list[str]) -> None:
    """Print a command and run it; end with its exit code if it fails."""
    say(f"$ {shlex.join(['hma', *words])}", flush=True)
    try:
        code = subprocess.run([sys.executable, "-m", "hma_model.cli", *words], check=False).returncode
    except KeyboardInterrupt:  # the step has got the same Ctrl-C, and says what it keeps
        raise Interrupted("", f"interrupted: {CONTINUE}") from None
    if code:
        raise SystemExit(code)


def _shown_split(folder: Path) -> tuple[str, int]:
    """Return val, or train if no episode is held out, and how many frames its longest has to predict."""
    from hma_data.shards.reader import ShardSet

    shards = ShardSet(folder)
    split = "val" if shards.manifest.splits["val"]["episodes"] else "train"
    longest = int(shards.index(split).length.max()) // shards.row_stride - PROMPT
    return split, max(1, min(LONGEST_FILM, longest))


def _answer(data: str, path: Path, given: list[str]) -> None:
    """Replace the TODOs of a YAML by the answers that are given, or asked for in a terminal.

    A rate that the recording did not state decides which of its frames the model is to see.
    """
    from hma_data.inspection.infer import target_hz
    from hma_data.registry.embodiment import todos
    from hma_data.sources.base import open_source
    from hma_data.sources.detect import detect
    from hma_data.storage.files import write_atomic
    from hma_data.storage.yaml_io import parse_yaml, read_yaml, write_yaml

    values = read_yaml(path)
    answers = pairs("--answer", given, "kind=real")
    is_rate_answered = "frequency_hz" in {**dict(todos(values)), **answers}
    for key, text in answers.items():
        _set(values, key, parse_yaml(text, f"{key}={text}", UsageError))
    open_questions = []
    for key, question in todos(values):
        if key == "provenance.crop" and sys.stdin.isatty() and input(f"{question} [Y/n] ")[:1] in ("n", "N"):
            for camera in values["cameras"]:  # the whole image
                camera.pop("crop", None)
                camera.pop("resize", None)
        if key == "robot" or key.startswith("provenance"):
            _set(values, key, "not stated")  # a text for people, which changes nothing
        elif sys.stdin.isatty():
            _set(values, key, parse_yaml(input(f"{key}: {question} "), key, UsageError))
        else:
            open_questions.append((key, question))
    if open_questions:
        asked = "; ".join(f"{key}: {question}" for key, question in open_questions)
        flags = " ".join(f"--answer {key}=…" for key, _ in open_questions)
        raise RegistryError(path, f"has open questions: {asked}", f"use {flags}, or edit the file")
    rate = values["frequency_hz"] if is_rate_answered and not {"stride", "target_hz"} & {*answers} else None
    if isinstance(rate, int | float) and 0 < rate < math.inf and "stride" not in values:
        values["target_hz"] = target_hz(rate, open_source(detect(data)).inspect(data).lengths)
    write_atomic(path, write_yaml(values))


def _set(values: Any, key: str, value: Any) -> None:
    """Set the value at a path such as `cameras[0].color`."""
    words = re.findall(r"([^.\[\]]+)|\[(\d+)\]", key)
    *parents, last = (word or int(number) for word, number in words)
    try:
        for part in parents:
            values = values[part]
        values[last] = value
    except (KeyError, IndexError, TypeError) as fault:
        raise UsageError("--answer", f"{key} is not a key of the YAML", "see the keys in the file") from fault


def _write_page(folder: Path, shards: Path, film: Path, done: list[list[str]]) -> Path:
    """Write the page with the film, what was measured, and the commands."""
    from hma_data.episodes.sheets import webp_bytes
    from hma_data.inspection.shard_findings import kept_findings
    from hma_data.shards.reader import ShardSet
    from hma_data.sources.common.video_file import VideoFile
    from hma_data.storage.files import write_atomic
    from hma_model.evaluation.pages import Page
    from hma_model.evaluation.verdict import verdict

    [found] = json.loads((folder / "evaluation" / "results.json").read_bytes())["results"]
    seen = " No episode was held out, so it was trained on these." if found["split"] == "train" else ""
    page = Page("Your robot in the model", f"The model {verdict(found)}.{seen}")
    video, recorded = VideoFile(film), ShardSet(shards)
    frames = video.frames(range(len(video)))
    caption = "Recorded frames, decoded from tokens; predicted from the recorded actions; from other actions."
    page.picture(webp_bytes(frames, recorded.embodiment.effective_hz), "webp", caption)
    for found in kept_findings(recorded):
        page.text(f"Tokens of {found}.")
    page.section("Files", f"{film.name} is this video. evaluation/report.html has all figures and charts.")
    page.section("Commands")
    page.commands("\n".join(shlex.join(["hma", *words]) for words in done))
    path = folder / "index.html"
    write_atomic(path, page.html())
    return path
